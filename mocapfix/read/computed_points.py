"""Computed points: trajectories that a program computed from markers, recognised by their names and the lists of the file.

Joint centres, bone axes, virtual markers, centres of mass and the outputs of models are positions that no camera measured. They
are kept in the file and are no evidence of where markers are. Points that are exact functions of markers are recognised by their
trajectories instead (`mocapfix.stats.point_function_search`).
"""

import re
from collections.abc import Sequence, Set

import numpy as np
from jaxtyping import Bool

# Outputs of models that are no positions but angles, forces and the like, as Vicon's models name them.
MODEL_OUTPUT_PATTERN = re.compile(r".*(Angles?|Forces?|Moments?|Powers?|GRF)")
CENTRE_OF_MASS_PATTERN = re.compile(r".*(CentreOfMass(Floor)?)|(.+[ _.])?(CoM|CoG|COM|COG|CenterOfMass|CenterOfGravity)")
# Centres of joints, without separators and in capitals: LHJC, R_Knee_JC, LeftHipCenter, LHipJointCentre_static.
_SIDE = "(L|R|LEFT|RIGHT)?"
_JOINT = "(HIP|KNEE|KNE|ANKLE|ANK|SHOULDER|SHO|ELBOW|ELB|WRIST|WRI)"
JOINT_CENTRE_PATTERN = re.compile(
    rf"(V|MID)?{_SIDE}({_JOINT}|GH|H|K|A|S|E|W)JC(L|R|LEFT|RIGHT|S|STATIC|FUNC|FUNCTIONAL)?\d*|{_SIDE}{_JOINT}(JOINT)?CENT(ER|RE).*"
)
VIRTUAL_PATTERN = re.compile(r"(?<![a-z])virtual(?![a-z])", re.IGNORECASE)
COMPUTED_DESCRIPTION_PATTERN = re.compile(r"\b(virtual|computed|calculated|joint cent(er|re)|model output)\b", re.IGNORECASE)
NAME_SEPARATORS = re.compile(r"[\s_.\-]")

# Points of one segment: its origin and the ends of its axes, named by the same stem with each of these suffixes.
SEGMENT_SUFFIXES = (("O", "A", "L", "P"), ("O", "X", "Y", "Z"))
# Stems of Plug-in Gait's segments. Their origins are recognised where a file has only some of the four points.
PLUG_IN_GAIT_STEMS = frozenset(
    ("PEL", "LFE", "RFE", "LTI", "RTI", "LFO", "RFO", "LTO", "RTO", "HED", "LCL", "RCL", "TRX", "LHU", "RHU", "LRA", "RRA",
     "LHN", "RHN")
)  # fmt: skip
PLUG_IN_GAIT_STEM_LENGTH = 3


def strip_subject_prefix(label: str) -> str:
    """Return a label without the name of the subject before it: "LFHD" for "Jim:LFHD"."""
    return label.rsplit(":", 1)[-1].strip()


def find_model_outputs(labels: Sequence[str], listed: Set[str]) -> Bool[np.ndarray, " P"]:
    """Return which points are outputs of models that are no positions: angles, forces, moments, powers, scalars.

    Args:
        labels: Labels of the P points, without blanks around them.
        listed: Labels that the file lists as such outputs.
    """
    return np.array(
        [label in listed or MODEL_OUTPUT_PATTERN.fullmatch(strip_subject_prefix(label)) is not None for label in labels], bool
    )


def find_named_computed_points(labels: Sequence[str], descriptions: Sequence[str], listed: Set[str]) -> Bool[np.ndarray, " P"]:
    """Return which points are positions that a program computed, by their names, their descriptions or the file's lists.

    Args:
        labels: Labels of the P points, without blanks around them.
        descriptions: Descriptions of the points in the file; there may be more or fewer.
        listed: Labels that the file lists as modelled markers.
    """
    names = set(labels)
    padded = [*descriptions[: len(labels)], *[""] * (len(labels) - len(descriptions))]
    return np.array(
        [
            bool(
                label in listed
                or _is_computed_name(strip_subject_prefix(label))
                or _is_segment_point(label, names)
                or COMPUTED_DESCRIPTION_PATTERN.search(description)
            )
            for label, description in zip(labels, padded, strict=True)
        ],
        bool,
    )


def _is_computed_name(name: str) -> bool:
    return (
        CENTRE_OF_MASS_PATTERN.fullmatch(name) is not None
        or VIRTUAL_PATTERN.search(name) is not None
        or JOINT_CENTRE_PATTERN.fullmatch(NAME_SEPARATORS.sub("", name).upper()) is not None
    )


def _is_segment_point(label: str, names: Set[str]) -> bool:
    """Return whether a label names the origin of a segment or the end of one of its axes."""
    stem, suffix = label[:-1], label[-1:]
    bare_stem = strip_subject_prefix(stem)
    if bare_stem in PLUG_IN_GAIT_STEMS and suffix in SEGMENT_SUFFIXES[0] and f"{stem}O" in names:
        return True
    return any(
        suffix in suffixes and all(stem + each in names for each in suffixes)
        for suffixes in SEGMENT_SUFFIXES
        if len(bare_stem) == PLUG_IN_GAIT_STEM_LENGTH or (suffixes != SEGMENT_SUFFIXES[0] and bare_stem)
    )
