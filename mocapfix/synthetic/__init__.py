"""Takes with known truth, composed by mocapfix itself: for the demo, the benchmarks and the tests.

footsteps   where the feet are: they do not slide
gestures    what arms, spine and head do
motions     a body over those feet, making those gestures
damage      what goes wrong with markers
truth       a person, their motion, their markers before and after the damage
c3d         the damaged take as a file
"""

from mocapfix.synthetic.synthetic_takes import SyntheticTake, compose_take, write_synthetic_take

__all__ = ["SyntheticTake", "compose_take", "write_synthetic_take"]
