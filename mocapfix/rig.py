"""A rig: the skeleton as another program wants it. Its names, its tree, its rest pose, its unit."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field, PositiveFloat

from mocapfix.errors import SceneError
from mocapfix.scenes import RIGS, folder, load_yaml
from mocapfix.yaml_form import Stated, checked


class Joint(Stated):
    """One joint of a rig.

    name    as the program knows it;  parent  the rig's joint it hangs on, null for the root, which comes first
    joint   the skeleton's joint that is there; by default the one of the same name
    axes    the skeleton's joint with which it turns; by default `joint`
    end     of a last bone: the skeleton's joint whose end (its place, where it has none) is the bone's; by default `axes`
    """

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    parent: str | None
    joint: str = ""
    axes: str = ""
    end: str = ""

    def model_post_init(self, _: object) -> None:
        for key, given in (("joint", self.joint or self.name), ("axes", self.axes or self.joint or self.name)):
            object.__setattr__(self, key, given)
        object.__setattr__(self, "end", self.end or self.axes)


class _Form(Stated):
    program: str
    unit_m: PositiveFloat
    rotations: Literal["ZYX", "ZXY", "YXZ", "YZX", "XYZ", "XZY"]
    rest: Literal["t-pose", "arms-down", "skeleton"]
    first_frame: Literal["t-pose", "motion"]
    note: str
    joints: tuple[Joint, ...] = Field(min_length=1)


@dataclass(frozen=True)
class Rig:
    """How a program wants a skeleton.

    name         the file's, as in --bvh-for;  program  who wants it so
    unit         metres in one unit of the file
    rotations    the order of a joint's channels, first the one that turns last: "ZYX" is R = Rz Ry Rx
    rest         the pose that no rotation at all means: "t-pose", "arms-down" or the "skeleton"'s own
    t_pose       does a T-pose facing +Z, standing on the floor where the motion begins, come before the motion?
    note         what whoever opens it must know, for the report
    joints       parents before children
    """

    name: str
    program: str
    unit: float
    rotations: str
    rest: str
    t_pose: bool
    note: str
    joints: tuple[Joint, ...]

    @property
    def parents(self) -> list[int]:
        names = [joint.name for joint in self.joints]
        return [names.index(joint.parent) if joint.parent else -1 for joint in self.joints]


def load(name: str | Path) -> Rig:
    """-> a shipped rig, by its name, or one from a YAML file.

    Raises SceneError where there is none of the name, or naming the key that is not as it must be.
    """
    path = Path(name) if str(name).endswith((".yaml", ".yml")) else folder("scenes") / "rigs" / f"{name}.yaml"
    if path.parent == folder("scenes") / "rigs" and path.stem not in RIGS:
        raise SceneError(f"There is no rig {str(name)!r}; choose of: {', '.join(RIGS)}; or give a .yaml file.")
    form = checked(_Form, path)
    seen: set[str | None] = set()
    for joint in form.joints:
        if joint.name in seen or (joint.parent not in seen if seen else joint.parent is not None):
            raise SceneError(f"{path}: joints: {joint.name}: must come once, after its parent; the first alone is the root.")
        seen.add(joint.name)
    t_pose = form.first_frame == "t-pose"
    return Rig(path.stem, form.program, form.unit_m, form.rotations, form.rest, t_pose, form.note, form.joints)


def pose(name: str) -> dict[str, tuple[str, list[float]]]:
    """-> by joint of the skeleton, the joint at its bone's other end and which way the bone points in a pose."""
    return {joint: (end, way) for joint, (end, way) in load_yaml("rigs/poses.yaml")[name].items()}
