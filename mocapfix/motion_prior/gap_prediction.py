"""The motion prior's prediction of a gap, for any body with the 31 joints."""

import numpy as np

from mocapfix.motion_prior.gap_combination import GapContext, GapPrediction
from mocapfix.motion_prior.model import MotionPrior, load_shipped_motion_prior
from mocapfix.motion_prior.motion_features import build_motion_tree
from mocapfix.skeleton import load_cmu31_body


def predict_model_gap(prior: MotionPrior, context: GapContext, size_ratio: float = 1.0) -> GapPrediction | None:
    """Return the prediction of the 31 joints in a gap; None if it cannot be predicted.

    context     with the 31 joints
    size_ratio  size of the body relative to the average one
    """
    tree, names = build_motion_tree(), load_cmu31_body().skeleton.names
    folded, is_known = context.local_rotations.copy(), context.is_known[:, tree.joints].copy()
    for i, j in enumerate(tree.joints):
        if names[j].endswith("Arm") and not names[j].endswith("ForeArm"):
            folded[:, j] = folded[:, j - 1] @ folded[:, j]
            is_known[:, i] &= context.is_known[:, j - 1] | ~context.is_known[:, j - 1].any()
    gap = prior.predict_gap(context.root_position / size_ratio, folded, is_known, context.first, context.last, context.rate_hz)
    if gap is None:
        return None
    rotations = context.local_rotations[context.frames].copy()
    variance = np.full(rotations.shape[:2], np.inf)
    for i, j in enumerate(tree.joints):
        rotations[:, j] = gap.local_rotations[:, i]
        if names[j].endswith("Arm") and not names[j].endswith("ForeArm"):
            rotations[:, j] = np.swapaxes(rotations[:, j - 1], -1, -2) @ rotations[:, j]
    variance[:, tree.joints] = gap.rotation_sd_rad**2
    return GapPrediction(rotations, variance, size_ratio * gap.root_position, (size_ratio * gap.root_sd_m) ** 2)


def predict_shipped_gap(context: GapContext, size_ratio: float = 1.0) -> GapPrediction | None:
    """Return the prediction of `predict_model_gap` by the shipped motion prior, which is read when it is first needed."""
    return predict_model_gap(load_shipped_motion_prior(), context, size_ratio)
