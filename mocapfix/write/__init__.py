"""Writing what cleaning a take gives."""

from mocapfix.write.bvh import bvh, bvh_for
from mocapfix.write.c3d import c3d
from mocapfix.write.gltf import gltf
from mocapfix.write.npz import npz

__all__ = ["bvh", "bvh_for", "c3d", "gltf", "npz"]
