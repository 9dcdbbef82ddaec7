"""Hands damaged as in MNN-IK's section 5.1: the damage, its repair and the figure."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix.cli import app
from mocapfix.errors import TakeError
from mocapfix.lab import hands
from mocapfix.model.take import Take
from mocapfix.synthetic import compose_take, write_synthetic_take

PNG = b"\x89PNG\r\n"


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    """Write a composed take without missing samples and return its path."""
    truth = compose_take(seed=3, seconds=3.0)
    empty = np.zeros_like(truth.missing_mask)
    path = tmp_path_factory.mktemp("hands") / "sound.c3d"
    write_synthetic_take(path, replace(truth, missing_mask=empty, damaged_positions=truth.marker_positions, spike_mask=empty))
    return path


@pytest.fixture(scope="module")
def comparison(sound):
    return hands.compare_hands(sound, hands.ONE_MARKER_DAMAGE)


def take(**places):
    """Return a take of three frames at 100 Hz with markers at these positions."""
    return Take(np.array([places[label] for label in places], float).swapaxes(0, 1), tuple(places), 100.0)


def test_frames_of_highest_hand_and_nearest_hands_are_found():
    right = [[1.0, 1.0, 0], [0.5, 1.2, 0], [0.1, 0.9, 0]]
    found = take(RFIN=right, LFIN=[[0.0, 0.9, 0]] * 3)
    assert (hands.find_highest_hand_frame(found), hands.find_nearest_hands_frame(found)) == (1, 2)
    with pytest.raises(TakeError, match="the take: has no marker LFIN; give a take in CMU's 41 markers"):
        hands.find_nearest_hands_frame(take(RFIN=right))
    with pytest.raises(TakeError, match="the take: the marker RFIN is never visible"):
        hands.find_highest_hand_frame(take(RFIN=np.full((3, 3), np.nan)))


def test_noise_and_removal_of_samples():
    still = np.zeros((2400, 8, 3))
    np.testing.assert_allclose(hands.add_noise(still).std(axis=(0, 2)), hands.HAND_NOISE_SD_M, rtol=0.05)
    assert np.isnan(hands.remove_samples(still)).all()


def test_cleaning_is_better_than_the_markers_only(comparison, tmp_path):
    assert comparison.is_damaged.sum() == 3
    assert np.isnan(comparison.damaged_markers[comparison.is_damaged]).all()
    assert np.isfinite(comparison.cleaned_markers[comparison.is_damaged]).all()
    np.testing.assert_array_equal(
        comparison.cleaned_markers[~comparison.is_damaged], comparison.damaged_markers[~comparison.is_damaged]
    )
    assert 0 < comparison.cleaned_mm < comparison.markers_only_mm
    hands.draw_hands(tmp_path / "hands.png", comparison)
    assert (tmp_path / "hands.png").read_bytes().startswith(PNG)


def test_projection_is_seen_from_in_front_of_the_body(comparison):
    project = hands.build_projection(comparison)
    left, right = (project(comparison.true_joints[[comparison.skeleton.find_joint(name)]])[0] for name in ("LeftArm", "RightArm"))
    assert left[0] > right[0]  # the left of the body is on the right of the picture
    assert left[1] == pytest.approx(comparison.true_joints[comparison.skeleton.find_joint("LeftArm"), 1])


def test_command_draws_both_and_prints_the_errors(comparison, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(hands, "compare_hands", lambda path, damage: comparison)
    with pytest.raises(SystemExit) as exited:
        app.run_command_line(["bench", "hands", "--one-marker", "a.c3d", "--crossed", "b.c3d", "--out", str(tmp_path), "--json"])
    assert exited.value.code == 0
    results = json.loads(capsys.readouterr().out)
    assert results["crossed-hands"] == {"alone_mm": comparison.markers_only_mm, "cleaned_mm": comparison.cleaned_mm}
    assert {path.name for path in tmp_path.iterdir()} == {"hand-one-marker.png", "crossed-hands.png"}
