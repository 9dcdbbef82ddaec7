"""A person, their motion and their markers, with everything known that a take does not tell."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from mocapfix import marker_set
from mocapfix.kernels import kinematics
from mocapfix.motion import Motion
from mocapfix.skeleton import Body, Skeleton, cmu31
from mocapfix.subject import Subject
from mocapfix.synthetic import damage, motions

LENGTHS = 0.04  # standard deviation of a bone group's length, as a part of it
OWN_LENGTHS, OWN_LEANS = 0.03, 0.06  # what a bone has for itself: a part of its length, radians (CMU's subjects, about)
LEANING = ("LeftUpLeg", "RightUpLeg", "Spine", "Spine1", "Neck", "Neck1", "Head", "LeftArm", "RightArm")  # limbs do not
PLACES = 0.012  # metres: standard deviation per axis of a marker's place on the person
SLIDE, SLIDE_TIME = 0.004, 0.3  # metres and seconds: how far skin carries a marker per axis, and for how long
NOISE = 0.0003  # metres: the cameras' own


@dataclass(frozen=True)
class Truth:
    """A composed take: what happened and what the cameras say of it.

    motion   (T frames) of the subject's skeleton
    subject  the person's true bones and marker places
    joints   (T, J, 3) metres: where the joints are
    markers  (T, M, 3) metres: the markers, undamaged
    damaged  (T, M, 3) metres: the markers with spikes, NaN where missing
    struck   (T, M) bool: missing
    moved    (T, M) bool: displaced by a spike
    labels   M marker labels
    rate     frames a second
    """

    motion: Motion
    subject: Subject
    joints: np.ndarray
    markers: np.ndarray
    damaged: np.ndarray
    struck: np.ndarray
    moved: np.ndarray
    labels: tuple[str, ...]
    rate: float


def take(seed: int = 0, seconds: float = 10.0, rate: float = 120.0, crooked: bool = False) -> Truth:
    """-> somebody who walks, reaches, crouches and turns round, and again; the same for the same arguments.

    The seed draws the person, the skin and the damage; the motion differs with the person's legs only.

    crooked  left and right differ and bones lean as people's do, where else only groups of bones are longer or shorter
    """
    rng = np.random.default_rng(seed)
    subject = person(rng, crooked)
    motion = motions.compose(subject, seconds, rate)
    joints, markers = worn(rng, subject, motion, rate)
    arm = np.isin(subject.joints, [subject.skeleton.index(name) for name in damage.ARM])
    struck = damage.gaps(rng, motion.frames, rate, arm)
    shift = damage.spikes(rng, ~struck, rate)
    damaged = np.where(struck[..., None], np.nan, markers + shift)
    return Truth(motion, subject, joints, markers, damaged, struck, (shift != 0).any(axis=2), subject.labels, rate)


def person(rng: np.random.Generator, crooked: bool) -> Subject:
    """-> the average body, every group of bones somewhat longer or shorter, markers put on by hand."""
    nominal = marker_set.load("cmu41")
    places = nominal.places + rng.normal(0, PLACES, nominal.places.shape)
    spread = np.full(len(nominal.labels), SLIDE)
    skeleton = _skeleton(rng, cmu31())
    skeleton = _crooked(rng, skeleton) if crooked else skeleton
    return Subject(skeleton, nominal.name, nominal.labels, nominal.joints, places, spread)


def _skeleton(rng: np.random.Generator, body: Body) -> Skeleton:
    offsets = body.skeleton.offsets.copy()
    for joints in body.groups.values():
        offsets[list(joints)] *= rng.normal(1, LENGTHS)
    return replace(body.skeleton, offsets=offsets)


def _crooked(rng: np.random.Generator, skeleton: Skeleton) -> Skeleton:
    """Every bone with a length and, where none lies along its own axis, a direction of its own."""
    offsets = skeleton.offsets * rng.normal(1, OWN_LENGTHS, (len(skeleton.names), 1))
    leans = Rotation.from_rotvec(rng.normal(0, OWN_LEANS, offsets.shape)).as_matrix()
    leaning = [skeleton.index(name) for name in LEANING]
    offsets[leaning] = np.einsum("jab,jb->ja", leans[leaning], offsets[leaning])
    shoulders = [skeleton.index("LeftShoulder"), skeleton.index("RightShoulder")]
    offsets[shoulders] = offsets[skeleton.index("Neck")]  # one bone, the thorax, carries all three
    return replace(skeleton, offsets=offsets)


def worn(rng: np.random.Generator, subject: Subject, motion: Motion, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> joints (T, J, 3) and markers (T, M, 3), in metres, of a motion: the markers slide with the skin and are seen noisily."""
    _, rotation = kinematics.world(subject.skeleton, motion)
    slide = _skin(rng, motion.frames, len(subject.labels), rate)
    joints, markers = kinematics.placed(subject, motion)
    markers += np.einsum("tkab,tkb->tka", rotation[:, subject.joints], slide) + rng.normal(0, NOISE, markers.shape)
    return joints, markers


def _skin(rng: np.random.Generator, frames: int, markers: int, rate: float) -> np.ndarray:
    """-> (T, M, 3) metres: smooth wandering whose correlation falls to 1/e after SLIDE_TIME."""
    sigma = SLIDE_TIME / 2 * rate  # white noise under a Gaussian of sigma has correlation exp(-lag^2 / 4 sigma^2)
    margin = round(4 * sigma)
    white = rng.normal(size=(frames + 2 * margin, markers, 3))
    smooth = gaussian_filter1d(white, sigma, axis=0)[margin : margin + frames]
    return smooth * SLIDE * np.sqrt(2 * np.sqrt(np.pi) * sigma)
