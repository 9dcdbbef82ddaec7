from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from mocapfix.detect import body_label_swaps, body_outliers, body_residuals
from mocapfix.faults import MIN_LABEL_CONFIDENCE
from mocapfix.take import Take
from tests.detect.bodies import exchanged, hidden
from tests.detect.on_body import RATE, displaced, solved

LABELS = solved().take.labels


def rings(take: Take):
    off = body_residuals.compute_body_residuals(take, take.visible, solved().subject, solved().motion)
    return body_label_swaps.detect_body_label_swaps(off, body_outliers.detect_body_outliers(off, RATE, 0.02), take)


def of(*names):
    return tuple(LABELS.index(name) for name in names)


@pytest.mark.parametrize("names", list(combinations(("LELB", "LWRA", "LWRB", "LFRM"), 2)))
def test_two_labels_that_are_exchanged_are_found_to_the_frame(names):
    (swap,) = rings(exchanged(solved().take, of(*names), 100, 170))
    assert (set(swap.markers), swap.first, swap.last) == (set(of(*names)), 100, 170)
    assert swap.kind == "swap"
    assert swap.confidence > MIN_LABEL_CONFIDENCE


@pytest.mark.parametrize("ring", [("LELB", "LWRA", "LFRM"), ("LFRM", "LWRA", "LELB")])
def test_undoing_what_was_found_gives_the_take_back_also_of_three(ring):
    (swap,) = rings(wrong := exchanged(solved().take, of(*ring), 100, 170))
    np.testing.assert_array_equal(wrong.exchange_labels(swap.markers, swap.first, swap.last).markers, solved().take.markers)


def test_an_exchange_that_begins_and_ends_in_gaps():
    take = exchanged(solved().take, of("RKNE", "RSHN"), 100, 170)
    for label, first, last in (("RKNE", 85, 104), ("RSHN", 92, 101), ("RKNE", 168, 180), ("RSHN", 171, 190)):
        take = hidden(take, LABELS.index(label), first, last)
    (swap,) = rings(take)
    assert (set(swap.markers), swap.first, swap.last) == (set(of("RKNE", "RSHN")), 102, 170)


def test_a_label_in_the_place_of_one_that_is_not_seen():
    take = hidden(exchanged(solved().take, of("RKNE", "RSHN"), 100, 170), LABELS.index("RSHN"), 95, 175)
    (swap,) = rings(take)
    assert (set(swap.markers), swap.first, swap.last) == (set(of("RKNE", "RSHN")), 100, 170)


def test_an_exchange_goes_on_where_the_body_that_it_led_astray_hides_it():
    take = exchanged(solved().take, of("LFWT", "RBWT"), 100, 200)
    motion, frames = solved().motion, slice(130, 180)
    turned = motion.local_rotations.copy()
    turned[frames, 0] = turned[frames, 0] @ np.diag([-1.0, 1.0, -1.0])  # front is back, left is right
    wrong = replace(motion, local_rotations=turned)
    off = body_residuals.compute_body_residuals(take, take.visible, solved().subject, wrong)
    (swap,) = body_label_swaps.detect_body_label_swaps(off, body_outliers.detect_body_outliers(off, RATE, 0.02), take)
    assert (set(swap.markers), swap.first, swap.last) == (set(of("LFWT", "RBWT")), 100, 200)


def test_ghosts_and_a_sound_take_are_no_exchanges():
    assert rings(solved().take) == []
    ghosts = displaced(displaced(solved().take, 3, 100, 150, (0.2, 0.1, 0)), 9, 90, 140, (0, -0.2, 0.1))
    assert rings(ghosts) == []


def test_the_reason_is_a_sentence_with_labels_seconds_and_millimetres():
    (swap,) = rings(exchanged(solved().take, of("LELB", "LWRA"), 100, 159))
    assert " and " in swap.reason
    assert " have exchanged their labels for 0.50 s (60 frames): they lie " in swap.reason
    assert swap.reason.endswith("times nearer to one another's places.")
