"""The mesh of a glTF: its triangles, and the nodes that move their corners, for linear blend skinning.

Source: Khronos, glTF 2.0, sections 3.6 (accessors) and 3.7.3 (skins). Skinned meshes and meshes that a node carries stiffly are
one mesh here. Left out are meshes whose arrays are compressed or damaged, lines and points, and triangles whose texture is
transparent. A material is one colour for each triangle.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int, Num

from mocapfix.io.gltf import MAX_COORDINATE_M, GlbContent, GltfNodes, are_numbers

COMPONENT_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
ELEMENT_SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TRIANGLES = 4  # mode of a primitive
MAX_NODES = 8  # that a corner follows: the first two sets of a file count
MIN_OPACITY = 0.5  # a triangle with a more transparent texture is left out
UNREADABLE = (AttributeError, LookupError, OverflowError, TypeError, ValueError)  # what damaged or compressed data raise


@dataclass(frozen=True)
class GltfMesh:
    """All triangles of a file; its V corners follow K of the S nodes in `nodes`, each by a weight."""

    positions: Float[np.ndarray, "V 3"]  # in the axes of the mesh
    slots: Int[np.ndarray, "V K"]  # indices in `nodes`
    weights: Float[np.ndarray, "V K"]  # sum to 1
    nodes: Int[np.ndarray, " S"]
    inverse_bind: Float[np.ndarray, "S 4 4"]  # axes of the mesh to those of each node, in the bind pose
    triangles: Int[np.ndarray, "F 3"]
    colours: Float[np.ndarray, "F 3"]  # red, green and blue, 0 to 1, sRGB

    def pose(self, node_matrices: Float[np.ndarray, "N 4 4"]) -> Float[np.ndarray, "V 3"]:
        """Return the corners in the world, given the matrices of all nodes to the world."""
        matrices = node_matrices[self.nodes] @ self.inverse_bind
        posed = np.zeros_like(self.positions)
        for slots, weights in zip(self.slots.T, self.weights.T, strict=True):
            used = matrices[slots]
            posed += weights[:, None] * (np.einsum("vij,vj->vi", used[:, :3, :3], self.positions) + used[:, :3, 3])
        return posed

    @property
    def strongest(self) -> Int[np.ndarray, " V"]:
        """The slot of the greatest weight of each corner."""
        return np.take_along_axis(self.slots, self.weights.argmax(1)[:, None], axis=1)[:, 0]

    def join(self, other: "GltfMesh") -> "GltfMesh":
        """Return this mesh and another one as one."""
        other = replace(other, slots=other.slots + len(self.nodes), triangles=other.triangles + len(self.positions))
        return GltfMesh(*(np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))


def read_gltf_mesh(content: GlbContent, nodes: GltfNodes) -> GltfMesh:
    """Read the mesh of a file, without any triangle if nothing can be read. Only the binary chunk is used."""
    mesh = GltfMesh(
        np.empty((0, 3)), np.empty((0, MAX_NODES), int), np.empty((0, MAX_NODES)), np.empty(0, int), np.empty((0, 4, 4)),
        np.empty((0, 3), int), np.empty((0, 3)),
    )  # fmt: skip
    for node, entry in enumerate(nodes.entries):
        with suppress(*UNREADABLE):
            for primitive in content.document["meshes"][entry["mesh"]]["primitives"]:
                if primitive.get("mode", TRIANGLES) == TRIANGLES:
                    with suppress(*UNREADABLE), np.errstate(all="ignore"):
                        mesh = mesh.join(_read_primitive(content, node, entry, primitive))
    return mesh


def _read_primitive(content: GlbContent, node: int, entry: Mapping[str, Any], primitive: Mapping[str, Any]) -> GltfMesh:
    """Read one primitive of a node's mesh. Raises one of UNREADABLE."""
    attributes = primitive["attributes"]
    positions = read_array(content, attributes["POSITION"]).astype(float)
    count = len(positions)
    order = read_array(content, primitive["indices"])[:, 0].astype(int) if "indices" in primitive else np.arange(count)
    triangles = order[: len(order) // 3 * 3].reshape(-1, 3)
    nodes, inverse_bind = np.array([node]), np.eye(4)[None]
    slots, weights = np.zeros((count, 1), int), np.ones((count, 1))
    if "skin" in entry:
        skin = content.document["skins"][entry["skin"]]
        nodes = np.array(skin["joints"], int)
        inverse_bind = np.tile(np.eye(4), (len(nodes), 1, 1))
        if "inverseBindMatrices" in skin:
            inverse_bind = read_array(content, skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2).astype(float)
        sets = range(min(MAX_NODES // 4, sum(name.startswith("JOINTS_") for name in attributes)))
        slots = np.concatenate([read_array(content, attributes[f"JOINTS_{k}"]) for k in sets], axis=1).astype(int)
        weights = np.concatenate([read_array(content, attributes[f"WEIGHTS_{k}"]) for k in sets], axis=1).astype(float)
        weights /= np.maximum(weights.sum(1, keepdims=True), np.finfo(float).tiny)
    is_finite = all((np.abs(each) < MAX_COORDINATE_M).all() for each in (positions, weights, inverse_bind))
    is_complete = len(slots) == len(weights) == count and len(inverse_bind) >= len(nodes)
    limits = ((triangles, count), (slots, len(nodes)), (nodes, len(content.document["nodes"])))
    if not (is_finite and is_complete) or any(each.max(initial=0) >= limit for each, limit in limits):
        raise ValueError("an index of the mesh is out of range")
    slots, weights = (np.pad(each, ((0, 0), (0, MAX_NODES - each.shape[1]))) for each in (slots, weights))
    colours, is_opaque = _read_colours(content, primitive, triangles)
    return GltfMesh(positions, slots, weights, nodes, inverse_bind[: len(nodes)], triangles[is_opaque], colours[is_opaque])


def read_array(content: GlbContent, index: int) -> Num[np.ndarray, "N n"]:
    """Read an accessor from the binary chunk, one element in each row; normalised integers become fractions.

    Raises:
        KeyError, IndexError, TypeError, ValueError: If its data are compressed, sparse, missing or damaged.
    """
    accessor = content.document["accessors"][index]
    view = content.document["bufferViews"][accessor["bufferView"]]
    if view["buffer"] != 0 or "extensions" in view or "sparse" in accessor:
        raise ValueError("the array is not stored plainly")
    dtype, size = np.dtype(COMPONENT_TYPES[accessor["componentType"]]), ELEMENT_SIZES[accessor["type"]]
    strides = view.get("byteStride", dtype.itemsize * size), dtype.itemsize
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    values = np.ndarray((accessor["count"], size), dtype, content.binary, start, strides)
    return values / np.iinfo(dtype).max if accessor.get("normalized") and dtype.kind != "f" else values.copy()


def _read_colours(
    content: GlbContent, primitive: Mapping[str, Any], triangles: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "F 3"], Bool[np.ndarray, " F"]]:
    """Return the colour of each triangle, that of the material and of the texture at its centre, and whether it is opaque."""
    material = content.document["materials"][primitive["material"]] if "material" in primitive else {}
    surface = material.get("pbrMetallicRoughness", {})
    factor = np.array(surface.get("baseColorFactor", np.ones(4)), float)[:3].clip(0, 1) ** (1 / 2.2)  # linear to sRGB
    colours = np.tile([*factor, 1.0], (len(triangles), 1))  # exporters write the opacity 0 too
    if texture := surface.get("baseColorTexture"):
        image = _read_image(content, content.document["textures"][texture["index"]]["source"])
        place = read_array(content, primitive["attributes"][f"TEXCOORD_{texture.get('texCoord', 0)}"])[triangles].mean(1) % 1
        column, row = (place * image.shape[1::-1]).astype(int).clip(0, np.array(image.shape[1::-1]) - 1).T
        colours *= image[row, column] / 255
    return colours[:, :3], (colours[:, 3] >= MIN_OPACITY) | (material.get("alphaMode", "OPAQUE") == "OPAQUE")


def _read_image(content: GlbContent, index: int) -> Num[np.ndarray, "h w 4"]:
    """Return the pixels of an image in the binary chunk, one white pixel if it is in another file or of another kind."""
    from PIL import Image  # few outputs need it

    with suppress(KeyError, OSError, SyntaxError, Image.DecompressionBombError):
        view = content.document["bufferViews"][content.document["images"][index]["bufferView"]]
        start = view.get("byteOffset", 0)
        with Image.open(BytesIO(content.binary[start : start + view["byteLength"]])) as image:
            return np.asarray(image.convert("RGBA"))
    return np.full((1, 1, 4), 255)


NODE_PROPERTIES = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
"""the parts of a node's transform, and their values where the file has none"""


def compute_node_matrices(
    content: GlbContent, nodes: GltfNodes, animation: Mapping[str, Any] | None = None, times_s: Sequence[float] = (0.0,)
) -> Float[np.ndarray, "T N 4 4"]:
    """Compute the matrices of all nodes to the world, in the rest pose or at some times of an animation.

    Args:
        animation: An entry of the document. The key nearest to each time is used.
        times_s: In seconds after the beginning of the animation.
    """
    shape = (len(times_s), len(nodes.entries))
    values = {
        name: np.tile(np.array([_read_vector(entry, name, default) for entry in nodes.entries]), (shape[0], 1, 1))
        for name, default in NODE_PROPERTIES.items()
    }
    animated = set[int]()
    for channel in animation["channels"] if animation else ():
        sampler, target = (animation or {})["samplers"][channel["sampler"]], channel["target"]
        if "node" in target and target["path"] in values:
            keys, output = (read_array(content, sampler[name]).astype(float) for name in ("input", "output"))
            nearest = np.searchsorted((keys[1:, 0] + keys[:-1, 0]) / 2, times_s)
            values[target["path"]][:, target["node"]] = output[nearest]
            animated.add(target["node"])
    rotation = values["rotation"]
    rotation[np.linalg.norm(rotation, axis=-1) == 0] = NODE_PROPERTIES["rotation"]
    matrices = np.tile(np.eye(4), (*shape, 1, 1))
    matrices[..., :3, :3] = scipy.spatial.transform.Rotation.from_quat(rotation.reshape(-1, 4)).as_matrix().reshape(*shape, 3, 3)
    matrices[..., :3, :3] *= values["scale"][..., None, :]
    matrices[..., :3, 3] = values["translation"]
    for node in nodes.ordered:
        entry = nodes.entries[node]
        if node not in animated and "matrix" in entry:
            matrices[:, node] = np.reshape(
                _read_vector(entry, "matrix", np.eye(4).ravel().tolist()), (4, 4)
            ).T  # stored by columns
        if nodes.parents[node] >= 0:
            matrices[:, node] = matrices[:, nodes.parents[node]] @ matrices[:, node]
    return matrices


def extract_rotations(matrices: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the rotations in matrices, without their scales; a matrix that mirrors has none."""
    linear = matrices[..., :3, :3]
    determinant = np.linalg.det(linear)[..., None, None]
    linear = np.where(determinant > 0, linear, np.eye(3)) / np.cbrt(np.where(determinant > 0, determinant, 1.0))
    return scipy.spatial.transform.Rotation.from_matrix(linear.reshape(-1, 3, 3)).as_matrix().reshape(linear.shape)


def move_nodes(
    nodes: GltfNodes, matrices: Float[np.ndarray, "N 4 4"], moved: Mapping[int, Float[np.ndarray, "4 4"]]
) -> Float[np.ndarray, "N 4 4"]:
    """Return the matrices to the world after some nodes were moved; the others keep their place relative to the node above."""
    result = matrices.copy()
    for node in nodes.ordered:
        above = nodes.parents[node]
        if node in moved:
            result[node] = moved[node]
        elif above >= 0:
            result[node] = result[above] @ np.linalg.pinv(matrices[above]) @ matrices[node]
    return result


def _read_vector(entry: Mapping[str, Any], name: str, default: Sequence[float]) -> Sequence[float]:
    """Return a property of a node, the default if it is missing or invalid."""
    values = entry.get(name)
    return values if isinstance(values, list) and len(values) == len(default) and are_numbers(values) else default
