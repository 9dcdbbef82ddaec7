"""Compiled code (Numba): kinematics, residual terms, the linear-time sweep, closed-form registration.

Everything here works on arrays and numbers. Code that calls these loops on motions, subjects and takes is in `solve`,
`initialise` and `calibrate`.
"""
