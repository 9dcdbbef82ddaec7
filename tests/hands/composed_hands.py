"""Hands of the model with known poses and markers."""

import numpy as np

from mocapfix.hands.calibrated_hand import CalibratedHand, PalmPath
from mocapfix.hands.finger_markers import FingerMarkers, load_finger_schemes
from mocapfix.hands.hand_model import HAND_JOINTS, load_hand
from mocapfix.solve.kinematics import compute_tree_poses
from mocapfix.stats.rigid_alignment import compute_rotations

RATE_HZ, FRAMES = 60.0, 240


def choose_markers(side, labels=None, scheme="vicon-fingers"):
    scheme = next(each for each in load_finger_schemes() if each.name == scheme).hands[side == "Right"]
    chosen = scheme if labels is None else scheme.select_markers({side[0] + label for label in labels})
    return FingerMarkers(side, chosen, np.arange(len(chosen.labels)))


def build_hand(side, labels=None, scheme="vicon-fingers"):
    """Return the average hand, calibrated without error."""
    hand, markers = load_hand(side), choose_markers(side, labels, scheme)
    return CalibratedHand(hand, hand.palm_position, np.eye(3), markers, markers.markers.marker_offsets, np.zeros(20))


def compose_poses(hand, seed=0):
    """Return a palm that moves and poses from the hand's prior, which change slowly."""
    rng, time = np.random.default_rng(seed), np.arange(FRAMES) / RATE_HZ
    waves = np.sin(2 * np.pi * (0.35 * time[:, None] + rng.random(hand.model.prior.code_size)))
    vectors = hand.model.prior.decode(waves)
    forearm = compute_rotations(np.stack([0.5 * np.sin(time), 0.4 * np.cos(time), 0.3 * np.sin(2 * time)], axis=1))
    palm = PalmPath(np.stack([time, 1 + 0 * time, 0.2 * np.sin(time)], axis=1), forearm, forearm, *np.full((2, FRAMES), 0.02))
    root, local = hand.place_palm(palm)
    local[:, HAND_JOINTS] = local[:, HAND_JOINTS] @ compute_rotations(vectors[:, HAND_JOINTS])
    return palm, (root, local)


def carry_markers(hand, poses):
    position, rotation = compute_tree_poses(hand.tree, *poses)
    joints, offsets = hand.attachment
    return position[:, joints] + (rotation[:, joints] @ offsets[..., None])[..., 0]
