"""Calibration: a person's bones and marker offsets, estimated from a take; learning of marker sets; the subject file."""
