"""A robot: a tree of links with joints of one axis, its limits and collision primitives, and which links form a body.

Inside this package lengths are metres, Z is up and X forward, as robots have them: at zero angles a robot stands and looks along
X. Joint positions are those of MuJoCo's `qpos`: radians, metres for slides, in the order of the file.

`load_robot` reads MJCF and URDF by MuJoCo's own parser and compiler; it needs the extra `robot`. The compiled model has the
defaults, includes, units and frames of the file resolved. Read are the links below the first free joint with most joints: a URDF
and an MJCF without a free joint get one. Links that are fixed to others are kept. Meshes that are missing are left out; those
that are there and can collide are replaced by capsules along their longest extent.
"""

import importlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError, SceneError, format_name_list
from mocapfix.solve.trajectory import CollisionTerm

SIDES = ("left", "right")
LIMBS = tuple(f"{side}_{limb}" for side in SIDES for limb in ("upper_arm", "forearm", "thigh", "shin"))
"""The segments whose directions a robot keeps."""
SOLE_CORNERS = ("heel left", "heel right", "toe left", "toe right")


@dataclass(frozen=True)
class Robot:
    """A humanoid of L links and N joints of one axis each; the root, link 0, moves freely.

    Links that are fixed to others stay links of their own. A link is where its file has it at zero angles.
    """

    name: str
    link_names: tuple[str, ...]
    parents: Int[np.ndarray, " L"]  # -1 for the root; parents come before their children
    link_positions: Float[np.ndarray, "L 3"]  # in the parent's axes, metres
    link_rotations: Float[np.ndarray, "L 3 3"]  # link axes to parent axes, of the root to the world
    masses: Float[np.ndarray, " L"]  # kg
    mass_centres: Float[np.ndarray, "L 3"]  # in the axes of the link, metres
    joint_names: tuple[str, ...]
    joint_links: Int[np.ndarray, " N"]  # the link that a joint moves, ascending; the joints of one link act one after the other
    joint_axes: Float[np.ndarray, "N 3"]  # unit vectors in the axes of the link
    joint_anchors: Float[np.ndarray, "N 3"]  # in the axes of the link, metres
    is_slide: Bool[np.ndarray, " N"]
    zero_positions: Float[np.ndarray, " N"]  # joint positions at which the links are where the file has them
    limits: Float[np.ndarray, "N 2"]  # of positions, infinite without a limit
    speed_limits: Float[np.ndarray, " N"]  # radians or metres per second, infinite where no file states one
    # joints that follow others: follower, leader, offset, factor
    couplings: tuple[tuple[int, int, float, float], ...]
    # in the axes of the links: capsules, whose ends coincide where they are spheres, and boxes, each also with a row of capsules
    # inside it, for pairs of two boxes; pairs are of links that the file lets meet and that are more than two joints apart
    collision: CollisionTerm
    outline: tuple[tuple[int, Float[np.ndarray, "P 3"]], ...] = ()  # links and corners of their meshes, or their sites, metres
    notes: tuple[str, ...] = ()  # sentences for the report on how the file was read


@dataclass(frozen=True)
class LinkPoint:
    """A point of a link, in its axes, metres."""

    link: int
    position: Float[np.ndarray, " 3"]


@dataclass(frozen=True)
class RobotMap:
    """Which links form the body of a robot; all rotations are relative to the robot at zero angles.

    Attributes:
        limbs: Segment (of LIMBS) to the points from which and to which it runs.
        feet: Side to the link of the foot.
        soles: Side to the corners of the sole, in the order of SOLE_CORNERS, in the axes of the foot's link, metres.
        pelvis, trunk, head: Links; the same link where no joint is between. `trunk` carries the arms.
        hands: Side to the outermost link of the arm, if a joint moves it relative to the forearm.
        standing: Joint positions of an upright stance with straight knees, (N,), those of the file where it stands so:
            rotations of pelvis, trunk, head and feet are compared with the performer's from this pose.
        reason: Sentence on how the map was found.
        keeps_balance: Whether the centre of mass is kept over standing feet as far as the performer's is.
    """

    limbs: Mapping[str, tuple[LinkPoint, LinkPoint]]
    feet: Mapping[str, int]
    soles: Mapping[str, Float[np.ndarray, "4 3"]]
    pelvis: int
    trunk: int
    head: int
    hands: Mapping[str, int]
    standing: Float[np.ndarray, " N"]
    reason: str = ""
    keeps_balance: bool = False


FREE, BALL, SLIDE, HINGE = 0, 1, 2, 3  # MuJoCo's types of joints
SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = 2, 3, 4, 5, 6, 7  # and of shapes
JOINT_EQUALITY = 2
MAX_JOINTS_APART = 2  # links at most so many joints apart may touch: their shapes overlap at the joints between them
CYLINDER_ROUNDING = 0.5  # how much of its radius the half-length of a cylinder loses as a capsule
MESH_RADIUS_PERCENTILE = 75.0  # of the distances of a mesh's corners from its axis: the radius of its capsule
SMALLEST_MASS = 1e-6  # kg and kg m^2, of links whose mass is that of a missing mesh


def load_robot(path: str | Path) -> Robot:
    """Read a robot.

    Raises:
        ReadError: If the file is not MJCF or URDF, or MuJoCo is not installed.
        SceneError: If it is not a robot of hinges and slides.
    """
    path = Path(path)
    model, notes = compile_model(path)
    links = _list_links(model, path)
    index = {body: link for link, body in enumerate(links)}
    joints = [j for j in range(model.njnt) if int(model.jnt_bodyid[j]) in index and model.jnt_type[j] != FREE]
    if balls := [model.joint(j).name for j in joints if model.jnt_type[j] == BALL]:
        raise SceneError(f"{path.name}: joint {format_name_list(balls)} is a ball joint; replace it by three hinges.")
    names = [model.joint(j).name or f"joint {j}" for j in joints]
    positions = model.jnt_qposadr[joints]
    speeds, speed_notes = _read_speed_limits(path, names)
    is_limited = model.jnt_limited[joints].astype(bool)
    return Robot(
        path.stem,
        tuple(model.body(body).name or f"link {body}" for body in links),
        np.array([index.get(int(model.body_parentid[body]), -1) for body in links]),
        np.array(model.body_pos[links]),
        _convert_quaternions(model.body_quat[links]),
        np.array(model.body_mass[links]),
        np.array(model.body_ipos[links]),
        tuple(names),
        np.array([index[int(model.jnt_bodyid[j])] for j in joints], int),
        np.array(model.jnt_axis[joints]),
        np.array(model.jnt_pos[joints]),
        np.array(model.jnt_type[joints] == SLIDE),
        np.array(model.qpos0[positions]),
        np.where(is_limited[:, None], model.jnt_range[joints], [-np.inf, np.inf]),
        speeds,
        _list_couplings(model, joints, path),
        _build_collision(model, index),
        _list_outlines(model, index),
        (*notes, *speed_notes),
    )


def compile_model(path: Path) -> tuple[Any, list[str]]:
    """Return MuJoCo's model, and sentences on what was changed."""
    try:
        mujoco: Any = importlib.import_module("mujoco")
    except ImportError:
        raise ReadError(f"{path.name}: robots need MuJoCo; install it with: pip install 'mocapfix[robot]'.") from None
    notes: list[str] = []
    try:
        is_urdf = ElementTree.parse(path).getroot().tag == "robot"
        spec: Any = mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic, spec.compiler.balanceinertia = False, True
        spec.compiler.boundmass = spec.compiler.boundinertia = SMALLEST_MASS
        bodies = spec.worldbody.bodies
        if bodies and (is_urdf or not any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in spec.joints)):
            max(bodies, key=lambda body: len(body.find_all("joint"))).add_freejoint()
        try:
            return spec.compile(), notes
        except ValueError as error:
            if "mesh" not in str(error).lower() and "file" not in str(error).lower():
                raise
        shapes = [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH]
        for each in (*shapes, *spec.meshes, *spec.textures, *spec.materials, *spec.skins, *spec.hfields):
            spec.delete(each)
        notes.append("Its meshes are missing: soles and collisions are by the other shapes.")
        return spec.compile(), notes
    except OSError as error:
        raise ReadError(f"{path.name}: cannot be read: {error.strerror or error}.") from None
    except (ValueError, ElementTree.ParseError) as error:
        reason = " ".join(str(error).split())
        raise ReadError(f"{path.name}: MuJoCo cannot read this robot: {reason}") from None


def _list_links(model: Any, path: Path) -> list[int]:
    """Return the bodies of the free tree with most joints, the root first."""
    counts = {int(model.jnt_bodyid[j]): 0 for j in range(model.njnt) if model.jnt_type[j] == FREE}
    for j in range(model.njnt):
        root = int(model.body_rootid[model.jnt_bodyid[j]])
        if root in counts:
            counts[root] += 1
    if not counts or max(counts.values()) < 2:
        raise SceneError(f"{path.name}: no tree of links with joints was found; give the file of a whole robot.")
    root = max(counts, key=lambda body: counts[body])
    return [body for body in range(1, model.nbody) if int(model.body_rootid[body]) == root]


def _convert_quaternions(wxyz: Any) -> np.ndarray:
    return np.ascontiguousarray(Rotation.from_quat(np.asarray(wxyz)[..., [1, 2, 3, 0]]).as_matrix())


def _read_speed_limits(path: Path, names: list[str]) -> tuple[np.ndarray, list[str]]:
    """Return the speed limits of joints, which MuJoCo does not keep, from the URDF or one beside the MJCF, and sentences."""
    for candidate in [path, *(each for each in sorted(path.parent.glob("*.urdf")) if each != path)]:
        try:
            root = ElementTree.parse(candidate).getroot()
            joints = {each.get("name"): each.find("limit") for each in root.findall("joint")} if root.tag == "robot" else {}
            speeds = np.array([0.0 if (limit := joints[name]) is None else float(limit.get("velocity", 0)) for name in names])
        except (OSError, ValueError, KeyError, ElementTree.ParseError):
            continue
        silent = [name for name, speed in zip(names, speeds, strict=True) if not speed > 0.0]
        if len(silent) < len(names):
            notes = [f"Its speed limits are those of {candidate.name}."] * (candidate != path)
            notes += [f"No speed limit is stated for {format_name_list(silent)}."] * bool(silent)
            return np.where(speeds > 0.0, speeds, np.inf), notes
    return np.full(len(names), np.inf), ["It states no speed limits; a URDF beside it with the same joints would."]


def _list_couplings(model: Any, joints: list[int], path: Path) -> tuple[tuple[int, int, float, float], ...]:
    """Return the joints that follow others: follower, leader, offset and factor."""
    place, zero = {joint: k for k, joint in enumerate(joints)}, model.qpos0[model.jnt_qposadr]
    found: dict[int, tuple[int, int, float, float]] = {}
    is_active = (model.eq_type == JOINT_EQUALITY) & np.asarray(model.eq_active0, bool)
    equalities = [int(k) for k in np.flatnonzero(is_active) if int(model.eq_obj1id[k]) in place]
    free = [joint for joint in joints if joint not in model.eq_obj1id[equalities]]
    if not free:
        raise SceneError(f"{path.name}: no joint can move: each is locked or follows another one.")
    for k in equalities:
        follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        if leader >= 0 and leader not in place:
            continue
        offset, factor, *higher = model.eq_data[k, :5]
        if np.any(higher):
            name = model.joint(follower).name
            raise SceneError(f"{path.name}: joint {name} follows another one by a polynomial; only linear couplings can be used.")
        leader, factor = (leader, factor) if leader >= 0 else (free[0], 0.0)  # of a joint that is locked: any, by a factor of 0
        offset = float(zero[follower] + offset - factor * zero[leader])
        found[place[follower]] = place[follower], place[leader], offset, float(factor)
    if any(leader in found for _, leader, _, _ in found.values()):
        raise SceneError(f"{path.name}: a joint follows one that follows another; couple both to the same joint.")
    return tuple(found.values())


def _build_collision(model: Any, index: dict[int, int]) -> CollisionTerm:
    """Return the shapes that can collide, which keep no distance yet."""
    capsules: list[tuple[int, np.ndarray, np.ndarray, float, bool]] = []  # shape, ends, radius, whether it is part of a box
    boxes: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
    for geom in range(model.ngeom):
        if int(model.geom_bodyid[geom]) not in index or not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        kind, size, centre = int(model.geom_type[geom]), model.geom_size[geom], np.array(model.geom_pos[geom])
        axes = _convert_quaternions(model.geom_quat[geom])
        if kind == BOX:
            boxes.append((geom, centre, axes, np.array(size)))
            thin, middle, long = np.argsort(size)
            radius, along = float(size[thin]), axes[:, long] * (size[long] - size[thin])
            spread = float(size[middle] - size[thin])
            for shift in np.linspace(-spread, spread, int(np.ceil(spread / radius)) + 1) if spread > 0 else [0.0]:
                place = centre + shift * axes[:, middle]
                capsules.append((geom, place - along, place + along, radius, True))
            continue
        if kind == MESH:
            corners = _list_mesh_corners(model, geom)
            middle = corners.mean(axis=0)
            direction = np.linalg.svd(corners - middle, full_matrices=False)[2][0]
            share = (corners - middle) @ direction
            apart = np.linalg.norm(corners - middle - share[:, None] * direction, axis=1)
            radius = float(np.percentile(apart, MESH_RADIUS_PERCENTILE))
            low, high = share.min() + radius, share.max() - radius
            low, high = (low, high) if low < high else (0.5 * (low + high),) * 2
            first, last = (middle + each * direction for each in (low, high))
        else:
            half = {CAPSULE: size[1], CYLINDER: max(size[1] - CYLINDER_ROUNDING * size[0], 0.0)}.get(kind, 0.0)
            radius, along = float(size[0]), axes[:, 2] * half
            if kind == ELLIPSOID:
                long = int(np.argmax(size))
                radius = float(np.median(size))
                along = axes[:, long] * (size[long] - radius)
            elif kind not in (SPHERE, CAPSULE, CYLINDER):
                continue
            first, last = centre - along, centre + along
        capsules.append((geom, first, last, radius, False))
    pairs = [
        (i, j)
        for i, one in enumerate(capsules)
        for j, other in enumerate(capsules[:i])
        if one[4] == other[4] and may_collide(model, one[0], other[0])
    ]
    box_pairs = [
        (i, j)
        for i, one in enumerate(capsules)
        for j, other in enumerate(boxes)
        if not one[4] and may_collide(model, one[0], other[0])
    ]
    return CollisionTerm(
        np.array([index[int(model.geom_bodyid[each[0]])] for each in capsules], int),
        np.array([each[1:3] for each in capsules], float).reshape(-1, 2, 3),
        np.array([each[3] for each in capsules], float),
        np.array(pairs, int).reshape(-1, 2),
        np.array([index[int(model.geom_bodyid[each[0]])] for each in boxes], int),
        np.array([each[1] for each in boxes], float).reshape(-1, 3),
        np.array([each[2] for each in boxes], float).reshape(-1, 3, 3),
        np.array([each[3] for each in boxes], float).reshape(-1, 3),
        np.array(box_pairs, int).reshape(-1, 2),
        0.0,
        0.0,
    )


def _list_outlines(model: Any, index: dict[int, int]) -> tuple[tuple[int, np.ndarray], ...]:
    """Return links with the corners of their meshes, colliding or not, and with their sites."""
    places = [(int(body), np.array(model.site_pos[[k]])) for k, body in enumerate(model.site_bodyid)]
    places += [
        (int(model.geom_bodyid[geom]), _list_mesh_corners(model, int(geom))) for geom in np.flatnonzero(model.geom_type == MESH)
    ]
    return tuple((index[body], points) for body, points in places if body in index)


def _list_mesh_corners(model: Any, geom: int) -> np.ndarray:
    start, count = model.mesh_vertadr[model.geom_dataid[geom]], model.mesh_vertnum[model.geom_dataid[geom]]
    return model.mesh_vert[start : start + count] @ _convert_quaternions(model.geom_quat[geom]).T + model.geom_pos[geom]


def may_collide(model: Any, first: int, second: int) -> bool:
    """Return whether two shapes may collide: by the file, and by the number of joints between their links."""
    links = int(model.geom_bodyid[first]), int(model.geom_bodyid[second])
    types, affinities = model.geom_contype[[first, second]], model.geom_conaffinity[[first, second]]
    if not (types[0] & affinities[1]) and not (types[1] & affinities[0]):
        return False
    low, high = sorted(links)
    if ((low << 16) + high) in model.exclude_signature:
        return False
    paths: list[set[int]] = []
    for link in links:
        path, body = set[int](), int(model.body_weldid[link])
        while body:
            path.add(body)
            body = int(model.body_weldid[model.body_parentid[body]])
        paths.append(path)
    return len(paths[0] ^ paths[1]) > MAX_JOINTS_APART
