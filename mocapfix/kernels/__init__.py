"""Compiled code (Numba): it works on arrays and numbers. The code that calls it on motions and takes is mostly in `solve`.

- `compilation`: how kernels are compiled and kept
- `small_matrices`, `lie`, `euler_angles`, `forward_kinematics`: matrices, rotations and positions
- `terms`: the residual terms
- `normal_equations`: one frame's quadratic model; sweep, its step
- `levenberg_marquardt`: the solve of a frame, and of many
- `hinged_tree`: the model of frames of robots
- `covariance`: pose uncertainty; schur, unknowns that all frames share
- `hybrik`, `joint_registration`, `rigid_registration`, `pose_transfer`, `belief_propagation`: first poses
- `label_evidence`, `point_linking`, `function_screening`, `viterbi`: labels and points
- `text_numbers`: numbers in texts
"""
