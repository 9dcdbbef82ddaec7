"""Fit the shape components of bodies: python -m mocapfix.train.body_shape MOTION_FOLDER priors/shape.yaml

MOTION_FOLDER holds skeletons.json, whose `offsets_asf` are the joint offsets of each subject. BODY_SUBJECTS are the subjects of
the training split whose offsets are known. Each body is used twice, as measured and mirrored, and scaled to the size of the
average body, because size is a separate parameter. The components are principal components of the remaining differences (SCOPE's
shape parameters, Eqs. 60-64).
"""

import json
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mocapfix.skeleton import load_cmu31_skeleton
from mocapfix.train.mean_pose import write_prior_yaml
from mocapfix.train.training_poses import mirror_joint_name

BODY_SUBJECTS = ("01", "03", "07", "11", "127", "14", "17", "29", "35")
MAX_SHAPE_COMPONENTS = 10
MIN_WRITTEN_OFFSET_M = 5e-6  # a smaller offset is rounded to zero and not written
SHAPE_HEADER = """\
# Shape components of bodies: principal components of the 31 joints' offsets from those of the average body, at equal size,
# the largest first. Each is one standard deviation, in metres in the axes of the joint's parent; joints with zero offset
# are not listed. These {components} together explain {explained:.0%} of the variance.
#
# Fitted by mocapfix.train.body_shape to only {subjects} subjects of the CMU database and their mirror images: the components
# describe the largest differences between these few subjects, and other bodies may differ in other ways.
#
# The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF
# EIA-0196217.
"""


def fit_shape_components(
    body_offsets: Float[np.ndarray, "N J 3"],
    mean_offsets: Float[np.ndarray, "J 3"],
    mirrored_index: list[int],
    max_components: int,
) -> tuple[Float[np.ndarray, "P J 3"], float]:
    """Return the shape components, each one standard deviation in metres, and the share of the variance that they explain.

    body_offsets    offsets of the joints of N bodies
    mean_offsets    offsets of the average body
    mirrored_index  (J,) the joint on the other side
    """
    sizes = np.einsum("nja,ja->n", body_offsets, mean_offsets) / (mean_offsets**2).sum()
    differences = body_offsets / sizes[:, None, None] - mean_offsets
    both = np.concatenate([differences, differences[:, mirrored_index] * [-1.0, 1.0, 1.0]])
    _, values, components = np.linalg.svd(both.reshape(len(both), -1), full_matrices=False)
    count = min(max_components, int((values > 1e-6 * values[0]).sum()))
    scaled = values[:count, None] / np.sqrt(len(both)) * components[:count]
    signs = np.sign(scaled[np.arange(count), np.abs(scaled).argmax(1)])
    explained = float((values[:count] ** 2).sum() / (values**2).sum())
    return (signs[:, None] * scaled).reshape(count, *mean_offsets.shape), explained


def write_shape_components(motion_folder: str, target_path: str) -> None:
    """Fit shape components to the bodies in a folder of motion and write their file."""
    data, skeleton = json.loads((Path(motion_folder) / "skeletons.json").read_text()), load_cmu31_skeleton()
    offsets = [data["skeletons"][subject]["offsets_asf"] for subject in BODY_SUBJECTS]
    mirrored_index = [skeleton.find_joint(mirror_joint_name(name)) for name in skeleton.names]
    body_offsets = data["unit_to_metres"] * np.array(offsets)
    components, explained = fit_shape_components(body_offsets, skeleton.offsets, mirrored_index, MAX_SHAPE_COMPONENTS)
    rounded = [
        {
            name: [round(float(v), 5) + 0.0 for v in offset]
            for name, offset in zip(skeleton.names, component, strict=True)
            if np.abs(offset).max() >= MIN_WRITTEN_OFFSET_M
        }
        for component in components
    ]
    header = SHAPE_HEADER.format(components=len(components), explained=explained, subjects=len(BODY_SUBJECTS))
    write_prior_yaml(target_path, header, {"components": rounded})


if __name__ == "__main__":
    write_shape_components(*sys.argv[1:])
