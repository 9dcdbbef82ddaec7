"""Types of values in YAML files that describe bodies: joint names and vectors."""

from typing import Annotated

from pydantic import AfterValidator, FiniteFloat

from mocapfix.errors import format_name_list
from mocapfix.skeleton import load_cmu31_body


def _validate_joint_name(name: str) -> str:
    names = load_cmu31_body().skeleton.names
    if name not in names:
        raise ValueError(f"there is no joint {name!r}; the joints are {format_name_list(names)}")
    return name


Vector3 = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
JointName = Annotated[str, AfterValidator(_validate_joint_name)]
