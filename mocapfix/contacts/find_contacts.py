"""Find the contacts of a body with the floor, from the positions of its joints.

A joint is in contact while it stands still, near the floor or another level on which the person stands. The costs of sequences of
the states moving and standing, linear in the logarithm of the speed, give the probability that it stands. The
solved motion is smooth, so the speed is the difference of neighbouring frames; that of a foot that bears weight falls to 0.02
to 0.1 m/s, since it rolls. While no marker shows a foot, a network tells the probability of its contact from what the solver
made of its motion, which follows from the rest of the body.

The feet of an animation may slide throughout, because its path was stretched. `estimate_slide` finds by how much, from the steps
of the body, and the contacts are those of the body without it.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from mocapfix.contacts.contacts import (
    BASE_PERCENTILE,
    CONTACT_JOINTS,
    FOOT_JOINTS,
    MAX_LEVEL_DEVIATION_M,
    MAX_SUPPORT_ABOVE_OTHER_M,
    NO_FLOOR,
    OTHER_CONTACT_JOINTS,
    TOE_HEIGHT_M,
    BodyContacts,
    Floor,
    build_no_contacts,
    estimate_floor,
)
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.solve.learned_ik import Perceptron, read_perceptron
from mocapfix.stats.sequences import average_windows, find_runs, slide_windows, smooth_values

TOES = slice(1, None, 2)  # columns of CONTACT_JOINTS
MAX_SHOWN_JOINT_SD_M = 0.03  # standard deviation above which a joint's position is never known
MAX_SD_RATIO = 1.5  # standard deviation, relative to the take's usual one, above which the joint lacks its markers
BORDER_S = 0.08  # time beside unknown frames in which the smoothness of the motion carries their error into known ones
USUAL_SD_PERCENTILE = 25


def find_known_frames(position_sd: Float[np.ndarray, " T"], rate: float) -> Bool[np.ndarray, " T"]:
    """Return the frames whose markers show a joint, by the predicted standard deviation (T,) of its position in metres."""
    usual = float(np.percentile(position_sd, USUAL_SD_PERCENTILE)) if len(position_sd) else 0.0
    is_unknown = ~(position_sd <= min(max(MAX_SD_RATIO * usual, 1e-9), MAX_SHOWN_JOINT_SD_M))  # also NaN
    border = max(1, round(BORDER_S * rate))
    return np.convolve(np.r_[is_unknown, False], np.ones(2 * border + 1))[border : len(is_unknown) + border] == 0


MIN_CONTACT_PROBABILITY = 0.6  # of a joint that no marker shows: where F1 is largest on held-out people, see priors/contacts.md
MIN_CONTACT_LOGIT = float(np.log(MIN_CONTACT_PROBABILITY / (1 - MIN_CONTACT_PROBABILITY)))
STANDING_SPEED_M_S = 0.09  # at which standing and moving are equally likely; from 0.08 to 0.1 F1 changes by 0.002 on CMU
LOG_SPEED_WIDTH = 0.3  # change of the logarithm of the speed that changes the cost by 1
MAX_STATE_COST = 3.0  # largest cost of a state in a frame: a single fast frame is no proof of a step
STANDING_CHANGE_COST = 2.0  # cost of a change of state: several frames must contradict a state to change it
COST_LOGIT = 0.7  # logit for a difference of 1 in cost at 120 frames per second: fits the share that stands of training people
MIN_STANDING_S = 0.1  # shortest time for which a joint stands
MIN_SPEED_M_S = 1e-4
ROLLING_SPEED_M_S = 0.2  # up to which a foot that bears weight rolls, also on to the floor or off it


def compute_speed(position: Float[np.ndarray, "T 3"], rate: float) -> Float[np.ndarray, " T"]:
    """Return the speed (T,) in m/s of a path in metres."""
    if len(position) < 2:
        return np.zeros(len(position))
    return np.linalg.norm(np.gradient(position, 1 / rate, axis=0), axis=-1)


def compute_standing_logit(
    speed: Float[np.ndarray, " T"], rate: float, is_ignored: Bool[np.ndarray, " T"] | bool = False
) -> Float[np.ndarray, " T"]:
    """Return the logit of the probability that a joint stands, from its speed in m/s.

    It follows from the difference in cost of the cheapest sequences that move and that stand in a frame, so it is over
    MIN_CONTACT_LOGIT where the cheapest sequence of all stands. Where the speed is ignored, it follows from the frames around.
    """
    frame_share = 120.0 / rate  # the costs were chosen at 120 frames per second: slower files have more information in a frame
    ratio = np.log(STANDING_SPEED_M_S / np.maximum(speed, MIN_SPEED_M_S)) / LOG_SPEED_WIDTH
    own = np.where(is_ignored, 0.0, np.clip(ratio, -MAX_STATE_COST, MAX_STATE_COST) * frame_share)

    def add(before: float, of_frame: float) -> float:  # a sequence changes its state before a frame if that is cheaper
        return min(max(before, -STANDING_CHANGE_COST), STANDING_CHANGE_COST) + of_frame

    until, after = (np.array(list(accumulate(each.tolist(), add))) for each in (own, own[::-1]))
    return MIN_CONTACT_LOGIT + COST_LOGIT / np.sqrt(frame_share) * (until + after[::-1] - own)


def decode_contacts(logit: Float[np.ndarray, "T C"], rate: float) -> tuple[Bool[np.ndarray, "T C"], Float[np.ndarray, "T C"]]:
    """Return the contacts of joints and their probability, which is at most 0.5 where a joint is not in contact for long."""
    is_contact = np.stack([remove_short_runs(each > MIN_CONTACT_LOGIT, rate) for each in logit.T], axis=1)
    probability = 0.5 + 0.5 * np.tanh(0.5 * logit)  # `scipy.special.expit`, which is slow to import
    return is_contact, np.where(is_contact, probability, np.minimum(probability, 0.5))


def remove_short_runs(is_standing: Bool[np.ndarray, " T"], rate: float) -> Bool[np.ndarray, " T"]:
    """Return the runs of at least MIN_STANDING_S."""
    kept = np.zeros(len(is_standing), bool)
    for first, last in find_runs(is_standing):
        if last + 1 - first >= MIN_STANDING_S * rate - 1e-9:
            kept[first : last + 1] = True
    return kept


MAX_OTHER_HEIGHT_M = 0.13  # height above the floor up to which OTHER_CONTACT_JOINTS at rest touch it: lying, 40 to 110 mm


def find_contacts(skeleton: Skeleton, motion: Motion, joint_position: Float[np.ndarray, "T J 3"], rate: float) -> BodyContacts:
    """Find the contacts of feet, knees, hands, seat and back.

    Args:
        motion: Its motion, of which `joint_sd` is used: where a foot lacks its markers, its contact is estimated.
        joint_position: Metres, Y up; NaN for joints that the markers do not show.
    """
    feet = [skeleton.names.index(joint) for joint in CONTACT_JOINTS]
    if not len(joint_position) or not np.isfinite(joint_position[:, feet]).all():
        return build_no_contacts(len(joint_position), rate)
    hips = joint_position[:, skeleton.names.index("Hips"), 1]
    is_possible = ~(joint_position[:, feet, 1] > hips[:, None])  # feet above the hips are those of one who lies, sits or hangs
    is_possible &= (np.nanmin(motion.joint_sd, axis=1) <= MAX_SHOWN_JOINT_SD_M)[:, None]  # no marker: not there
    contacts = find_foot_contacts(joint_position[:, feet], motion.joint_sd[:, feet], rate, is_possible)
    others = [skeleton.names.index(joint) for joint in OTHER_CONTACT_JOINTS]
    if contacts.floor is NO_FLOOR:
        return contacts
    added = find_other_contacts(joint_position[:, others], joint_position[:, feet[TOES]], contacts.floor, rate)
    is_known = np.stack([find_known_frames(motion.joint_sd[:, joint], rate) for joint in others], axis=1)
    of_feet = contacts.is_contact, contacts.probability, contacts.is_known
    is_contact, probability, is_known = (np.hstack(pair) for pair in zip(of_feet, (*added, is_known), strict=True))
    joints = (*CONTACT_JOINTS, *OTHER_CONTACT_JOINTS)
    return BodyContacts(joints, is_contact, probability, is_known, contacts.floor, rate)


def find_foot_contacts(
    position: Float[np.ndarray, "T C 3"],
    sd: Float[np.ndarray, "T C"],
    rate: float,
    is_possible: Bool[np.ndarray, "T C"] | bool = True,
) -> BodyContacts:
    """Find the contacts of both feet, from the positions of CONTACT_JOINTS and their standard deviations per axis, in metres."""
    stands, is_known, logit = find_shown_standing(position, sd, rate)
    if stands.any() and not is_known.all():
        features, network = compute_contact_features(position, sd, stands & is_known, rate), load_contact_network()
        hidden = average_windows(np.hstack([network.evaluate(each) for each in features]), LOGIT_FRAMES)
        frames, at = np.arange(len(position)) / rate, np.arange(len(hidden)) / FEATURE_RATE_HZ
        logit = np.where(is_known, logit, _resample(hidden, at, frames))
        stands = np.where(is_known, stands, logit > MIN_CONTACT_LOGIT)
    stands &= is_possible
    shown = stands[:, TOES] & is_known[:, TOES].all(1, keepdims=True)  # the other foot may stand lower where no marker shows it
    floor = estimate_floor(position[:, TOES], shown if shown.any() else stands[:, TOES], rate)
    is_off = stands & is_known & ~find_frames_near_floor(position, stands, floor) | ~np.asarray(is_possible)
    return BodyContacts(CONTACT_JOINTS, *decode_contacts(np.where(is_off, -np.inf, logit), rate), is_known, floor, rate)


def find_shown_standing(
    position: Float[np.ndarray, "T C 3"], sd: Float[np.ndarray, "T C"], rate: float
) -> tuple[Bool[np.ndarray, "T C"], Bool[np.ndarray, "T C"], Float[np.ndarray, "T C"]]:
    """Return when CONTACT_JOINTS stand, by the frames whose markers show them, which frames these are, and the logits."""
    is_known = np.stack([find_known_frames(each, rate) for each in sd.T], axis=1)
    for ankle, toe in ([CONTACT_JOINTS.index(joint) for joint in joints] for joints in FOOT_JOINTS.values()):
        is_known[:, toe] &= is_known[:, ankle]  # where the ankle is unknown, so is where the toes are
    speed = [compute_speed(path, rate) for path in position.swapaxes(0, 1)]
    logits = [compute_standing_logit(each, rate, ~shown) for each, shown in zip(speed, is_known.T, strict=True)]
    logit = np.stack(logits, axis=1)
    return decode_contacts(logit, rate)[0], is_known, logit


LOGIT_FRAMES = 7  # at FEATURE_RATE_HZ, over which logits are averaged: 5 to 13 add 0.004 to F1 on held-out people
CONTACT_NETWORK = "contacts"
FEATURE_RATE_HZ = 60.0
SPEED_FRAMES = np.array([-8, -6, -4, -3, -2, -1, 0, 1, 2, 3, 4, 6, 8])
HEIGHT_FRAMES, OTHER_HEIGHT_FRAMES = np.arange(-8, 9, 4), np.array([-8, 0, 8])
"""Frames at FEATURE_RATE_HZ, from the one that is judged, in which the network sees speeds and heights of a joint."""
MEAN_FRAMES = (15, 41)  # frames over which it sees the mean of the logarithm of the speed
SLOW_SPEED_M_S, MIN_FEATURE_SPEED_M_S, MIN_FEATURE_SD_M = 0.1, 0.005, 0.001
FEATURE_COUNT = 70  # of a foot


@cache
def load_contact_network() -> Perceptron:
    """Return the network that ships as priors/contacts.safetensors: logits of the contacts of an ankle and its toes."""
    return read_perceptron(find_shipped_folder("priors") / f"{CONTACT_NETWORK}.safetensors", CONTACT_NETWORK, FEATURE_COUNT, 2)


def compute_contact_features(
    position: Float[np.ndarray, "T C 3"], sd: Float[np.ndarray, "T C"], is_standing: Bool[np.ndarray, "T C"], rate: float
) -> Float32[np.ndarray, "2 N F"]:
    """Return what the network sees of each foot, at FEATURE_RATE_HZ.

    Of its own joints: speeds, also vertical ones, heights above where they stand, and standard deviations; of those of the other
    foot, fewer speeds and heights.

    Args:
        is_standing: When markers show that a joint stands; some joint does in some frame.
    """
    height = estimate_floor(position[:, TOES], is_standing[:, TOES], rate).compute_height_above(position)
    for column, is_low in zip(height.T, (is_standing & (height > -TOE_HEIGHT_M)).T, strict=True):
        column -= np.percentile(column[is_low], BASE_PERCENTILE) if is_low.any() else column.min()
    speed = np.stack([compute_speed(path, rate) for path in position.swapaxes(0, 1)], axis=1)
    frames = np.arange(len(position)) / rate
    at = np.arange(int(frames[-1] * FEATURE_RATE_HZ + 1e-9) + 1) / FEATURE_RATE_HZ
    speed = np.log(np.maximum(_resample(speed, frames, at), MIN_FEATURE_SPEED_M_S) / SLOW_SPEED_M_S)
    height = np.clip(_resample(height, frames, at) / MAX_LEVEL_DEVIATION_M, -3, 8)
    log_sd = np.log(np.maximum(_resample(sd, frames, at), MIN_FEATURE_SD_M))
    rise = np.arcsinh(_resample(np.gradient(position[..., 1], 1 / rate, axis=0), frames, at) / SLOW_SPEED_M_S)
    averaged = ((speed, MEAN_FRAMES[0]), (speed, MEAN_FRAMES[1]), ((speed < 0) * 1.0, MEAN_FRAMES[0]))
    means = [average_windows(each, count) for each, count in averaged]

    def select(signal: Float[np.ndarray, "N C"], around: Int[np.ndarray, " K"]) -> Float[np.ndarray, "N C K"]:
        frame = np.clip(np.arange(len(at))[:, None] + around, 0, len(at) - 1)  # beyond its ends a signal stays as it is there
        return signal[frame].swapaxes(1, 2)

    around = [select(speed, SPEED_FRAMES), select(height, HEIGHT_FRAMES), select(rise, HEIGHT_FRAMES)]
    own = np.concatenate([*around, np.stack([*means, log_sd], axis=2)], axis=2)
    other = np.concatenate([select(speed, HEIGHT_FRAMES), select(height, OTHER_HEIGHT_FRAMES)], axis=2)
    feet = [[each.reshape(len(at), -1) for each in (own[:, n : n + 2], other[:, 2 - n : 4 - n])] for n in (0, 2)]
    return np.stack([np.hstack(each) for each in feet]).astype(np.float32)


def _resample(
    signal: Float[np.ndarray, "T C"], times_s: Float[np.ndarray, " T"], at_s: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "N C"]:
    return np.stack([np.interp(at_s, times_s, each) for each in signal.T], axis=1)


def find_frames_near_floor(
    position: Float[np.ndarray, "T C 3"], is_standing: Bool[np.ndarray, "T C"], floor: Floor
) -> Bool[np.ndarray, "T C"]:
    """Return the frames in which each of CONTACT_JOINTS is about as high above its foot's level as where it stands lowest.

    Each joint is compared with itself: an ankle is higher where a person stands on the toes of that foot alone. The level is that
    below the toes. A foot that bears weight off all levels, as on uneven ground, is compared with its own lowest place there.
    """
    if not floor.level_heights_m:
        return np.zeros(is_standing.shape, bool)
    feet, stands = (each.reshape(len(position), len(FOOT_JOINTS), 2, *each.shape[2:]) for each in (position, is_standing))
    height, base, is_near = floor.remove_slope(feet), np.zeros(stands.shape[1:]), np.zeros(stands.shape, bool)
    above = height - height[..., 1:] + floor.compute_height_above(feet[..., 1:, :])
    for foot, joint in np.ndindex(stands.shape[1:]):
        low = above[stands[:, foot, joint] & (above[:, foot, 1] > -TOE_HEIGHT_M), foot, joint]
        base[foot, joint] = np.percentile(low, BASE_PERCENTILE) if len(low) else 0.0
        is_near[:, foot, joint] = above[:, foot, joint] < base[foot, joint] + MAX_LEVEL_DEVIATION_M
    height[..., 0] -= base[:, 0] - base[:, 1]  # an ankle is lowered to the toes of a foot that stands flat
    sole = np.where(stands, height, np.inf).min(2)
    is_support = sole <= sole.min(1, keepdims=True) + MAX_SUPPORT_ABOVE_OTHER_M
    for foot in range(len(FOOT_JOINTS)):
        for first, last in find_runs(np.isfinite(sole[:, foot])):
            span = slice(first, last + 1)
            place = float(np.percentile(sole[span, foot], BASE_PERCENTILE))
            from_level_m = np.abs(place - TOE_HEIGHT_M - np.array(floor.level_heights_m)).min()
            if is_support[span, foot].mean() > 0.5 and from_level_m > MAX_SUPPORT_ABOVE_OTHER_M:
                is_near[span, foot] |= height[span, foot] < place + MAX_LEVEL_DEVIATION_M
    return (is_near & stands).reshape(is_standing.shape)


def find_other_contacts(
    position: Float[np.ndarray, "T N 3"], toes: Float[np.ndarray, "T 2 3"], floor: Floor, rate: float
) -> tuple[Bool[np.ndarray, "T N"], Float[np.ndarray, "T N"]]:
    """Return when other joints stand near the level below the lower foot, not near that of a step, and how probably."""
    logit = np.full(position.shape[:2], -np.inf)
    level = (floor.remove_slope(toes) - floor.compute_height_above(toes)).min(1)
    for n in range(position.shape[1]):
        is_low = floor.remove_slope(position[:, n]) - level < MAX_OTHER_HEIGHT_M
        if is_low.any():
            logit[is_low, n] = compute_standing_logit(compute_speed(position[:, n], rate), rate)[is_low]
    return decode_contacts(logit, rate)


MIN_WALKING_SPEED_M_S = 0.3  # of the hips, below which no share of it is known
WALKING_SMOOTHING_S = 0.1  # standard deviation of the kernel that removes the sway of the hips from their speed
MAX_SLIDE_SHARE = 0.4  # largest speed of a foot that stands, relative to the hips' speed
MAX_STEP_HEIGHT_M = 0.05  # height of the toes of a foot that stands above where they are lowest
STEP_HEIGHT_WINDOW_S = 1.0  # time within which they are: uneven floors are kept
MIN_SLIDE_STEPS = 2  # steps that show a slide
MAX_SHARE_ERROR = 0.1  # difference of a step's share from that of the steps about it
SLIDE_STEPS = 5  # consecutive steps whose median share is that of the middle one
STANDING_PERCENTILE = 25  # of the shares of a step, at which its toes stand: before and after it they roll forward
FITTING_SHARES, MIN_SLIDE_M_S = (-0.06, 0.03), 0.03
"""Shares of the hips' speed between which, and speed below which, feet do not slide: -0.04 to 0.02 in walks, 0.04 and 0.05 where
the path is 3 % too long, -0.10 where it is 10 % too short."""


class Slide(NamedTuple):
    """How far the path of a body is off its steps."""

    path: Float[np.ndarray, "T 3"]  # m: by which the body has moved too far since the beginning; 0 if its feet do not slide
    is_support: Bool[np.ndarray, "T 2"]  # when the left and the right foot, without this, stand or roll while the other swings


def estimate_slide(
    hips: Float[np.ndarray, "T 3"], toes: Float[np.ndarray, "T 2 3"], contacts: BodyContacts, *, is_given: bool
) -> Slide:
    """Return how far a body moves beyond its steps, as a share of the horizontal velocity of its hips that changes slowly.

    A foot that stands is low and moves backwards relative to the hips about as fast as these move; one that swings overtakes the
    hips. The share is the speed of the toes in the direction of the hips, relative to that of the hips. It is negative where the
    path is too short.

    Args:
        hips: Metres.
        toes: Metres, of the left and of the right foot.
        contacts: Those that are found without a slide, or given.
        is_given: The contacts are given, and feet slide in them.
    """
    no_slide = Slide(np.zeros(hips.shape), np.zeros((len(hips), 2), bool))
    if len(hips) < 2:
        return no_slide
    velocity = np.gradient(hips, 1 / contacts.rate, axis=0) * [1.0, 0.0, 1.0]
    smooth = smooth_values(velocity, WALKING_SMOOTHING_S * contacts.rate)
    speed, toe_velocity = np.linalg.norm(smooth, axis=1, keepdims=True), np.gradient(toes, 1 / contacts.rate, axis=0)
    shares = np.einsum("tfi,ti->tf", toe_velocity, smooth) / np.maximum(speed, MIN_WALKING_SPEED_M_S) ** 2
    lowest = slide_windows(toes[..., 1], 2 * round(STEP_HEIGHT_WINDOW_S / 2 * contacts.rate) + 1).min(2)
    is_support = (toes[..., 1] < lowest + MAX_STEP_HEIGHT_M) & (np.abs(shares) < MAX_SLIDE_SHARE) & (shares[:, ::-1] > 1)
    is_contact = np.stack([contacts.find_foot_contact(side) for side in FOOT_JOINTS], axis=1)
    is_support = (is_contact if is_given else is_support) & (speed > MIN_WALKING_SPEED_M_S)
    supports = [(foot, run) for foot in (0, 1) for run in find_runs(remove_short_runs(is_support[:, foot], contacts.rate))]
    steps = sorted((sum(run) / 2, foot, slice(run[0], run[1] + 1)) for foot, run in supports)
    step_shares = np.array([np.percentile(shares[span, foot], STANDING_PERCENTILE) for _, foot, span in steps])
    speeds = [share * speed[span].mean() for share, (_, _, span) in zip(step_shares, steps, strict=True)]
    is_sliding = len(steps) >= MIN_SLIDE_STEPS and abs(np.median(speeds)) > MIN_SLIDE_M_S
    is_sliding = is_sliding and not FITTING_SHARES[0] <= np.median(step_shares) <= FITTING_SHARES[1]
    if not steps:
        return no_slide
    usual, path = np.median(slide_windows(step_shares, SLIDE_STEPS), axis=1), np.zeros(hips.shape)
    if is_given or is_sliding:
        share = np.interp(np.arange(len(hips)), [frame for frame, _, _ in steps], usual)
        path = np.cumsum(share[:, None] * velocity, axis=0) / contacts.rate
    rolls = np.stack([compute_speed(toe - path, contacts.rate) for toe in toes.swapaxes(0, 1)], axis=1) < ROLLING_SPEED_M_S
    for (_, foot, span), step_share, usual_share in zip(steps, step_shares, usual, strict=True):
        no_slide.is_support[span, foot] = rolls[span, foot] & (abs(step_share - usual_share) < MAX_SHARE_ERROR)
    return Slide(path, np.stack([remove_short_runs(each, contacts.rate) for each in no_slide.is_support.T], axis=1))


def replace_contacts(
    contacts: BodyContacts, given: Mapping[str, Bool[np.ndarray, " T"]], toes: Float[np.ndarray, "T 2 3"]
) -> BodyContacts:
    """Return contacts that are given, by joint, in place of those that were found; toes in metres show their floor."""
    contacts = contacts if set(given) <= set(contacts.joints) else contacts.add_other_joints()
    is_contact = [given.get(joint, np.zeros(len(toes), bool)) for joint in contacts.joints]
    contacts = contacts.change_contacts(np.stack(is_contact, axis=1))
    is_standing = np.stack([contacts.find_foot_contact(side) for side in FOOT_JOINTS], axis=1)
    return replace(contacts, floor=estimate_floor(toes, is_standing, contacts.rate))
