"""Readers: files of markers or joints become takes or animations in metres with Y up.

`capture.read_capture` detects the format. Each format has a module, and the others have what the formats share.
"""

from mocapfix.read.capture import read_capture, read_take

__all__ = ["read_capture", "read_take"]
