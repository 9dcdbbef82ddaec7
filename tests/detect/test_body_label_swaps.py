from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from mocapfix.detect import body_outliers
from mocapfix.model.faults import MIN_LABEL_CONFIDENCE
from mocapfix.model.take import Take
from tests.detect.bodies import exchanged, hidden
from tests.detect.on_body import RATE, displaced, solved

LABELS = solved().take.labels


def detect_swaps(take: Take):
    residuals = body_outliers.compute_body_residuals(take, take.visible, solved().subject, solved().motion)
    return body_outliers.detect_body_label_swaps(residuals, body_outliers.detect_body_outliers(residuals, RATE, 0.02), take)


def indices(*names):
    return tuple(LABELS.index(name) for name in names)


@pytest.mark.parametrize("names", list(combinations(("LELB", "LWRA", "LWRB", "LFRM"), 2)))
def test_swap_of_two_labels_is_found_to_the_frame(names):
    (swap,) = detect_swaps(exchanged(solved().take, indices(*names), 100, 170))
    assert (set(swap.markers), swap.first, swap.last) == (set(indices(*names)), 100, 170)
    assert swap.kind == "swap"
    assert swap.confidence > MIN_LABEL_CONFIDENCE


@pytest.mark.parametrize("cycle", [("LELB", "LWRA", "LFRM"), ("LFRM", "LWRA", "LELB")])
def test_undoing_a_cycle_of_three_restores_the_take(cycle):
    (swap,) = detect_swaps(wrong := exchanged(solved().take, indices(*cycle), 100, 170))
    np.testing.assert_array_equal(wrong.exchange_labels(swap.markers, swap.first, swap.last).markers, solved().take.markers)


def test_swap_that_begins_and_ends_in_gaps():
    take = exchanged(solved().take, indices("RKNE", "RSHN"), 100, 170)
    for label, first, last in (("RKNE", 85, 104), ("RSHN", 92, 101), ("RKNE", 168, 180), ("RSHN", 171, 190)):
        take = hidden(take, LABELS.index(label), first, last)
    (swap,) = detect_swaps(take)
    assert (set(swap.markers), swap.first, swap.last) == (set(indices("RKNE", "RSHN")), 102, 170)


def test_swap_with_a_missing_marker():
    take = hidden(exchanged(solved().take, indices("RKNE", "RSHN"), 100, 170), LABELS.index("RSHN"), 95, 175)
    (swap,) = detect_swaps(take)
    assert (set(swap.markers), swap.first, swap.last) == (set(indices("RKNE", "RSHN")), 100, 170)


def test_swap_extends_over_frames_in_which_the_misled_body_hides_it():
    take = exchanged(solved().take, indices("LFWT", "RBWT"), 100, 200)
    motion, frames = solved().motion, slice(130, 180)
    turned = motion.local_rotations.copy()
    turned[frames, 0] = turned[frames, 0] @ np.diag([-1.0, 1.0, -1.0])  # front is back, left is right
    wrong = replace(motion, local_rotations=turned)
    residuals = body_outliers.compute_body_residuals(take, take.visible, solved().subject, wrong)
    (swap,) = body_outliers.detect_body_label_swaps(residuals, body_outliers.detect_body_outliers(residuals, RATE, 0.02), take)
    assert (set(swap.markers), swap.first, swap.last) == (set(indices("LFWT", "RBWT")), 100, 200)


def test_ghosts_and_a_sound_take_are_no_swaps():
    assert detect_swaps(solved().take) == []
    ghosts = displaced(displaced(solved().take, 3, 100, 150, (0.2, 0.1, 0)), 9, 90, 140, (0, -0.2, 0.1))
    assert detect_swaps(ghosts) == []


def test_reason_names_labels_duration_and_distance():
    (swap,) = detect_swaps(exchanged(solved().take, indices("LELB", "LWRA"), 100, 159))
    assert " and " in swap.reason
    assert " have exchanged their labels for 0.50 s (60 frames): they lie " in swap.reason
    assert swap.reason.endswith("times nearer to one another's.")
