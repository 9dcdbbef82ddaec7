"""Takes of extreme motion with known truth.

The person warms up, as people do at the beginning of a session (without moving all joints they could not be calibrated), and does
a motion of `extreme_motions` once and then with left and right exchanged.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mocapfix.motion import Motion
from mocapfix.solve.kinematics import compute_joint_and_marker_positions
from mocapfix.subject import Subject
from mocapfix.synthetic.extreme_motions import EXTREME_MOTIONS, STAND, WARM_UP
from mocapfix.synthetic.key_poses import (
    KEY_RATE_HZ,
    build_keyed_motion,
    interpolate_key_poses,
    join_angles,
    measure_extremity_motion,
    mirror_moves,
    sample_angles,
    stretch_time,
)
from mocapfix.synthetic.motions import compose_motion
from mocapfix.synthetic.synthetic_takes import DAMAGED_ARM_JOINTS, SyntheticTake, draw_gaps, draw_subject, simulate_markers

ORDINARY_MOTION = "ordinary"  # walking, reaching, crouching and turning round
ORDINARY_DURATION_S = 15.0
SOFT_TISSUE_FREQUENCY_HZ = 16.0  # at which tissue under a marker swings: 15 mm of lag at 150 m/s2
MAX_SOFT_TISSUE_LAG_M = 0.03
SLENDER_LIMB_SHARE = 0.5  # of a marker's distance from the bone on a person with slender limbs: about 25 mm remain
SLENDER_LIMB_BONES = {  # the joint that carries the markers, and the joint at the other end of the bone
    f"{side}{bone}": f"{side}{end}"
    for side in ("Left", "Right")
    for bone, end in (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("UpLeg", "Leg"), ("Leg", "Foot"))
}


def compose_extreme_motion(subject: Subject, name: str, rate: float) -> Motion:
    """Return the warm-up and a motion of EXTREME_MOTIONS, also mirrored, of this person at `rate` Hz."""
    motion, skeleton = EXTREME_MOTIONS[name], subject.skeleton
    warm_up = interpolate_key_poses(skeleton, STAND, WARM_UP)
    action = interpolate_key_poses(skeleton, STAND, motion.moves)
    nominal_speed, _ = measure_extremity_motion(subject, build_keyed_motion(subject, action, KEY_RATE_HZ), KEY_RATE_HZ)
    factor = nominal_speed / motion.peak_speed_m_per_s
    mirrored = interpolate_key_poses(skeleton, STAND, mirror_moves(motion.moves))
    actions = (stretch_time(each, factor) for each in (action, mirrored))
    keyed = warm_up
    for each in actions:
        keyed = join_angles(keyed, each)
    return build_keyed_motion(subject, sample_angles(keyed, rate), rate)


def compose_extreme_take(
    name: str,
    seed: int = 0,
    rate: float = 120.0,
    *,
    with_gaps: bool = False,
    with_soft_tissue: bool = False,
    with_slender_limbs: bool = False,
) -> SyntheticTake:
    """Return a take of a motion of EXTREME_MOTIONS, or of ORDINARY_MOTION to compare with; the same for the same arguments.

    The seed determines the person, whose bones are asymmetric, the skin and the gaps.

    with_gaps           lose markers as `compose_take` does, without spikes
    with_soft_tissue    let the markers lag behind the bones in proportion to the acceleration, besides sliding with the skin
    with_slender_limbs  place the markers of upper arms, forearms, thighs and shins nearer to the bone
    """
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, asymmetric=True)
    subject = move_markers_to_bones(subject) if with_slender_limbs else subject
    if name == ORDINARY_MOTION:
        motion = compose_motion(subject, ORDINARY_DURATION_S, rate)
    else:
        motion = compose_extreme_motion(subject, name, rate)
    joints, markers = simulate_markers(rng, subject, motion, rate)
    if with_soft_tissue:
        markers += simulate_soft_tissue(subject, motion, rate)
    missing = np.zeros(markers.shape[:2], bool)
    if with_gaps:
        is_arm_marker = np.isin(subject.joints, [subject.skeleton.find_joint(joint) for joint in DAMAGED_ARM_JOINTS])
        missing = draw_gaps(rng, motion.frame_count, rate, is_arm_marker)
    seen = np.where(missing[..., None], np.nan, markers)
    return SyntheticTake(motion, subject, joints, markers, seen, missing, np.zeros_like(missing), subject.labels, rate)


def move_markers_to_bones(subject: Subject) -> Subject:
    """Return the person with the limbs' markers nearer to the bones by SLENDER_LIMB_SHARE: they show a bone's turn less well."""
    skeleton, offsets = subject.skeleton, subject.marker_offsets.copy()
    for bone, end in SLENDER_LIMB_BONES.items():
        direction = skeleton.offsets[skeleton.find_joint(end)]
        along = np.outer(direction, direction) / (direction @ direction)
        own = subject.joints == skeleton.find_joint(bone)
        offsets[own] = SLENDER_LIMB_SHARE * offsets[own] + (1 - SLENDER_LIMB_SHARE) * offsets[own] @ along
    return replace(subject, marker_offsets=offsets)


def simulate_soft_tissue(subject: Subject, motion: Motion, rate: float) -> Float[np.ndarray, "T M 3"]:
    """Return the displacements in metres of markers on tissue that follows the bones like a mass on a spring."""
    _, markers = compute_joint_and_marker_positions(subject, motion)
    acceleration = np.gradient(np.gradient(markers, 1 / rate, axis=0), 1 / rate, axis=0)
    lag = -acceleration / (2 * np.pi * SOFT_TISSUE_FREQUENCY_HZ) ** 2
    length = np.linalg.norm(lag, axis=-1, keepdims=True)
    return lag * np.minimum(1, MAX_SOFT_TISSUE_LAG_M / np.maximum(length, MAX_SOFT_TISSUE_LAG_M))
