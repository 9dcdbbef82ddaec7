"""Characters: rigged figures of animators, read from files or presets, onto which the solved motion is retargeted."""
