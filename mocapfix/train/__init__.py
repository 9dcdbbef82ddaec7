"""Fitting what ships in priors/ from motion data."""
