"""Pose priors: the mean pose, joint limits, and trained models of human poses with a latent code."""
