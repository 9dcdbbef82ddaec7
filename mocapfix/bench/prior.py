"""What the priors are worth: the benchmark of MNN-IK, and of what a prior must not do."""

from pathlib import Path

import numpy as np

from mocapfix import prior
from mocapfix.bench import all_joints, contenders, given_joints, iterations, limb, speed, unseen
from mocapfix.bench.contenders import Contender, Shelf
from mocapfix.clock import Progress
from mocapfix.errors import SceneError
from mocapfix.prior.contract import PoseModel
from mocapfix.scenes import PRIOR
from mocapfix.skeleton import cmu31

SETS = 3  # of joints for each pose
FEW = 200  # poses are enough for curves


def measure(data: Path | None, frames: int, paper_split: Path | None, curves: bool, progress: Progress) -> dict:
    """-> every figure of the benchmark, ready for JSON.

    data         a folder of motion whose `test` subjects are the poses; None for the poses that ship. Limbs are lost in motion
                 alone, in that of its test.npz
    frames       how many poses, at most
    paper_split  a folder of weights trained on MNN-IK's own split, whose test is then done, too; needs `data`
    curves       whether to follow the errors over the iterations

    Raises SceneError or ReadError where data or weights are not what they must be.
    """
    if frames < 1:
        raise SceneError(f"Of {frames} poses nothing can be measured; ask for one at least.")
    if paper_split and not data:
        raise SceneError("The paper's split is of the motion that was learned from; say with --data where it is.")
    shelf, middle = contenders.shelf(), prior.load("mean-pose", cmu31().skeleton).rotations
    progress("reading")
    poses = unseen.of_subjects(data, frames) if data else unseen.shipped()
    poses = poses[np.linspace(0, len(poses) - 1, min(frames, len(poses))).astype(int)]
    said = {"poses": len(poses), "sets": SETS, "default": PRIOR} | compared(poses, shelf, middle, progress)
    said["all_joints"] = all_joints.measure(poses, shelf, middle, progress)
    said["bias_mm"] = said["all_joints"][PRIOR]["bias_mm"]
    said |= speed.measure(poses, shelf[PRIOR], middle, progress)
    said["limb"] = limbs(data, shelf[PRIOR], progress)
    if paper_split and data:
        said["paper_split"] = compared(unseen.between(data, frames), contenders.shelf(paper_split), middle, progress)
    if curves:
        said["iterations"] = iterations.measure(poses[:: -(-len(poses) // FEW)], shelf, middle, PRIOR, progress)
    return said


def compared(poses: np.ndarray, shelf: Shelf, middle: np.ndarray, progress: Progress) -> dict:
    """-> `given_joints`, and by how much the default is `better` than the others."""
    said = given_joints.measure(poses, shelf, middle, SETS, progress)
    return {"given_joints": said, "better": given_joints.better(said, PRIOR)}


def limbs(data: Path | None, model: Contender, progress: Progress) -> dict | None:
    """-> how far lost limbs are off, see `limb.run`; None where there is no motion to lose them in."""
    if data is None or not (data / "test.npz").is_file() or not isinstance(model, PoseModel):
        return None
    return limb.run(data, model, progress=progress)
