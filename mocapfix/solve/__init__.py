"""Poses: a first pose in closed form, the optimiser, smoothing, and what the markers do not show.

- `initial_motion`: first poses: of segments registered to markers; hybrik, learned_ik
- `motion_solver`: solve all frames of a take, and how certain they are
- `pose_problem`: the terms of a body: its markers, prior and limits; the frames that changed
- `minimise`: the one way of minimising; terms, model_terms
- `smoothing`: poses over time
- `occluded_joints`: joints without markers; person_memory, lost_in_sight, measured_segments
- `pose_prior`: trained_priors, prior_conditioner; mean_pose; motion_prior
- `single_pose`: a pose under given constraints
- `trajectory`: the poses of all frames at once, of robots
- `kinematics`: positions of joints and markers; parallel
"""
