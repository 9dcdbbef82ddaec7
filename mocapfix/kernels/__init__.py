"""What several stages stand on: kinematics, residual terms, the linear-time sweep (compiled with Numba)."""
