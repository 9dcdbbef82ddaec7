"""3-D keypoints: exchanged sides, outliers and noise, and the body that is fitted to them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.detect.keypoints import (
    detect_keypoint_swaps,
    estimate_noise_sd,
    find_exchanged_frames,
    find_hand_columns,
    find_mirrored_columns,
    smooth_point,
)
from mocapfix.hands.finger_markers import SIDES, find_finger_markers, load_finger_schemes
from mocapfix.hands.hand_model import load_hand
from mocapfix.labels.label_swaps import undo_label_exchanges
from mocapfix.model.faults import build_fault_mask
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.solve import kinematics
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take

HALPE = load_marker_set("halpe26")
NOISE_SD_M = 0.02
RATE = 60.0


class ProjectedKeypoints:
    """Keypoints of a composed take with 20 mm of noise, a tenth missing, and 2 % of the samples exchanged between the sides."""

    def __init__(self, seed: int = 3, seconds: float = 12.0) -> None:
        composed, rng = compose_take(seed=seed, seconds=seconds, rate=RATE), np.random.default_rng(seed)
        skeleton = composed.subject.skeleton
        self.joints, rotations = kinematics.compute_world_poses(skeleton, composed.motion)
        size = skeleton.total_length_m / load_cmu31_body().skeleton.total_length_m
        offsets = np.einsum("tkab,kb->tka", rotations[:, HALPE.joints], HALPE.marker_offsets * size)
        self.truth = self.joints[:, HALPE.joints] + offsets
        measured = self.truth + rng.normal(0, NOISE_SD_M, self.truth.shape)
        self.exchanged = np.zeros(measured.shape[:2], bool)
        for name in ("Knee", "Ankle", "Wrist", "Elbow") * 6:
            first, length = rng.integers(5, len(measured) - 15), rng.integers(2, 10)
            left, right = HALPE.labels.index(f"L{name}"), HALPE.labels.index(f"R{name}")
            frames = slice(first, first + length)
            if not self.exchanged[first - 2 : first + length + 2, left].any():
                measured[frames, [left, right]] = measured[frames, [right, left]]
                self.exchanged[frames, [left, right]] = True
        self.missing = np.zeros(measured.shape[:2], bool)
        while self.missing.mean() < 0.1:
            marker, first = rng.integers(len(HALPE.labels)), rng.integers(len(measured))
            self.missing[first : first + rng.integers(1, 20), marker] = True
        self.markers = np.where(self.missing[..., None], np.nan, measured)
        self.take = Take(self.markers, HALPE.labels, RATE)

    def write_trc(self, path: Path) -> Path:
        frame_count, labels = len(self.markers), "\t\t\t".join(HALPE.labels)
        header = f"PathFileType\t4\t(X/Y/Z)\t{path.name}\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\n"
        header += f"{RATE}\t{RATE}\t{frame_count}\t{len(HALPE.labels)}\tm\nFrame#\tTime\t{labels}\t\t\n\t\tX1\tY1\tZ1\n\n"
        rows = [
            f"{t + 1}\t{t / RATE:.5f}\t" + "\t".join("" if np.isnan(x) else f"{x:.6f}" for x in frame.ravel())
            for t, frame in enumerate(self.markers)
        ]
        path.write_text(header + "\n".join(rows) + "\n", encoding="utf-8")
        return path


@pytest.fixture(scope="module")
def projected():
    return ProjectedKeypoints()


@pytest.mark.parametrize("is_smoothed", [False, True])
def test_body_of_pose2sim_keypoints(projected, tmp_path, is_smoothed):
    result = pipeline.clean(projected.write_trc(tmp_path / "walk.trc"), smooth_keypoints=is_smoothed)
    assert result.subject is not None
    assert result.subject.marker_set == "halpe26"
    given_error = np.linalg.norm(projected.markers - projected.truth, axis=-1)[~projected.missing]
    names = result.subject.skeleton.names
    joint_error = np.linalg.norm(result.joint_position_world - projected.joints, axis=-1)
    limbs = [names.index(side + joint) for side in ("Left", "Right") for joint in ("Leg", "Foot", "Arm", "ForeArm", "UpLeg")]
    assert joint_error[:, limbs].mean() < 2 / 3 * given_error.mean()
    cleaned_error = np.linalg.norm(result.take.markers - projected.truth, axis=-1)
    is_kept = ~projected.missing & ~projected.exchanged
    if is_smoothed:
        assert np.nanmean(cleaned_error) < given_error.mean() / 3
    else:
        is_own = (result.take.markers == result.input_take.markers).all(axis=-1)
        assert is_own[is_kept].mean() > 0.999
    assert np.isnan(cleaned_error).mean() < 0.01
    assert np.nanmax(cleaned_error[projected.exchanged & ~projected.missing]) < 0.15
    assert any("keypoints, not markers" in note for note in result.subject_report["notes"])


def test_exchanged_sides_are_found(projected):
    faults = detect_keypoint_swaps(projected.take, HALPE, estimate_noise_sd(projected.markers))
    found = build_fault_mask(faults, projected.missing.shape)
    is_visible = ~projected.missing
    distance = np.linalg.norm(projected.markers - projected.truth, axis=-1)
    matters = projected.exchanged & is_visible & (distance > 0.15)
    assert found[matters].mean() > 0.9
    assert not (found & ~projected.exchanged & is_visible).sum() > 0.001 * found.size


def test_straight_keypoints_have_no_exchange(projected):
    rng = np.random.default_rng(0)
    take = replace(projected.take, markers=projected.truth + rng.normal(0, NOISE_SD_M, projected.truth.shape))
    assert detect_keypoint_swaps(take, HALPE, estimate_noise_sd(take.markers)) == []


@pytest.fixture(scope="module")
def hands():
    """Return a body with the keypoints of both hands, which are stiff, with noise and a tenth of the samples missing."""
    composed, rng, body = compose_take(seed=4, seconds=10.0, rate=RATE), np.random.default_rng(4), load_marker_set("coco133")
    skeleton = composed.subject.skeleton
    joints, rotations = kinematics.compute_world_poses(skeleton, composed.motion)
    fingers = [each.markers for each in find_finger_markers("coco133", tuple(_list_hand_labels()))]
    of_body = [k for k, label in enumerate(body.labels) if label not in _list_hand_labels()]
    carriers, offsets = body.joints[of_body], body.marker_offsets[of_body]
    markers = [joints[:, carriers] + np.einsum("tkab,kb->tka", rotations[:, carriers], offsets)]
    for side, hand in zip(SIDES, fingers, strict=True):
        joint = skeleton.find_joint(f"{side}Hand")
        places = load_hand(side).skeleton.rest_positions[hand.joints] + hand.marker_offsets
        markers.append(markers[0][:, [body.labels.index(f"{side.lower()}_wrist")]] + places @ rotations[:, joint].swapaxes(1, 2))
    points = np.concatenate(markers, axis=1)
    points += rng.normal(0, 0.01, points.shape)
    points[rng.random(points.shape[:2]) < 0.1] = np.nan
    return Take(points, tuple(body.labels[k] for k in of_body) + tuple(_list_hand_labels()), RATE)


def _list_hand_labels():
    return [
        label for each in load_finger_schemes() if each.name == "coco133-hands" for hand in each.hands for label in hand.labels
    ]


@pytest.mark.parametrize(("first", "last"), [(100, 100), (100, 103), (0, 40), (200, 420)])
def test_exchanged_hands_go_back_as_a_whole(hands, first, last):
    body, markers = load_marker_set("coco133"), hands.markers.copy()
    assert detect_keypoint_swaps(hands, body, estimate_noise_sd(markers)) == []
    left, right = (list(columns) for columns in zip(*find_hand_columns(hands, body), strict=True))
    assert len(left) == 21
    markers[first : last + 1, left + right] = markers[first : last + 1, right + left]
    wrong = hands.replace_markers(markers)
    found = detect_keypoint_swaps(wrong, body, estimate_noise_sd(markers))
    assert {(fault.first, fault.last) for fault in found} == {(first, last)}
    np.testing.assert_array_equal(undo_label_exchanges(wrong, found).markers, hands.markers)


def test_points_at_one_place_are_paired_with_their_own_twins(hands):
    body = load_marker_set("coco133")
    for lost in ("", "left_wrist", "right_hand_root"):
        take = hands.masked(hands.visible)
        take = replace(take, labels=tuple("other" if label == lost else label for label in take.labels))
        pairs = [(take.labels[a], take.labels[b]) for a, b in find_mirrored_columns(take, body)]
        twins = [(label, label.replace("left", "right")) for label in body.labels if label.startswith("left")]
        assert sorted(pairs) == sorted(pair for pair in twins if lost not in pair)


def test_mirrored_pairs_go_from_the_trunk_outwards(projected):
    pairs = [(HALPE.labels[a], HALPE.labels[b]) for a, b in find_mirrored_columns(projected.take, HALPE)]
    assert len(pairs) == 11
    assert all(left.replace("L", "R", 1) == right for left, right in pairs)
    order = [left for left, _ in pairs]
    assert order.index("LHip") < order.index("LKnee") < order.index("LHeel")


@pytest.mark.parametrize("first", [0, 30, 80])
def test_exchange_between_two_points(first):
    t = np.arange(100) / RATE
    left, right = np.stack([t, 0 * t, 0 * t + 0.1], axis=-1), np.stack([t, 0 * t, 0 * t - 0.1], axis=-1)
    a, b = left.copy(), right.copy()
    a[first : first + 20], b[first : first + 20] = right[first : first + 20], left[first : first + 20]
    b[first + 5] = np.nan  # one of the two alone
    found = find_exchanged_frames(a, b, 0.01, RATE, np.zeros(100))
    np.testing.assert_array_equal(np.flatnonzero(found), np.arange(first, first + 20))


@pytest.mark.parametrize("noise_sd_m", [0.01, 0.02, 0.05])
def test_noise_is_estimated_and_removed(noise_sd_m):
    rng, t = np.random.default_rng(1), np.arange(600) / RATE
    truth = np.stack([0.4 * np.sin(2 * np.pi * t), t, 0.2 * np.cos(np.pi * t)], axis=-1)
    measured = truth + rng.normal(0, noise_sd_m, truth.shape)
    estimated = float(estimate_noise_sd(measured[:, None])[0])
    assert estimated == pytest.approx(noise_sd_m, rel=0.2)
    smooth, is_outlier = smooth_point(measured, estimated, RATE, noise_sd_m)
    assert np.sqrt(((smooth - truth) ** 2).mean()) < 0.5 * noise_sd_m
    assert is_outlier.sum() <= 1


def test_outliers_are_found_and_do_not_move_the_path():
    rng, t = np.random.default_rng(2), np.arange(400) / RATE
    truth = np.stack([0.4 * np.sin(2 * np.pi * t), t, 0 * t], axis=-1)
    measured = truth + rng.normal(0, 0.02, truth.shape)
    outliers = np.array([50, 51, 120, 300])
    measured[outliers] += [0.4, 0.0, -0.3]
    measured[200:215] = np.nan
    smooth, is_outlier = smooth_point(measured, 0.02, RATE, 0.02)
    np.testing.assert_array_equal(np.flatnonzero(is_outlier), outliers)
    assert np.isnan(smooth[200:215]).all()
    assert np.nanmax(np.linalg.norm(smooth - truth, axis=-1)) < 0.06


def test_short_and_missing_trajectories_are_left_as_they_are():
    path = np.full((30, 3), np.nan)
    assert np.isnan(smooth_point(path, 0.02, RATE, 0.02)[0]).all()
    path[3:9] = 1.0
    np.testing.assert_array_equal(smooth_point(path, 0.02, RATE, 0.02)[0], path)
