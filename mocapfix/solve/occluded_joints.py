"""Occluded joints: the rotations of a limb without markers, inferred from the rest of the take.

A Gaussian process over the take (`stats.gaussian_process`) is given the joints' rotations in frames where they are known, densely
near the gap and sparsely farther away, and predicts those in the gap. Its variance depends on how near or similar the known
frames are. Similar frames have similar state features: the rotations and angular velocities of the other joints, and the height,
up direction, velocity and angular velocity of the root. The units and covariances of these features minimise the error on CMU's
training subjects with arms and legs occluded for 0.5 to 2 s.

If the variance is large, a trained pose model is used too (kriging with external drift). It predicts the occluded joints from the
visible ones in the gap, and also in the known frames, as if the limb were occluded there too; its errors in those frames are
expected in the gap as well. Only its innovation, what it predicts in the gap beyond the take's own prediction, is added in
proportion to the uncertainty; as another tracking term of the poses a model increased the error of every gap.

With the memory of the person (`solve.person_memory`) poses of other takes are further training frames of the same process. Two
frames are then similar if the body moves alike for a while about them. Each take has an offset of its own. These frames get the
variance with which limbs that are hidden elsewhere in the take are predicted best, or are not used.

Last, if the conditioner has a motion prior, as in animations, its prediction is added by its precision (`motion_prior`). In takes
of markers it is added to the completed motion (`motion_solver.add_motion_prior`).
"""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels import lie
from mocapfix.model.body_fit import RememberedGap
from mocapfix.solve.motion_prior import GapContext, GapPrediction, combine_rotations, predict_shipped_gap
from mocapfix.solve.parallel import run_in_parallel
from mocapfix.solve.person_memory import PersonMemory
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.stats.gaussian_process import GaussianProcess, StateCovariance, fit_gaussian_process
from mocapfix.stats.rigid_alignment import compute_rotation_vectors
from mocapfix.stats.sequences import group_gaps, sample_evenly, select_training_frames

VELOCITY_HALF_SPAN_S = 0.067  # time before and after a frame over which velocities are measured
ROTATION_UNIT_RAD = 1.0  # difference of joint rotations that counts as one
ANGULAR_VELOCITY_UNIT_RAD_S = 50.0  # difference of joint angular velocities that counts as one
ROOT_UP_UNIT = 0.5  # difference of the up direction in root axes that counts as one
ROOT_HEIGHT_UNIT_M = 0.5  # difference of root heights that counts as one
ROOT_SPEED_UNIT_M_S = 5.0  # difference of root velocities that counts as one
ROOT_SPIN_UNIT_RAD_S = 20.0  # difference of root angular velocities that counts as one
ESTIMATED_ROTATION_KERNEL = StateCovariance(
    time_scale_s=0.3, similarity_rate=0.6, time_power=0.06, recurrence_power=1.6, linear_power=0.8, noise_power=1.5e-4
)
"""Covariance of joint rotations that were solved from markers."""
RECORDED_ROTATION_KERNEL = StateCovariance(
    time_scale_s=0.45, similarity_rate=0.08, time_power=0.4, recurrence_power=6.0, linear_power=0.8, noise_power=1e-5
)
"""Covariance of rotations recorded in an animation: they are exact, so that less similar frames are informative, too."""


def compute_joint_state_features(
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    joints: Int[np.ndarray, " O"],
    frames: Int[np.ndarray, " N"],
    rate: float,
) -> Float[np.ndarray, "N F"]:
    """Return the features of the body's state in some frames, each in units of a difference that counts as one."""
    span, last = max(1, round(VELOCITY_HALF_SPAN_S * rate)), len(root_position) - 1
    before, after = np.maximum(frames - span, 0), np.minimum(frames + span, last)
    seconds = (after - before) / rate + (last == 0)

    def compute_angular_velocity(of_joints: np.ndarray) -> np.ndarray:
        step = np.swapaxes(local_rotations[np.ix_(before, of_joints)], -1, -2) @ local_rotations[np.ix_(after, of_joints)]
        return compute_rotation_vectors(step).reshape(len(frames), -1) / seconds[:, None]

    world_to_root = np.swapaxes(local_rotations[frames, 0], 1, 2)
    velocity = np.einsum("tab,tb->ta", world_to_root, root_position[after] - root_position[before]) / seconds[:, None]
    # the norm of a small rotation's matrix difference is sqrt(2) times its angle
    rotations = local_rotations[np.ix_(frames, joints)].reshape(len(frames), -1) / np.sqrt(2)
    return np.concatenate(
        [
            rotations / ROTATION_UNIT_RAD,
            compute_angular_velocity(joints) / ANGULAR_VELOCITY_UNIT_RAD_S,
            world_to_root[:, :, 1] / ROOT_UP_UNIT,
            root_position[frames, 1:2] / ROOT_HEIGHT_UNIT_M,
            velocity / ROOT_SPEED_UNIT_M_S,
            compute_angular_velocity(np.array([0])) / ROOT_SPIN_UNIT_RAD_S,
        ],
        axis=1,
    )


MAX_UNOBSERVED_SHARE = 0.75  # of the joints; with more, too little of the body is left to infer the rest from
MIN_TRAINING_FRAMES = 3  # frames with known rotations that a gap requires
DEFAULT_ROTATION_POWER_RAD2 = 0.02  # signal power of a joint rotation for which there are no data
DEFAULT_POWER_FRAMES = 10  # number of frames that this default power is worth in the estimate of the power
VARIANCE_INFLATION = 1.5  # actual squared error of the prediction over the variance that the process predicts
MIN_QUERY_SD_RAD = 0.1  # standard deviation of the prediction above which the pose model is used; below, no model improves it
QUERY_STEP_S = 1 / 30  # between frames of a gap in which the pose model is used; its innovation is interpolated
PRIOR_INNOVATION_SD_RAD = 0.3  # standard deviation per axis of people's limbs about the innovation of the pose model


class KnownMotion(NamedTuple):
    """A motion of which some joints are occluded in some frames."""

    root_position: Float[np.ndarray, "T 3"]  # m
    local_rotations: Float[np.ndarray, "T J 3 3"]  # any where the joints are not observed
    variance: Float[np.ndarray, "T J"]  # of the rotations, in rad^2
    is_unobserved: Bool[np.ndarray, "T J"]  # as from `pose_problem.find_unobserved_joints`
    joints: Int[np.ndarray, " F"]  # those below the root that move
    rate: float  # frames per second
    memory: PersonMemory | None = None  # of the person, without this motion

    @property
    def has_body(self) -> Bool[np.ndarray, " T"]:
        """The frames in which enough is observed to infer the rest."""
        return self.is_unobserved[:, self.joints].mean(axis=1) <= MAX_UNOBSERVED_SHARE

    def find_observed_joints(self, first: int, last: int) -> Int[np.ndarray, " O"]:
        """Return the joints that are observed throughout the frames first..last."""
        return self.joints[~self.is_unobserved[first : last + 1, self.joints].any(axis=0)]

    def find_training_frames(self, first: int, last: int, occluded: Int[np.ndarray, " L"]) -> Int[np.ndarray, " N"]:
        """Return the frames from which joints that are occluded in the frames first..last are inferred."""
        used = np.r_[self.find_observed_joints(first, last), occluded]
        return select_training_frames(self.has_body & ~self.is_unobserved[:, used].any(axis=1), first, last, self.rate)


def predict_hidden_joints(
    motion: KnownMotion, frames: Int[np.ndarray, " n"], hidden: Int[np.ndarray, " L"], size_ratio: float
) -> GapPrediction | None:
    """Return the motion prior's prediction of joints as if no marker showed them in these frames of a body of this relative size.

    None if it predicts no such gap, or if the body is lost in it or beside it: no known pose then ends the gap.
    """
    first, last = int(frames[0]), int(frames[-1])
    near = GapContext(motion.root_position, motion.local_rotations, ~motion.is_unobserved, first, last, motion.rate).crop()
    has_body = motion._replace(is_unobserved=~near.is_known).has_body
    near.is_known[~has_body] = near.is_known[near.frames, hidden] = False
    prediction = predict_shipped_gap(near, size_ratio) if has_body[max(0, near.first - 1) : near.last + 2].all() else None
    return prediction and prediction.select_joints(hidden)


class InferredJoints(NamedTuple):
    """The rotations of L occluded joints in a gap of n frames, and their variance in rad^2 per axis."""

    rotations: Float[np.ndarray, "n L 3 3"]
    variance: Float[np.ndarray, "n L"]
    source: str = ""  # the frames of the person's memory that are most similar, as in "walk2, 0:31-0:33"; "": those of the take


def infer_occluded_joints(motion: KnownMotion, conditioner: PriorConditioner | None) -> list[RememberedGap]:
    """Overwrite the rotations of joints that no marker shows, and their variance, with predictions.

    Returns the gaps that are inferred from the memory of the person, in the order of time.
    """
    remembered: list[RememberedGap] = []
    given = motion._replace(local_rotations=motion.local_rotations.copy(), variance=motion.variance.copy())

    def infer_gap(gap: tuple[tuple[int, int], Int[np.ndarray, " L"]]) -> None:
        (first, last), occluded = gap
        estimates = infer_gap_joints(
            given, first, last, occluded,
            training=given.find_training_frames(first, last, occluded), kernel=ESTIMATED_ROTATION_KERNEL,
            conditioner=conditioner, pose_predictions={},
        )  # fmt: skip
        if estimates:
            rotations, variance, source = estimates[-1]
            motion.local_rotations[first : last + 1, occluded], motion.variance[first : last + 1, occluded] = rotations, variance
            if source:
                remembered.append(RememberedGap(first, last, tuple(occluded.tolist()), source))

    # A gap reads known frames only, and writes only what is unobserved, so that gaps are independent; the longest begin first.
    gaps = group_gaps(motion.is_unobserved & motion.has_body[:, None])
    run_in_parallel(infer_gap, sorted(gaps.items(), key=lambda gap: gap[0][0] - gap[0][1]))
    return sorted(remembered)


def infer_gap_joints(
    motion: KnownMotion,
    first: int,
    last: int,
    occluded: Int[np.ndarray, " L"],
    *,
    training: Int[np.ndarray, " N"],
    kernel: StateCovariance,
    conditioner: PriorConditioner | None,
    pose_predictions: dict[int, np.ndarray],
) -> list[InferredJoints]:
    """Infer joints that are occluded in the frames first..last.

    Args:
        training: The frames from which they are inferred.
        conditioner: The trained models, None: they are not used.
        pose_predictions: What the pose model predicts of these joints, by training frame; what is lacking is added.

    Returns what follows from the take, then, with a conditioner, the estimate that uses the trained models as well; nothing if
    too few frames show the joints.
    """
    solved, is_unobserved, rate = motion.local_rotations, motion.is_unobserved, motion.rate
    observed = motion.find_observed_joints(first, last)
    if len(training) < MIN_TRAINING_FRAMES:
        return []
    # quaternions times 2 as rows of 4 L numbers, in radians, and their excess variance
    rotations = np.hstack([2 * lie.extract_joint_quaternions(solved, j, ~is_unobserved[:, j])[training] for j in occluded])
    training_variance = motion.variance[training][:, occluded].max(axis=1)
    noise = np.maximum(training_variance - np.median(training_variance), 0.0)
    frames = np.arange(first, last + 1)
    training_states, gap_states = (
        compute_joint_state_features(motion.root_position, solved, observed, each, rate) for each in (training, frames)
    )
    data = training_states, training / rate, noise, kernel
    process, gap_s = fit_gaussian_process(rotations, *data), len(frames) / rate
    remembered = find_remembered_frames(motion, training, frames, observed, occluded, rotations) if motion.memory else None
    if remembered and (noise_rad2 := remembered.choose_noise(rotations, data, process, gap_s)) is not None:
        data, gap_states = remembered.extend(data, noise_rad2), remembered.gap_states
        process = fit_gaussian_process(np.concatenate([rotations, remembered.values]), *data)
    else:
        remembered = None
    predicted, relative_variance = process.predict(gap_states, frames / rate)
    shown = np.fmax(process.measure_gap_errors(gap_s, len(training))[0], process.signal_power)
    power = len(training) * (shown.reshape(-1, 4).sum(axis=1) / 3) + DEFAULT_POWER_FRAMES * DEFAULT_ROTATION_POWER_RAD2
    power /= len(training) + DEFAULT_POWER_FRAMES  # of each joint, in rad^2 per axis, as errors in gaps this long show it
    gap_variance = VARIANCE_INFLATION * relative_variance[:, None] * power
    source = remembered.describe_source() if remembered else ""
    from_take = InferredJoints(_convert_rows(predicted), gap_variance, source)
    if not conditioner:
        return [from_take]
    gap_rotations = from_take.rotations
    if gap_variance.max() > MIN_QUERY_SD_RAD**2:
        queried = sample_evenly(len(frames), 1 + math.ceil((len(frames) - 1) / (QUERY_STEP_S * rate)))
        is_new = np.array([frame not in pose_predictions for frame in training.tolist()])
        reference, evaluated = np.concatenate([rotations[is_new], predicted[queried]]), np.r_[training[is_new], frames[queried]]
        rows = conditioner.predict_rotations(solved, observed, occluded, evaluated, reference)
        pose_predictions.update(zip(training[is_new].tolist(), rows, strict=False))
        drift = np.stack([pose_predictions[frame] for frame in training.tolist()])
        if remembered:
            every = np.arange(len(remembered.values))
            expected = conditioner.predict_rotations(remembered.rotations, observed, occluded, every, remembered.values)
            drift = np.concatenate([drift, expected])
        from_process = fit_gaussian_process(drift, *data).predict(gap_states[queried], frames[queried] / rate)[0]
        sampled = rows[is_new.sum() :] - from_process
        innovation = np.stack([np.interp(frames, frames[queried], values) for values in sampled.T], axis=1)
        gain = gap_variance / (gap_variance + (conditioner.prior_scale * PRIOR_INNOVATION_SD_RAD) ** 2)
        gap_rotations = _convert_rows(predicted + np.repeat(gain, 4, axis=1) * innovation)
    context = GapContext(motion.root_position, solved, motion.has_body[:, None] & ~is_unobserved, first, last, rate)
    cropped = context.crop()
    estimated = cropped.local_rotations.copy()
    estimated[cropped.frames][:, occluded] = gap_rotations
    if prediction := conditioner.predict_gap(cropped._replace(local_rotations=estimated), occluded):
        gap_rotations, gap_variance = combine_rotations(gap_rotations, gap_variance, prediction)
    return [from_take, InferredJoints(gap_rotations, gap_variance, source)]


CONTEXT_LAGS_S = (-1 / 3, -1 / 6, 0.0, 1 / 6, 1 / 3)  # times about a frame at which the body's state counts
CONTEXT_SHARES = (0.1, 0.1, 0.6, 0.1, 0.1)  # how much each counts
TAKE_FEATURE = 0.35  # difference of two takes in units of state: the offset of each has 0.1 of the signal's power
MAX_GAP_MEMORIES = 200  # training frames from the memory for a gap
MAX_TAKE_MEMORIES = 80  # and for the rest of the take, in which it is found out what the memory is worth
MAX_COMPARED_MEMORIES = 600  # poses, the most similar ones, whose context is compared
COMPARED_FRAMES = 12  # frames of a gap, and of the rest of the take, with which poses of the memory are compared
MEMORY_NOISE_RAD2 = (0.0, 0.02, 0.1)  # variances of the memory's rotations beside those of the process, of which one is chosen
MAX_DISTANT_SHARE = 0.8  # squared error with a memory over that of the take alone, if the take is more similar to the gap
MIN_JUDGED_STRETCHES = 6  # as long as the gap, in which it is hidden elsewhere; fewer do not show that such a memory helps
MEMORY_TIMES_S = 1e6, 100.0  # first time of the memory's frames in the process, and their distance: unrelated to the take's


class RememberedFrames(NamedTuple):
    """M frames of a memory as further training frames for a gap of n frames, beside N training frames of the take."""

    memory: PersonMemory
    keys: Int[np.ndarray, " M"]  # the poses in the memory
    rotations: Float[np.ndarray, "M J 3 3"]
    values: Float[np.ndarray, "M Q"]  # quaternions times 2 of the occluded joints
    states: Float[np.ndarray, "N_M F"]  # with their context, of the take's training frames, then of the memory's
    gap_states: Float[np.ndarray, "n F"]  # with their context
    context_size: int  # number of features before those of the takes' offsets

    def extend(self, data: "ProcessData", noise_rad2: float) -> "ProcessData":
        """Return the data of the process with the frames of the memory, whose rotations have a further variance."""
        _, times_s, noise, kernel = data
        first_s, step_s = MEMORY_TIMES_S
        times_s = np.concatenate([times_s, first_s + step_s * np.arange(len(self.keys))])
        return self.states, times_s, np.concatenate([noise, np.full(len(self.keys), noise_rad2)]), kernel

    def choose_noise(
        self, rotations: Float[np.ndarray, "N Q"], data: "ProcessData", alone: GaussianProcess, gap_s: float
    ) -> float | None:
        """Return the further variance with which limbs hidden elsewhere in the take, for as long as in the gap, are predicted
        best; None if the take alone predicts them better. Where it is more similar to the gap, the memory must clearly win. In a
        take that is too short to tell, similarity decides.
        """
        values, count = np.concatenate([rotations, self.values]), len(rotations)
        errors = {
            noise: fit_gaussian_process(values, *self.extend(data, noise)).measure_gap_errors(gap_s, count)[1].sum()
            for noise in MEMORY_NOISE_RAD2
        }
        best = min(errors, key=lambda noise: errors[noise])
        stretch_count = len(np.unique((alone.training_times_s - alone.training_times_s[0]) // gap_s))
        is_similar, is_judged = bool(self.describe_source()), stretch_count >= MIN_JUDGED_STRETCHES
        if not is_judged:
            return best if is_similar else None
        most = (1.0 if is_similar else MAX_DISTANT_SHARE) * alone.measure_gap_errors(gap_s, count)[1].sum()
        return None if errors[best] > most else best

    def describe_source(self) -> str:
        """Return the frames of the memory that are most similar to the gap; "" if more often those of the take are."""
        count = len(self.states) - len(self.keys)
        distances = _measure_distances(self.states[:, : self.context_size], self.gap_states[:, : self.context_size])
        nearest = distances[count:].argmin(axis=0)
        is_nearer = distances[count:].min(axis=0) < distances[:count].min(axis=0)
        return self.memory.describe_frames(self.keys[nearest[is_nearer]]) if is_nearer.mean() >= 0.5 else ""


ProcessData: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray, StateCovariance]  # as `fit_gaussian_process` takes them


def find_remembered_frames(
    motion: KnownMotion,
    training: Int[np.ndarray, " N"],
    frames: Int[np.ndarray, " n"],
    observed: Int[np.ndarray, " O"],
    occluded: Int[np.ndarray, " L"],
    rotations: Float[np.ndarray, "N Q"],
) -> RememberedFrames | None:
    """Return the frames of the person's memory that are most similar to those of a gap; None if it does not show the joints.

    Args:
        training, frames: The training frames of the take, and those of the gap.
        rotations: Quaternions of the training frames, times 2, which determine the signs.
    """
    memory = motion.memory
    keys = memory.find_keys(np.r_[observed, occluded]) if memory else training[:0]
    if memory is None or len(keys) < MIN_TRAINING_FRAMES:
        return None
    compared = [each[sample_evenly(len(each), COMPARED_FRAMES)] for each in (frames, training)]
    distances = memory.measure_pose_distances(keys, motion.local_rotations[np.concatenate(compared)], observed)
    keys = keys[np.sort(_select_nearest(distances, MAX_COMPARED_MEMORIES))]
    last, rate = len(motion.root_position) - 1, motion.rate

    def compute_own_states(of_frames: np.ndarray, lag_s: float) -> np.ndarray:
        shifted = np.clip(of_frames + round(lag_s * rate), 0, last)
        return compute_joint_state_features(motion.root_position, motion.local_rotations, observed, shifted, rate)

    def compute_remembered_states(of_keys: np.ndarray, lag_s: float) -> np.ndarray:
        span_s = VELOCITY_HALF_SPAN_S
        poses = [memory.interpolate(of_keys, lag_s + each) for each in (-span_s, 0.0, span_s)]
        root, local = (np.stack(each, axis=1).reshape(3 * len(of_keys), *each[0].shape[1:]) for each in zip(*poses, strict=True))
        return compute_joint_state_features(root, local, observed, 1 + 3 * np.arange(len(of_keys)), 1 / span_s)

    def add_context(compute: Callable[[np.ndarray, float], np.ndarray], indices: np.ndarray) -> np.ndarray:
        pairs = zip(CONTEXT_LAGS_S, CONTEXT_SHARES, strict=True)
        return np.concatenate([math.sqrt(share) * compute(indices, lag_s) for lag_s, share in pairs], axis=1)

    gap_states, training_states = (add_context(compute_own_states, each) for each in (frames, training))
    states = add_context(compute_remembered_states, keys)
    of_gap, of_take = (
        _select_nearest(_measure_distances(states, each[:: max(1, len(each) // most)]), most)
        for each, most in ((gap_states, MAX_GAP_MEMORIES), (training_states, MAX_GAP_MEMORIES + MAX_TAKE_MEMORIES))
    )
    chosen = np.r_[of_gap, of_take[~np.isin(of_take, of_gap)][:MAX_TAKE_MEMORIES]]
    keys, states = keys[chosen], states[chosen]
    takes = np.unique(memory.take_of_key[keys])
    offsets = TAKE_FEATURE * np.eye(len(takes) + 1)
    of_take = np.r_[np.zeros(len(training), int), 1 + np.searchsorted(takes, memory.take_of_key[keys])]
    local_rotations = memory.interpolate(keys, 0.0)[1]
    known = np.ones(len(keys), bool)
    values = np.stack([2 * lie.extract_joint_quaternions(local_rotations, j, known) for j in occluded], axis=1)
    is_opposite = (values * rotations[0].reshape(-1, 4)).sum(axis=2) < 0
    return RememberedFrames(
        memory,
        keys,
        local_rotations,
        values=np.where(is_opposite[..., None], -values, values).reshape(len(keys), -1),
        states=np.hstack([np.concatenate([training_states, states]), offsets[of_take]]),
        gap_states=np.hstack([gap_states, np.tile(offsets[0], (len(frames), 1))]),
        context_size=gap_states.shape[1],
    )


def _measure_distances(states: Float[np.ndarray, "A F"], others: Float[np.ndarray, "B F"]) -> Float[np.ndarray, "A B"]:
    return np.sqrt(np.maximum((states**2).sum(1)[:, None] + (others**2).sum(1) - 2 * states @ others.T, 0.0))


def _select_nearest(distances: Float[np.ndarray, "K Q"], count: int) -> Int[np.ndarray, " S"]:
    """Return at most `count` rows that are nearest to any column: the nearest of each, then the second nearest, and so on."""
    order = np.argsort(distances, axis=0, kind="stable").ravel()
    return order[np.sort(np.unique(order, return_index=True)[1])[:count]]


def _convert_rows(rows: Float[np.ndarray, "n Q"]) -> Float[np.ndarray, "n L 3 3"]:
    """Convert rows of quaternions of L joints, of any length, to rotations."""
    rotations = np.empty((len(rows), rows.shape[1] // 4, 3, 3))
    for joint in range(rotations.shape[1]):
        lie.store_joint_quaternions(np.ascontiguousarray(rows[:, 4 * joint : 4 * joint + 4]), joint, rotations)
    return rotations
