"""Write USD with a skeleton (UsdSkel) from a binary glTF: mesh, joints, weights and the first animation. It needs usd-core.

Source: OpenUSD, UsdSkel (Schemas In-Depth). A joint is every node of the glTF that a skin or the animation names, and all above
it. Lengths are metres, Y is up. USD gives a joint one bind transform for all meshes, glTF one for each skin: the corners of a
skin with others are moved to that of the first. Scales of joints are folded into the bind transforms. Of materials only the
colours of triangles are written.
"""

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.io.files import replace_atomically
from mocapfix.io.gltf import GltfNodes, parse_glb, read_gltf_nodes
from mocapfix.io.gltf_mesh import GltfMesh, compute_node_matrices, extract_rotations, read_array, read_gltf_mesh
from mocapfix.model.skeleton import decompose_transforms

ROOT_PATH = "/Character"
SRGB_EXPONENT = 2.2  # of the colours of a glTF in the mesh; USD has them linear


def write_usd(target: Path, glb_path: Path, rate: float) -> str | None:
    """Write the character in a GLB as USD, with its first animation at `rate` frames per second.

    Returns:
        A sentence why no file was written, None if it was.

    Raises:
        WriteError: If `target` is not writable.
    """
    try:
        gf, sdf, tf, usd, usd_geom, usd_skel, vt = map(_load_usd, ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdSkel", "Vt"))
    except ModuleNotFoundError:
        return f"{target.name} was not written: USD needs usd-core; install it with: pip install 'mocapfix[usd]'."
    content = parse_glb(glb_path, glb_path.read_bytes())
    nodes, animation = read_gltf_nodes(glb_path, content.document), content.document["animations"][0]
    mesh = read_gltf_mesh(content, nodes)
    joints = _list_joints(nodes, content.document, animation, mesh)
    frame_count = max(len(read_array(content, each["input"])) for each in animation["samplers"])
    rest = compute_node_matrices(content, nodes)[:, joints]
    moving = compute_node_matrices(content, nodes, animation, (np.arange(frame_count) / rate).tolist())[:, joints]
    place = {node: joint for joint, node in enumerate(joints)}
    parents = np.array([place.get(int(nodes.parents[node]), -1) for node in joints])
    rest_rigid, rigid = rest.copy(), moving.copy()
    for each in (rest_rigid, rigid):
        each[..., :3, :3] = extract_rotations(each)
    # from a joint's axes with the scales of the file to those without
    bind = rest_rigid[0].copy()
    slot_joints = np.array([place[node] for node in mesh.nodes.tolist()], int)
    inverse_bind = np.linalg.inv(rest_rigid[0]) @ rest[0]
    inverse_bind = inverse_bind[slot_joints] @ mesh.inverse_bind
    bind[slot_joints[::-1]] = np.linalg.inv(inverse_bind)[::-1]  # that of the first skin
    # the corners, moved as the slot that they follow most is moved from its skin to the bind pose
    used = (bind[slot_joints] @ inverse_bind)[mesh.strongest]
    corners = np.einsum("vij,vj->vi", used[:, :3, :3], mesh.positions) + used[:, :3, 3]

    stage = usd.Stage.CreateInMemory()
    usd_geom.SetStageUpAxis(stage, usd_geom.Tokens.y)
    usd_geom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(frame_count - 1)
    root = usd_skel.Root.Define(stage, ROOT_PATH)
    stage.SetDefaultPrim(root.GetPrim())
    skeleton = usd_skel.Skeleton.Define(stage, f"{ROOT_PATH}/Skeleton")
    names: list[str] = []
    for node, parent in zip(joints, parents.tolist(), strict=True):
        name = tf.MakeValidIdentifier(nodes.names[node])
        above = f"{names[parent]}/" if parent >= 0 else ""
        names.append(f"{above}{name}" if f"{above}{name}" not in names else f"{above}{name}_{node}")
    skeleton.CreateJointsAttr(names)
    skeleton.CreateBindTransformsAttr(vt.Matrix4dArray([gf.Matrix4d(each.T.tolist()) for each in bind]))
    local = _compute_local(rest_rigid, parents)[0]
    skeleton.CreateRestTransformsAttr(vt.Matrix4dArray([gf.Matrix4d(each.T.tolist()) for each in local]))

    clip = usd_skel.Animation.Define(stage, f"{ROOT_PATH}/Skeleton/{tf.MakeValidIdentifier(animation['name'])}")
    clip.CreateJointsAttr(names)
    local = _compute_local(rigid, parents)
    quaternions = Rotation.from_matrix(local[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(frame_count, -1, 4)
    translations, rotations = clip.CreateTranslationsAttr(), clip.CreateRotationsAttr()
    clip.CreateScalesAttr(vt.Vec3hArray(len(joints), gf.Vec3h(1, 1, 1)))
    with sdf.ChangeBlock():
        for frame in range(frame_count):
            translations.Set(vt.Vec3fArray.FromNumpy(local[frame, :, :3, 3].astype("f4")), frame)
            rotations.Set(vt.QuatfArray([gf.Quatf(w, x, y, z) for x, y, z, w in quaternions[frame].tolist()]), frame)
    binding = usd_skel.BindingAPI.Apply(skeleton.GetPrim())
    binding.CreateAnimationSourceRel().SetTargets([clip.GetPath()])
    if len(mesh.triangles):
        _add_mesh(stage, mesh, corners, slot_joints)
    with replace_atomically(target) as part:
        stage.GetRootLayer().Export(str(part))
    return None


def _load_usd(name: str) -> Any:
    """Return a module of OpenUSD, whose packages have no types. Raises ModuleNotFoundError."""
    return import_module(f"pxr.{name}")


def _add_mesh(stage: Any, mesh: GltfMesh, corners: Float[np.ndarray, "V 3"], slot_joints: Int[np.ndarray, " S"]) -> None:
    """Add the mesh, in its bind pose, to a stage with the skeleton."""
    usd_geom, usd_skel, vt = map(_load_usd, ("UsdGeom", "UsdSkel", "Vt"))
    geometry = usd_geom.Mesh.Define(stage, f"{ROOT_PATH}/Mesh")
    points = vt.Vec3fArray.FromNumpy(corners.astype("f4"))
    geometry.CreatePointsAttr(points)
    geometry.CreateExtentAttr(usd_geom.PointBased.ComputeExtent(points))
    geometry.CreateFaceVertexCountsAttr(vt.IntArray(len(mesh.triangles), 3))
    geometry.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(mesh.triangles.astype("i4").ravel()))
    geometry.CreateSubdivisionSchemeAttr(usd_geom.Tokens.none)
    colours = (mesh.colours**SRGB_EXPONENT).astype("f4")
    geometry.CreateDisplayColorPrimvar(usd_geom.Tokens.uniform).Set(vt.Vec3fArray.FromNumpy(colours))
    binding = usd_skel.BindingAPI.Apply(geometry.GetPrim())
    count = mesh.slots.shape[1]
    binding.CreateJointIndicesPrimvar(False, count).Set(vt.IntArray.FromNumpy(slot_joints[mesh.slots].astype("i4").ravel()))
    binding.CreateJointWeightsPrimvar(False, count).Set(vt.FloatArray.FromNumpy(mesh.weights.astype("f4").ravel()))
    binding.CreateSkeletonRel().SetTargets([f"{ROOT_PATH}/Skeleton"])


def _list_joints(nodes: GltfNodes, document: dict[str, Any], animation: dict[str, Any], mesh: GltfMesh) -> list[int]:
    """Return the nodes of all skins, of the mesh and of the animation, and those above them, parents before children."""
    used = {int(node) for node in mesh.nodes} | {channel["target"]["node"] for channel in animation["channels"]}
    used |= {joint for skin in document.get("skins", []) for joint in skin["joints"]}
    used |= {above for node in used for above in nodes.list_ancestors(node)}
    return [node for node in nodes.ordered if node in used]


def _compute_local(rigid: Float[np.ndarray, "T J 4 4"], parents: Int[np.ndarray, " J"]) -> Float[np.ndarray, "T J 4 4"]:
    """Return rigid matrices in the world as those to each joint's parent."""
    local = rigid.copy()
    local[..., :3, 3], local[..., :3, :3] = decompose_transforms(rigid[..., :3, 3], rigid[..., :3, :3], parents)
    return local
