"""Writing what cleaning a take gives."""

from mocapfix.write.bvh import bvh
from mocapfix.write.c3d import c3d

__all__ = ["bvh", "c3d"]
