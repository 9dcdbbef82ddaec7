"""Writing what cleaning a take gives."""

from mocapfix.write.bvh import bvh, bvh_for
from mocapfix.write.c3d import c3d

__all__ = ["bvh", "bvh_for", "c3d"]
