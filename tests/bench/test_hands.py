"""Hands damaged as in MNN-IK's section 5.1: what is damaged, for how long, and a picture of what came of it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix import synthetic
from mocapfix.bench import hands, pictures
from mocapfix.cli import app
from mocapfix.errors import TakeError
from mocapfix.take import Take

PNG = b"\x89PNG\r\n"


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    """-> a composed take of which nothing is missing"""
    truth = synthetic.compose_take(seed=3, seconds=3.0)
    nothing = np.zeros_like(truth.missing_mask)
    path = tmp_path_factory.mktemp("hands") / "sound.c3d"
    synthetic.write_synthetic_take(
        path, replace(truth, missing_mask=nothing, damaged_positions=truth.marker_positions, spike_mask=nothing)
    )
    return path


@pytest.fixture(scope="module")
def moment(sound):
    return hands.compare_hands(sound, hands.ONE_MARKER_DAMAGE)


def take(**places):
    """-> three frames at 100 Hz, of markers at heights or along x"""
    return Take(np.array([places[label] for label in places], float).swapaxes(0, 1), tuple(places), 100.0)


def test_the_moments_are_when_the_right_hand_is_highest_and_when_both_are_nearest():
    right = [[1.0, 1.0, 0], [0.5, 1.2, 0], [0.1, 0.9, 0]]
    found = take(RFIN=right, LFIN=[[0.0, 0.9, 0]] * 3)
    assert (hands.find_highest_hand_frame(found), hands.find_nearest_hands_frame(found)) == (1, 2)
    with pytest.raises(TakeError, match="the take: has no marker LFIN; give a take in CMU's 41 markers"):
        hands.find_nearest_hands_frame(take(RFIN=right))
    with pytest.raises(TakeError, match="the take: never shows the marker RFIN"):
        hands.find_highest_hand_frame(take(RFIN=np.full((3, 3), np.nan)))


def test_shaken_markers_are_off_by_the_noise_and_lost_ones_are_not_there():
    still = np.zeros((2400, 8, 3))
    np.testing.assert_allclose(hands.add_noise(still).std(axis=(0, 2)), hands.HAND_NOISE_SD_M, rtol=0.05)
    assert np.isnan(hands.remove_samples(still)).all()


def test_one_marker_stays_on_the_hand_and_time_and_prior_do_better_than_the_markers_alone(moment, tmp_path):
    assert moment.is_damaged.sum() == 3
    assert np.isnan(moment.damaged_markers[moment.is_damaged]).all()
    assert np.isfinite(moment.cleaned_markers[moment.is_damaged]).all()
    np.testing.assert_array_equal(moment.cleaned_markers[~moment.is_damaged], moment.damaged_markers[~moment.is_damaged])
    assert 0 < moment.cleaned_mm < moment.markers_only_mm
    pictures.draw_hands(tmp_path / "hands.png", moment)
    assert (tmp_path / "hands.png").read_bytes().startswith(PNG)


def test_the_picture_is_seen_from_before_the_body(moment):
    flat = pictures.build_projection(moment)
    left, right = (flat(moment.true_joints[[moment.skeleton.index(name)]])[0] for name in ("LeftArm", "RightArm"))
    assert left[0] > right[0]  # as in a mirror turned round: his left is on our right
    assert left[1] == pytest.approx(moment.true_joints[moment.skeleton.index("LeftArm"), 1])


def test_the_command_draws_both_and_says_how_far_off(moment, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(hands, "moment", lambda path, damage: moment)
    with pytest.raises(SystemExit) as left:
        app.run_command_line(["bench", "hands", "--one-marker", "a.c3d", "--crossed", "b.c3d", "--out", str(tmp_path), "--json"])
    assert left.value.code == 0
    said = json.loads(capsys.readouterr().out)
    assert said["crossed-hands"] == {"alone_mm": moment.markers_only_mm, "cleaned_mm": moment.cleaned_mm}
    assert {path.name for path in tmp_path.iterdir()} == {"hand-one-marker.png", "crossed-hands.png"}
