"""Faults of samples, found on the trajectories and against the solved body.

loop            the order of the detectors, repeated until nothing new is found
gaps, spikes, jitter, ghosts, external_fills   on trajectories
body_outliers, marker_shifts, moved_markers    against the body
keypoints       points of markerless systems
marker_distances, shared_motion, trajectory_segments, round_memory   what detectors share
"""
