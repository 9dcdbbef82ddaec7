"""The stretches that the add-on marks on the timeline."""

import numpy as np
import pytest

from tests.addon.addon_modules import load_addon_module

stretches, solved_take = (load_addon_module(name) for name in ("uncertain_stretches", "solved_take"))
RATE_HZ, FIRST_FRAME = 100.0, 301
LABELS = ("A", "B", "C", "D", "E")


def build_take(sd=None, status=None, unfilled=()):
    marker_sd = np.full((200, len(LABELS)), np.nan) if sd is None else sd
    report = {"take": {}, "fill": {"unfilled": list(unfilled)}}
    body = None
    if status is not None:
        zeros = np.zeros((200, 3))
        body = solved_take.SkeletonMotion(
            ("Hips",), np.array([-1]), zeros, zeros, zeros, np.zeros((200, 1, 4)), RATE_HZ, np.ones(1)
        )
    return solved_take.SolvedTake(
        "a", "", LABELS, np.zeros((200, len(LABELS), 3)), marker_sd, RATE_HZ, FIRST_FRAME, body,
        np.zeros(0, int) if status is None else status, ("solved: well", "guessed: too few", "placed: simply"), report,
    )  # fmt: skip


def test_fills_above_the_limit_are_one_stretch_with_the_largest_deviation():
    sd = np.full((200, 5), np.nan)
    sd[50:60, 1], sd[62:80, 2], sd[100:110, 3] = 0.07, 0.09, 0.05
    found = stretches.find_uncertain_stretches(build_take(sd), 0.06)
    assert found == [stretches.UncertainStretch(0.5, 0.79, "B, C filled ±90 mm")]


def test_stretches_that_lie_apart_are_separate_and_many_labels_are_counted():
    sd = np.full((200, 5), np.nan)
    sd[10:20], sd[60:61, 0] = 0.1, 0.2
    found = stretches.find_uncertain_stretches(build_take(sd), 0.06)
    assert [(each.first_s, each.last_s, each.text) for each in found] == [
        (0.1, 0.19, "A, B, C and 2 more filled ±100 mm"),
        (0.6, 0.6, "A filled ±200 mm"),
    ]


def test_poses_that_are_not_solved_are_marked_with_their_status():
    status = np.zeros(200, int)
    status[40:60], status[100:120] = 1, 2
    found = stretches.find_uncertain_stretches(build_take(status=status), 0.06)
    assert found == [stretches.UncertainStretch(0.4, 0.59, "pose guessed: too few")]


def test_empty_stretches_are_in_frames_of_the_file():
    unfilled = [
        {"marker": "D", "first": FIRST_FRAME + 10, "last": FIRST_FRAME + 20, "reason": ""},
        {"marker": "unknown", "first": FIRST_FRAME, "last": FIRST_FRAME + 5, "reason": ""},
    ]
    found = stretches.find_uncertain_stretches(build_take(unfilled=unfilled), 0.06)
    assert found == [stretches.UncertainStretch(pytest.approx(0.1), pytest.approx(0.2), "D left empty")]


def test_certain_take_has_no_stretches():
    assert stretches.find_uncertain_stretches(build_take(status=np.zeros(200, int)), 0.06) == []
