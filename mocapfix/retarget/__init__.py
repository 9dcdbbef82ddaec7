"""Retargeting: pose a character like another one, under terms that say what of the motion is kept."""
