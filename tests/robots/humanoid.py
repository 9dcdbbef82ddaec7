"""A humanoid of simple shapes as the text of an MJCF or a URDF, with or without some of its joints."""

from typing import NamedTuple

import numpy as np

AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
SPEED_LIMITS = {"hip": 14.0, "knee": 12.5, "arm": 10.0}  # radians per second; URDF states them
LENGTHS = {"thigh": 0.4, "shin": 0.4, "upper_arm": 0.28, "forearm": 0.25}
"""Lengths of the limbs in metres."""
SOLE = ((-0.07, 0.045, -0.07), (-0.07, -0.045, -0.07), (0.15, 0.045, -0.07), (0.15, -0.045, -0.07))
"""Corners of a sole in the axes of the foot, metres: heel left and right, front left and right."""
TURNS = {
    "hip": {"y": (-140, 60), "x": (-50, 50), "z": (-60, 60)},
    "shoulder": {"y": (-180, 90), "x": (-170, 170), "z": (-120, 120)},
    "ankle": {"y": (-60, 50), "x": (-30, 30)},
    "wrist": {"y": (-80, 80), "x": (-80, 80)},
    "neck": {"z": (-80, 80), "y": (-50, 60)},
}
"""Limits in degrees by joint and axis."""


class Part(NamedTuple):
    """A link and the joint that moves it, or none."""

    name: str
    parent: str
    offset: tuple[float, float, float]
    axis: str = ""
    limits: tuple[float, float] = (0, 0)
    shape: tuple[str, tuple[float, float, float], tuple[float, ...]] | None = None  # kind, centre, sizes in metres


def list_parts(*, neck=True, waist=True, root="pelvis", hips="yxz", wrist=True, ankle="yx") -> list[Part]:
    """Return the links of a humanoid, parents first."""
    turn = ("z", (-90, 90)) if waist else ("", (0, 0))
    pelvis = ("capsule", (0, 0, -0.1), (0.09, 0.02))
    trunk = ("capsule", (0, 0, 0.22), (0.1, 0.12))
    if root == "pelvis":
        parts = [Part("pelvis", "", (0, 0, 0), shape=pelvis), Part("trunk", "pelvis", (0, 0, 0), *turn, trunk)]
    else:
        parts = [Part("trunk", "", (0, 0, 0), shape=trunk), Part("pelvis", "trunk", (0, 0, 0), *turn, pelvis)]

    def add_joints(name: str, parent: str, offset, axes: str, last: str, shape) -> None:
        for axis in axes:
            is_last = axis == axes[-1]
            link = last if is_last else f"{last}_{axis}"
            limits = TURNS[name][axis]
            parts.append(Part(link, parent, offset, axis, limits, shape if is_last else None))
            parent, offset = link, (0, 0, 0)

    if neck:
        add_joints("neck", "trunk", (0, 0, 0.45), "zy", "head", ("sphere", (0, 0, 0.12), (0.09,)))
    for side, sign in (("left", 1), ("right", -1)):
        limb = {name: ("capsule", (0, 0, -length / 2), (0.045, length / 2 - 0.06)) for name, length in LENGTHS.items()}
        add_joints("hip", "pelvis", (0, 0.1 * sign, -0.15), hips, f"{side}_thigh", limb["thigh"])
        parts.append(Part(f"{side}_shin", f"{side}_thigh", (0, 0, -LENGTHS["thigh"]), "y", (0, 140), limb["shin"]))
        foot = ("box", (0.04, 0, -0.05), (0.11, 0.045, 0.02))
        add_joints("ankle", f"{side}_shin", (0, 0, -LENGTHS["shin"]), ankle, f"{side}_foot", foot)
        add_joints("shoulder", "trunk", (0, 0.2 * sign, 0.38), "yxz", f"{side}_upper_arm", limb["upper_arm"])
        at = (0, 0, -LENGTHS["upper_arm"])
        parts.append(Part(f"{side}_forearm", f"{side}_upper_arm", at, "y", (-150, 0), limb["forearm"]))
        at, hand = (0, 0, -LENGTHS["forearm"]), ("capsule", (0, 0, -0.06), (0.03, 0.03))
        if wrist:
            add_joints("wrist", f"{side}_forearm", at, "yx", f"{side}_hand", hand)
        else:
            parts.append(Part(f"{side}_hand", f"{side}_forearm", at, shape=hand))
    return parts


def _join(values) -> str:
    return " ".join(f"{value:g}" for value in values)


def build_mjcf(parts: list[Part], extra: str = "") -> str:
    """Return MJCF in degrees, the default, with the axes and colliding shapes in default classes."""

    def nest(part: Part) -> str:
        joint = f'<joint name="{part.name}_joint" class="about_{part.axis}" range="{_join(part.limits)}"/>' if part.axis else ""
        joint = joint if part.parent else '<freejoint name="base"/>'
        shape = ""
        if part.shape:
            kind, centre, size = part.shape
            shape = f'<geom type="{kind}" pos="{_join(centre)}" size="{_join(size)}" class="solid"/>'
        inertial = '<inertial pos="0 0 -0.05" mass="1" diaginertia="0.01 0.01 0.01"/>'
        below = "".join(nest(each) for each in parts if each.parent == part.name)
        return f'<body name="{part.name}" pos="{_join(part.offset)}">{inertial}{joint}{shape}{below}</body>'

    classes = "".join(f'<default class="about_{name}"><joint axis="{axis}"/></default>' for name, axis in AXES.items())
    default = f'<default>{classes}<default class="solid"><geom contype="1" conaffinity="1"/></default></default>'
    return f'<mujoco model="own">{default}<worldbody>{nest(parts[0])}</worldbody>{extra}</mujoco>'


def build_urdf(parts: list[Part], extra: str = "") -> str:
    """Return a URDF of the same robot; capsules are cylinders."""
    text = ""
    for part in parts:
        shape = ""
        if part.shape:
            kind, centre, size = part.shape
            geometry = {
                "box": lambda s: f'<box size="{_join(2 * np.array(s))}"/>',
                "sphere": lambda s: f'<sphere radius="{s[0]}"/>',
                "capsule": lambda s: f'<cylinder radius="{s[0]}" length="{2 * s[1]}"/>',
            }[kind](size)
            shape = f'<collision><origin xyz="{_join(centre)}"/><geometry>{geometry}</geometry></collision>'
        inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
        text += f'<link name="{part.name}"><inertial><mass value="1"/>{inertia}</inertial>{shape}</link>'
        if part.parent:
            speed = next((each for name, each in SPEED_LIMITS.items() if name in part.name), 9.0)
            low, high = np.radians(part.limits)
            limit = f'<axis xyz="{AXES.get(part.axis)}"/><limit lower="{low}" upper="{high}" effort="50" velocity="{speed}"/>'
            kind, limit = ("revolute", limit) if part.axis else ("fixed", "")
            text += (
                f'<joint name="{part.name}_joint" type="{kind}"><parent link="{part.parent}"/><child link="{part.name}"/>'
                f'<origin xyz="{_join(part.offset)}"/>{limit}</joint>'
            )
    return f'<robot name="own">{text}{extra}</robot>'
