"""Synthetic takes with known truth: for the demo, the benchmarks and the tests.

footsteps        where the feet are: they do not slide
gestures         rotations of arms, spine and head
motions          a body over those feet, making those gestures
key_poses        smooth motion between key poses
extreme_motions  key poses of strikes, kicks, throws and acrobatics
extreme_takes    takes of them
unlabelled_takes points without labels, made of takes whose labels are known
two_people       one person placed beside another, or so that their paths cross
synthetic_takes  a person, their motion, their markers before and after damage by gaps and spikes, and the C3D file
"""

from mocapfix.synthetic.synthetic_takes import SyntheticTake, compose_take, write_synthetic_take

__all__ = ["SyntheticTake", "compose_take", "write_synthetic_take"]
