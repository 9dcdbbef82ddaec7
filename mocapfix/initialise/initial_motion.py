"""Initialisation: a first pose for every frame, from which the solver starts.

The methods (`INIT_METHODS`) are:

learned       those of hybrik-x, and joints that no marker shows by learned inverse kinematics (`learned_start`)
hybrik-...    joint positions from the markers (`joint_positions`), and from these each frame's pose in closed form (`hybrik`)
registration  the subject's segments registered to the visible markers, down the tree (`segment_registration`)
previous      only the first frame is posed; every other starts from the solution of the frame before. This start is near, which
              saves some iterations, but frames cannot be solved in parallel, and a wrong solution affects the next frame.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int
from scipy.spatial.transform import Rotation

from mocapfix.files.option_choices import DEFAULT_INIT_METHOD
from mocapfix.initialise import joint_positions
from mocapfix.initialise.hybrik import HybrikVariant, solve_hybrik
from mocapfix.initialise.segment_registration import register_poses
from mocapfix.motion import FrameStatus, Motion
from mocapfix.options import CleanOptions
from mocapfix.pose_prior.mean_pose import MeanPosePrior, load_mean_pose_prior
from mocapfix.skeleton import BodyModel
from mocapfix.solve import kinematics
from mocapfix.solve.frame_windows import FrameChanges, change_all_frames, find_changed_frames
from mocapfix.state import CleaningState
from mocapfix.subject import Subject
from mocapfix.take import Take

MIN_MARKER_TRUST = 0.25
"""Robust weight below which a marker is not used by HybrIK; a marker 5 cm from its segment has this weight."""
LEARNED_METHOD = "learned"
HYBRIK_VARIANTS: dict[str, HybrikVariant] = {
    "hybrik-x": "x",
    LEARNED_METHOD: "x",
    "hybrik-adaptive": "adaptive",
    "hybrik-naive": "naive",
}
"""The HybrIK variant of each method."""
MAX_BLOCK_FRAMES = 4096
"""Frames that are posed at a time; a frame takes its root from its neighbours only within them, if its markers do not show it."""
MIN_START_MARKER_SHARE = 0.5
"""Share of the markers that are visible in any frame which a frame must show to start the chain of method "previous"."""


def initialise_motion(
    take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, method: str = DEFAULT_INIT_METHOD
) -> Motion:
    """Return the initial pose of every frame; NaN where the frame starts from the solution of the frame before.

    take    the markers in the subject's order, NaN if not visible or an outlier
    prior   its mean pose is that of the joints that the body does not turn
    method  one of INIT_METHODS
    """
    if take.frame_count > MAX_BLOCK_FRAMES and method in HYBRIK_VARIANTS:
        return initialise_in_blocks(take, subject, body, prior, method)
    if method in HYBRIK_VARIANTS:
        estimate, is_held = joint_positions.estimate_joint_positions(take, subject, body), ~body.free_joints
        motion = solve_hybrik(
            estimate.positions,
            subject,
            variant=HYBRIK_VARIANTS[method],
            joint_sd=estimate.sd,
            markers=np.where(estimate.marker_trust[..., None] > MIN_MARKER_TRUST, take.markers, np.nan),
            held_joints=is_held,
        )
        motion.local_rotations[:, is_held] = prior.mean_rotations[is_held]
        motion = bend_unmarked_chains(motion, subject, prior)
        if method == LEARNED_METHOD and body.shown_segments.all():
            from mocapfix.initialise.learned_start import infer_unseen_joints  # few takes need it

            motion = infer_unseen_joints(motion, estimate, subject, take.rate)
        return motion
    motion = register_poses(subject, body.free_joints, prior, take.markers)
    return start_from_previous(motion, take.visible) if method == "previous" else motion


def initialise_frames(
    take: Take, frames: Int[np.ndarray, " N"], subject: Subject, body: BodyModel, prior: MeanPosePrior, *, method: str
) -> Motion:
    """Return the initial poses of some frames of a take; arguments as those of `initialise_motion`."""
    if method == LEARNED_METHOD:  # which smooths positions over time, and so needs the frames between them
        return initialise_motion(take, subject, body, prior, method).select_frames(frames)
    return initialise_motion(take.replace_markers(take.markers[frames]), subject, body, prior, method)


def initialise_in_blocks(take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, method: str) -> Motion:
    """Return what `initialise_motion` returns, computed block by block: the arrays of a block are several times its poses."""
    fields: list[np.ndarray] = []
    for first in range(0, take.frame_count, MAX_BLOCK_FRAMES):
        block = slice(first, first + MAX_BLOCK_FRAMES)
        part = initialise_motion(take.replace_markers(take.markers[block]), subject, body, prior, method)
        if not fields:
            fields = [np.empty((take.frame_count, *field.shape[1:]), field.dtype) for field in vars(part).values()]
        for field, values in zip(fields, vars(part).values(), strict=True):
            field[block] = values
    return Motion(*fields)


def bend_unmarked_chains(motion: Motion, subject: Subject, prior: MeanPosePrior) -> Motion:
    """Distribute the rotation of each marked leaf over the unmarked joints before it, in equal parts about the mean pose.

    The joints of the neck carry no markers. Two short, nearly straight bones fold to one side or the other for a millimetre more
    or less between their ends, and the markers hardly determine the side, so the solver would stay on it.
    """
    skeleton, local_rotations = subject.skeleton, motion.local_rotations.copy()
    world_rotations = kinematics.compute_world_poses(skeleton, motion)[1]
    for chain in find_unmarked_chains(subject):
        rotation = world_rotations[:, skeleton.parents[chain[0]]].swapaxes(1, 2) @ world_rotations[:, chain[-1]]
        mean = np.linalg.multi_dot(prior.mean_rotations[chain])
        vector = Rotation.from_matrix(mean.T @ rotation).as_rotvec()
        part = Rotation.from_rotvec(vector / len(chain)).as_matrix()
        product = np.eye(3)
        for j in chain[:-1]:
            local_rotations[:, j] = prior.mean_rotations[j] @ part
            product = product @ local_rotations[:, j]
        local_rotations[:, chain[-1]] = np.swapaxes(product, -1, -2) @ rotation
    return replace(motion, local_rotations=local_rotations)


def find_unmarked_chains(subject: Subject) -> list[list[int]]:
    """Return for each leaf with markers the joints from the last one with markers (exclusive) down to it; two or more joints."""
    parents, marked = subject.skeleton.parents, set(subject.joints.tolist())
    chains: list[list[int]] = []
    for leaf in marked - set(parents.tolist()):
        chain = [leaf]
        while int(parents[chain[0]]) > 0 and int(parents[chain[0]]) not in marked:
            chain.insert(0, int(parents[chain[0]]))
        if len(chain) > 1:
            chains.append(chain)
    return chains


def start_from_previous(motion: Motion, visible: Bool[np.ndarray, "T K"]) -> Motion:
    """Replace the poses after the first frame with enough visible markers by NaN: they start from the frame before."""
    has_enough = visible.sum(axis=1) >= MIN_START_MARKER_SHARE * visible.any(axis=0).sum()
    is_later = np.arange(motion.frame_count) > has_enough.argmax()
    root_position, local_rotations = motion.root_position.copy(), motion.local_rotations.copy()
    root_position[is_later] = local_rotations[is_later] = np.nan
    return replace(motion, root_position=root_position, local_rotations=local_rotations)


def initialise_body(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Compute a first pose in closed form for every frame that the body was not yet solved for, or whose samples changed since.

    Sets `initial_motion` and `frame_changes` of the state.
    """
    assert state.extended_subject is not None
    take, method = state.solver_take, options.initialise.method_used
    changes = find_frame_changes(state, take) if method != "previous" else change_all_frames(take.frame_count)
    body = state.extended_subject.body_model
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    if state.body is None or changes.is_restarted.all():
        motion = initialise_motion(take, state.extended_subject, body, prior, method)
        return replace(state, initial_motion=motion, frame_changes=change_all_frames(take.frame_count))
    restarted = np.flatnonzero(changes.is_restarted)
    poses = initialise_frames(take, restarted, state.extended_subject, body, prior, method=method)
    return replace(state, initial_motion=insert_poses(state.body.motion, restarted, poses), frame_changes=changes)


def find_frame_changes(state: CleaningState, take: Take) -> FrameChanges:
    """Return the frames of the solver's take that changed since the body was solved."""
    body = state.body
    if body is None or body.detection is None:
        return change_all_frames(take.frame_count)
    old_take = body.detection.select_solver_take(body.marker_columns)
    return find_changed_frames(old_take.markers, take.markers, is_same_subject=state.subject is body.subject)


def insert_poses(motion: Motion, frames: Int[np.ndarray, " N"], poses: Motion) -> Motion:
    """Return a motion with other poses in some frames, except for poses that were only guessed from other frames."""
    is_placed = poses.status != FrameStatus.GUESSED
    root_position, local_rotations = motion.root_position.copy(), motion.local_rotations.copy()
    root_position[frames[is_placed]] = poses.root_position[is_placed]
    local_rotations[frames[is_placed]] = poses.local_rotations[is_placed]
    return replace(motion, root_position=root_position, local_rotations=local_rotations)
