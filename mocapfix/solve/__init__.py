"""The solve: the pose of every frame from markers, priors and time, and single poses from constraints."""
