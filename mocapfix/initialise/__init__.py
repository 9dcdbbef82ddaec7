"""Initialisation: a first pose for every frame, from which the solve starts."""
