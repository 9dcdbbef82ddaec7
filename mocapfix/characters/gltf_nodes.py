"""The nodes of a glTF: their tree, and their transforms as rotations, positions in metres and scales."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError

MAX_SCALE_DEVIATION = 1e-3
"""relative difference of the scales along a bone's axes, up to which they count as equal: rounding of exporters"""
MIN_SCALE = 1e-9
"""a smaller scale is none"""
MAX_COORDINATE_M = 1e6
"""a bone farther from the origin than this is a sign of damage"""


@dataclass(frozen=True)
class GltfNodes:
    """The N nodes of a glTF document.

    entries   N objects of the document
    names     N unique names: those of the file, with a number where one is missing or used before
    parents   (N,) index of each node's parent, -1 for roots
    ordered   N indices, parents before children, children in the order of the file
    """

    path: Path
    entries: Sequence[Mapping[str, Any]]
    names: tuple[str, ...]
    parents: Int[np.ndarray, " N"]
    ordered: tuple[int, ...]

    def list_ancestors(self, node: int) -> list[int]:
        """Return the nodes above a node, from its parent to its root."""
        found: list[int] = []
        while (node := int(self.parents[node])) >= 0:
            found.append(node)
        return found


@dataclass(frozen=True)
class BoneTransforms:
    """The transforms of B nodes.

    positions  (B, 3) m: in the parent's axes, the scales of all nodes above multiplied out
    rotations  (B, 3, 3): to the parent's axes
    scales     (B,) metres in a unit of length along each node's own axes
    """

    positions: Float[np.ndarray, "B 3"]
    rotations: Float[np.ndarray, "B 3 3"]
    scales: Float[np.ndarray, " B"]


def read_gltf_nodes(path: Path, document: Mapping[str, Any]) -> GltfNodes:
    """Return the tree of the nodes. Raises ReadError if an index is out of range, or the nodes form no trees."""
    entries = document.get("nodes", [])
    parents = np.full(len(entries), -1)
    for index, entry in enumerate(entries):
        for child in read_indices(path, f"nodes[{index}].children", entry.get("children", []), len(entries)):
            if parents[child] >= 0:
                problem = f"node {child} is a child of node {parents[child]} and of node {index}"
                raise ReadError(f"{path}: {problem}; the file is damaged, so export it again.")
            parents[child] = index
    ordered = tuple(_iterate_depth_first(entries, np.flatnonzero(parents < 0).tolist()))
    if len(ordered) < len(entries):
        looped = min(set(range(len(entries))).difference(ordered))
        raise ReadError(f"{path}: node {looped} is below itself; the file is damaged, so export it again.")
    return GltfNodes(path, entries, _choose_names(entries), parents, ordered)


def read_indices(path: Path, place: str, values: object, count: int) -> list[int]:
    """Return a list of indices of the document. Raises ReadError if it is not one, or an index is not below `count`."""
    if not isinstance(values, list):
        raise ReadError(f"{path}: {place} is no list of indices; the file is damaged, so export it again.")
    return [read_index(path, place, value, count) for value in values]


def read_index(path: Path, place: str, value: object, count: int) -> int:
    """Return an index of the document. Raises ReadError if it is not an integer from 0 to below `count`."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < count:
        raise ReadError(f"{path}: {place} refers to entry {str(value)[:20]} of {count}; the file is damaged, so export it again.")
    return value


def _iterate_depth_first(entries: Sequence[Mapping[str, Any]], roots: list[int]) -> Iterator[int]:
    stack = roots[::-1]
    while stack:
        node = stack.pop()
        yield node
        stack.extend(reversed(entries[node].get("children", [])))


def _choose_names(entries: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    names: dict[str, None] = {}
    for index, entry in enumerate(entries):
        given = entry.get("name")
        name = given if isinstance(given, str) and given.strip() else f"node {index}"
        name = name.encode("utf-8", "replace").decode()  # no halves of surrogate pairs, which no file can have
        if name in names:
            name = f"{name}#{index}"
        while name in names:
            name += "#"
        names[name] = None
    return tuple(names)


def compute_bone_transforms(nodes: GltfNodes, bones: Sequence[int]) -> BoneTransforms:
    """Compute the transforms of some nodes, with which all nodes above them are given, parents before children.

    Raises:
        ReadError: If a transform is invalid, or scales by different factors along its axes, by zero, or mirrors.
    """
    transforms = [_read_local_transform(nodes, node) for node in bones]
    index = {node: bone for bone, node in enumerate(bones)}
    parents = [index.get(int(nodes.parents[node]), -1) for node in bones]
    scales, positions = np.ones(len(bones)), np.zeros((len(bones), 3))
    with np.errstate(over="ignore", invalid="ignore"):
        for bone, (translation, _, scale) in enumerate(transforms):
            above = scales[parents[bone]] if parents[bone] >= 0 else 1.0
            scales[bone], positions[bone] = above * scale, above * translation
    is_sound = (np.abs(positions) < MAX_COORDINATE_M).all(1) & (scales > MIN_SCALE) & (scales < 1 / MIN_SCALE)
    if not is_sound.all():
        bone = int(np.argmin(is_sound))
        problem = f"is {np.abs(positions[bone]).max():.3g} m from its parent at a scale of {scales[bone]:.3g}"
        raise ReadError(f"{nodes.path}: the bone {nodes.names[bones[bone]]!r} {problem}; check the scale of the export.")
    return BoneTransforms(positions, np.array([rotation for _, rotation, _ in transforms]).reshape(-1, 3, 3), scales)


def _read_local_transform(nodes: GltfNodes, node: int) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"], float]:
    """Return translation in the file's units, rotation and uniform scale of a node."""
    entry = nodes.entries[node]
    if "matrix" in entry:
        matrix = _read_numbers(nodes, node, "matrix", np.eye(4).ravel()).reshape(4, 4).T  # stored by columns
        translation, linear = matrix[:3, 3], matrix[:3, :3]
        scales = np.linalg.norm(linear, axis=0)
        if np.linalg.det(linear / np.where(scales > 0, scales, 1.0)) < 0:
            scales = -scales
        rotation = linear / np.where(scales == 0, 1.0, scales)
        if scales.all() and np.abs(rotation.T @ rotation - np.eye(3)).max() > MAX_SCALE_DEVIATION:
            raise ReadError(f"{nodes.path}: the bone {nodes.names[node]!r} is sheared; apply its transform before the export.")
    else:
        translation = _read_numbers(nodes, node, "translation", np.zeros(3))
        rotation = _read_rotation(nodes, node)
        scales = _read_numbers(nodes, node, "scale", np.ones(3))
    if (scales <= MIN_SCALE).any() or np.ptp(scales) > MAX_SCALE_DEVIATION * scales.max():
        shown = ", ".join(f"{scale:.4g}" for scale in scales)
        problem = f"has the scale ({shown}), but bones need one positive scale for all axes"
        raise ReadError(f"{nodes.path}: the bone {nodes.names[node]!r} {problem}; apply the scale before the export.")
    return translation, Rotation.from_matrix(rotation).as_matrix(), float(np.cbrt(np.prod(scales)))


def _read_rotation(nodes: GltfNodes, node: int) -> Float[np.ndarray, "3 3"]:
    quaternion = _read_numbers(nodes, node, "rotation", np.array([0.0, 0.0, 0.0, 1.0]))
    if np.linalg.norm(quaternion) < MIN_SCALE:
        raise ReadError(f"{nodes.path}: the rotation of {nodes.names[node]!r} is zero; the file is damaged, so export it again.")
    return Rotation.from_quat(quaternion).as_matrix()


def _read_numbers(nodes: GltfNodes, node: int, key: str, default: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the numbers of a node's property, which must be as many as in its default and finite."""
    values = nodes.entries[node].get(key)
    if values is None:
        return default
    if isinstance(values, list) and len(values) == len(default) and are_numbers(values):
        return np.array(values, float)
    problem = f"the {key} of {nodes.names[node]!r} is not {len(default)} finite numbers"
    raise ReadError(f"{nodes.path}: {problem}; the file is damaged, so export it again.")


def are_numbers(values: Sequence[object]) -> bool:
    """Return whether all values are finite numbers of a usable size."""
    return all(isinstance(value, int | float) and abs(value) < 1 / MIN_SCALE for value in values)
