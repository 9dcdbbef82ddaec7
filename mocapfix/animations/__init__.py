"""Cleaning of animations: detection and repair of faults in joint rotations and in the root's position."""
