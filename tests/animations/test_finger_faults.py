"""Fingers of animations: faults are found and repaired as those of other joints, and fingers that stand still are reported.

`python -m tests.animations.test_finger_faults` prints the figures of docs/animations.md.
"""

import json
import sys
from collections import defaultdict
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.animations.clean import clean_animation, describe_still_fingers, find_body, inspect_animation
from mocapfix.animations.detect import detect_animation_faults, detect_pose_faults
from mocapfix.animations.repair import repair_animation
from mocapfix.hands.calibrated_hand import CalibratedHand
from mocapfix.hands.finger_markers import SIDES, FingerMarkers, load_finger_schemes
from mocapfix.hands.hand_model import HAND_JOINTS, load_hand
from mocapfix.hands.solve_hands import HandMotion, attach_hands
from mocapfix.io.bvh import read_bvh, write_bvh_tree
from mocapfix.lab import animation_repair
from mocapfix.lab.hands import HAND_RATE_HZ, compose_angles
from mocapfix.model.stage_timer import StageTimer
from mocapfix.options import CleanOptions
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses, compute_world_poses
from mocapfix.synthetic import compose_motion, draw_subject

SECONDS, RATE = 24.0, HAND_RATE_HZ
FINGER_JOINTS = ("Metacarpal", "Proximal", "Intermediate", "Distal")  # ends of names
LOST_FINGERS = (
    ("IndexProximal", "IndexIntermediate", "IndexDistal"),
    ("ThumbMetacarpal", "ThumbProximal", "ThumbDistal"),
    ("RingIntermediate", "RingDistal"),
    tuple(
        f"{finger}{bone}" for finger in ("Index", "Middle", "Ring", "Little") for bone in ("Proximal", "Intermediate", "Distal")
    ),
)
EXPORT_AGAIN = "while the arm does, and are left so: if they should move, export the fingers again."
STOP = slice(900, 1200)


@cache
def compose_person(seed: int):
    """Return the motion of a person with 30 finger joints, and the tree, positions and rotations of a file."""
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, True, "frontwaist53")
    motion = compose_motion(subject, SECONDS, RATE)
    frames, skeleton = motion.frame_count, subject.skeleton
    positions, rotations = compute_world_poses(skeleton, motion)
    schemes = next(each.hands for each in load_finger_schemes() if each.name == "vicon-fingers")
    hands = []
    for side, scheme in zip(SIDES, schemes, strict=True):
        model, joint = load_hand(side), skeleton.find_joint(f"{side}Hand")
        markers = FingerMarkers(side, scheme, np.arange(10))
        hand = CalibratedHand(model, model.palm_position, np.eye(3), markers, scheme.marker_offsets, np.zeros(20))
        angles = compose_angles(rng, frames)
        angles[:, 5::3, 0] = 0.67 * angles[:, 4::3, 0]
        values = np.pad(angles[..., ::-1], ((0, 0), (0, 0), (1, 0)))
        local = np.tile(model.skeleton.rest_rotations, (frames, 1, 1, 1))
        bends = Rotation.from_rotvec(model.compute_angles(values).reshape(-1, 3)).as_matrix()
        local[:, HAND_JOINTS] = bends.reshape(frames, len(HAND_JOINTS), 3, 3)
        local[:, 0] = rotations[:, joint]
        wrist = positions[:, joint] + local[:, 0] @ np.array([0.06 if side == "Left" else -0.06, 0, 0])
        unknown = np.zeros((frames, 20, 3)), np.zeros((frames, 20)), np.zeros((frames, 15)), np.ones((frames, 5), bool)
        palm_axes = model.convert_to_palm_axes(local)
        hands.append(HandMotion(hand, wrist, local[:, 0], palm_axes, *unknown, np.zeros((frames, 10))))
    return motion, attach_hands(skeleton, motion, RATE, hands, RATE)


def list_fingers(names, side="") -> list[int]:
    return [j for j, name in enumerate(names) if name.startswith(side) and name.endswith(FINGER_JOINTS)]


def measure_repairs(people: range) -> tuple[dict, int]:
    """Inject faults into the fingers of people: by kind and duration, those found, and errors of the fingers in mm.

    Also returns the number of faults that are found in the sound motions.
    """
    scores, false_count = defaultdict(lambda: defaultdict(list)), 0
    for seed in people:
        motion, (skeleton, _, local) = compose_person(seed)
        motion = replace(motion, local_rotations=local)
        fingers, tree = list_fingers(skeleton.names), build_kinematic_tree(skeleton)
        pose = skeleton.names, motion.root_position
        orders = ["ZYX"] * len(skeleton.names)
        false_count += len(detect_pose_faults(*pose, local, orders, RATE))
        truth = compute_tree_poses(tree, motion.root_position, local)[0]
        for k, kind in enumerate(("flip", "pop", "jitter", "limb gap")):
            for d, duration in enumerate(animation_repair.FAULT_DURATION_RANGES_S):
                if (kind, duration) == animation_repair.SKIPPED_COMBINATION:
                    continue
                rng = np.random.default_rng([seed, k, d])
                damaged, injected = animation_repair.inject_animation_faults(motion, skeleton, RATE, kind, duration, rng)
                found = detect_pose_faults(*pose, damaged.local_rotations, orders, RATE)
                repair = repair_animation(
                    skeleton.parents, motion.root_position, damaged.local_rotations, orders, found, RATE, None
                )
                linear = animation_repair.interpolate_faults(motion.root_position, damaged.local_rotations, injected)[1]
                for each in injected:
                    frames, row = slice(each.first, each.last + 1), scores[kind, duration]
                    hits = (f for f in found if f.first <= each.last and each.first <= f.last)
                    row["found"].append(any(set(each.joints) & set(fault.markers) for fault in hits))
                    for name, rotations in (
                        ("damaged", damaged.local_rotations),
                        ("repaired", repair.local_rotations),
                        ("linear", linear),
                    ):
                        posed = np.ascontiguousarray(np.nan_to_num(rotations[frames]))
                        position = compute_tree_poses(tree, motion.root_position[frames], posed)[0]
                        row[name].append(1e3 * np.linalg.norm(position - truth[frames], axis=-1)[:, fingers].mean())
    return {key: {name: float(np.mean(values)) for name, values in row.items()} for key, row in scores.items()}, false_count


def inject_into_fingers(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(animation_repair, "INJECTABLE_JOINT_NAMES", FINGER_JOINTS)
    patch.setattr(animation_repair, "INJECTED_LIMB_JOINT_NAMES", LOST_FINGERS)


def test_faults_of_fingers_are_found_and_repaired_and_sound_fingers_have_none(monkeypatch):
    inject_into_fingers(monkeypatch)
    rows, false_count = measure_repairs(range(101, 102))
    assert false_count == 0
    for (kind, duration), row in rows.items():
        least = 0.4 if (kind, duration) in {("limb gap", "1 frame"), ("pop", "long")} else 0.75
        assert row["found"] >= least, (kind, duration)
        assert row["repaired"] < 0.6 * row["damaged"], (kind, duration)


@pytest.fixture(scope="module")
def animation(tmp_path_factory):
    path = tmp_path_factory.mktemp("fingers") / "fingers.bvh"
    write_bvh_tree(path, *compose_person(100)[1], RATE)
    return read_bvh(path)


def get_columns(animation, joints) -> list[int]:
    return [int(column) for joint in joints for column in animation.get_rotation_channels(joint)[0]]


def stop(animation, joints, frames: slice):
    """Return the animation with joints that stop and continue later from where they stopped."""
    values, columns = animation.values.copy(), get_columns(animation, joints)
    later, count = animation.values[:, columns], frames.stop - frames.start
    values[frames, columns] = later[frames.start - 1]
    values[frames.stop :, columns] = later[frames.start : len(later) - count]
    return animation.replace_values(values)


def describe(animation) -> list[str]:
    return describe_still_fingers(animation, find_body(animation)[0], detect_animation_faults(animation))


def test_moving_fingers_are_not_reported(animation):
    assert describe(animation) == []


def test_fingers_that_stop_are_reported_with_their_frames_and_not_changed(animation):
    stopped = stop(animation, list_fingers(animation.names, "Left"), STOP)
    note = f"The fingers of the left hand do not move in frames 900–1200 (301 frames) {EXPORT_AGAIN}"
    result = clean_animation(stopped, CleanOptions(), None, StageTimer())
    assert "notes" in result.report
    assert [each for each in result.report["notes"] if "fingers" in each] == [note]
    assert note in str(inspect_animation(stopped, CleanOptions()))
    fingers = get_columns(animation, list_fingers(animation.names))
    assert np.array_equal(result.animation.values[:, fingers], stopped.values[:, fingers])


def test_fingers_that_never_move_but_for_rounding_are_one_sentence(animation):
    values, columns = animation.values.copy(), get_columns(animation, list_fingers(animation.names))
    values[:, columns] = values[0, columns] + 1e-4 * np.random.default_rng(0).integers(0, 2, (len(values), len(columns)))
    assert describe(animation.replace_values(values)) == [f"The fingers of the left and right hand never move {EXPORT_AGAIN}"]


@pytest.mark.parametrize("frames", [STOP, slice(1, 2400)])
def test_fingers_that_rest_with_the_arm_are_not_reported(animation, frames):
    arm = [animation.names.index(f"Left{name}") for name in ("Arm", "ForeArm", "Hand")]
    assert describe(stop(animation, arm + list_fingers(animation.names, "Left"), frames)) == []


def test_a_hand_of_which_one_finger_moves_is_not_reported(animation):
    others = [j for j in list_fingers(animation.names, "Left") if "Index" not in animation.names[j]]
    assert describe(stop(animation, others, slice(1, 2400))) == []


def test_fingers_that_a_fault_holds_are_a_fault_and_no_note(animation):
    values, columns = animation.values.copy(), get_columns(animation, list_fingers(animation.names, "Left"))
    values[STOP, columns] = 0.0
    held = animation.replace_values(values)
    assert describe(held) == []
    assert any(fault.kind == "gap" for fault in detect_animation_faults(held))


if __name__ == "__main__":
    inject_into_fingers(pytest.MonkeyPatch())
    table, false_detections = measure_repairs(range(100, 104))
    json.dump({"rows": {", ".join(key): row for key, row in table.items()}, "false": false_detections}, sys.stdout, indent=1)
