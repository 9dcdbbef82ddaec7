"""Fit how people's bones vary: python -m mocapfix.train.body_shape MOTION_FOLDER priors/shape.yaml

MOTION_FOLDER holds skeletons.json, where `offsets_asf` are the bones of a subject's own body. SUBJECTS are those of the
training split of which they are known. Each counts twice, as they are and mirrored, and as large as the average body:
size is another matter. What then differs is taken apart into principal components (SCOPE's shape parameters, Eqs. 60-64).
"""

import json
import sys
from pathlib import Path

import numpy as np
import yaml

from mocapfix.skeleton import load_cmu31_skeleton
from mocapfix.train.training_poses import mirror_joint_name

BODY_SUBJECTS = ("01", "03", "07", "11", "127", "14", "17", "29", "35")
MAX_SHAPE_COMPONENTS = 10  # components kept
SHAPE_HEADER = """\
# How people's bones differ from the average body's, at one size: principal components of the 31 joints' offsets, the
# largest first. Each is one standard deviation of it, in metres in the parent's axes; joints that it leaves alone are not
# listed. Together these {components} explain {explained:.0%} of the variance.
#
# Fitted by mocapfix.train.body_shape to no more than {subjects} subjects of the CMU database and their mirror images: the components
# hold what these few differ by most, the smaller ones hardly more than that, and anybody may differ otherwise.
#
# The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF
# EIA-0196217.
"""


def fit_shape_components(
    body_offsets: np.ndarray, mean_offsets: np.ndarray, mirrored_index: list[int], max_components: int
) -> tuple[np.ndarray, float]:
    """-> (P, J, 3) metres: P <= `most` components of one standard deviation; and the share of the variance they explain.

    bodies    (N, J, 3) people's offsets
    mean      (J, 3) the average body's
    mirrored  (J,) the joint on the other side
    """
    sizes = np.einsum("nja,ja->n", body_offsets, mean_offsets) / (mean_offsets**2).sum()
    away = body_offsets / sizes[:, None, None] - mean_offsets
    both = np.concatenate([away, away[:, mirrored_index] * [-1.0, 1.0, 1.0]])
    _, values, components = np.linalg.svd(both.reshape(len(both), -1), full_matrices=False)
    count = min(max_components, int((values > 1e-6 * values[0]).sum()))
    scaled = values[:count, None] / np.sqrt(len(both)) * components[:count]
    signs = np.sign(scaled[np.arange(count), np.abs(scaled).argmax(1)])
    return (signs[:, None] * scaled).reshape(count, *mean_offsets.shape), float((values[:count] ** 2).sum() / (values**2).sum())


def write_shape_components(motion_folder: str, target_path: str) -> None:
    data, skeleton = json.loads((Path(motion_folder) / "skeletons.json").read_text()), load_cmu31_skeleton()
    bodies = data["unit_to_metres"] * np.array([data["skeletons"][subject]["offsets_asf"] for subject in BODY_SUBJECTS])
    mirrored = [skeleton.find_joint(mirror_joint_name(name)) for name in skeleton.names]
    components, explained = fit_shape_components(bodies, skeleton.offsets, mirrored, MAX_SHAPE_COMPONENTS)
    rounded = [
        {
            name: [round(float(v), 5) + 0.0 for v in offset]
            for name, offset in zip(skeleton.names, component, strict=True)
            if np.abs(offset).max() >= 5e-6
        }
        for component in components
    ]
    text = yaml.safe_dump({"components": rounded}, sort_keys=False, default_flow_style=None, width=120)
    card = SHAPE_HEADER.format(components=len(components), explained=explained, subjects=len(BODY_SUBJECTS))
    Path(target_path).write_text(card + text)


if __name__ == "__main__":
    write_shape_components(*sys.argv[1:])
