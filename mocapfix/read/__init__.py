"""Reading takes: the one place where files become metres, Y up."""

from mocapfix.read.c3d import take

__all__ = ["take"]
