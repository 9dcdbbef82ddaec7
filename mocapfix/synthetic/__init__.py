"""Synthetic takes with known truth: for the demo, the benchmarks and the tests."""

from mocapfix.synthetic.synthetic_takes import SyntheticTake, compose_take, write_synthetic_take

__all__ = ["SyntheticTake", "compose_take", "write_synthetic_take"]
