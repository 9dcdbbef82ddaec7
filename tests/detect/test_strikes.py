"""Fast motion with nothing wrong: no sample is changed, and a spike within it is still found."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.detect.loop import detect_sample_faults
from mocapfix.lab.common_task import clean_composed_take
from mocapfix.lab.extreme_motions import EXTREME_MOTIONS
from mocapfix.lab.stress import compose_extreme_take
from mocapfix.model.changes import compare_samples
from mocapfix.model.faults import REPLACED_SAMPLE_KINDS
from mocapfix.model.take import Take

UP = np.array([0.0, 1.0, 0.0])


def build_take(synthetic_take, markers=None):
    return Take(synthetic_take.marker_positions if markers is None else markers, synthetic_take.labels, synthetic_take.rate)


def find_fastest_samples(synthetic_take, count):
    """Return the frames and markers of the fastest samples of `count` markers, half a frame after or before each peak."""
    speed = np.linalg.norm(np.diff(synthetic_take.marker_positions, axis=0), axis=-1)
    markers = np.argsort(-speed.max(0))[:count]
    return [(int(speed[:, m].argmax()), int(m)) for m in markers]


@pytest.mark.parametrize("name", EXTREME_MOTIONS)
def test_extreme_motion_has_no_faulty_samples(name):
    take = build_take(compose_extreme_take(name, seed=2, rate=120.0, with_soft_tissue=True))
    assert detect_sample_faults(take).select_kinds(*REPLACED_SAMPLE_KINDS) == []


@pytest.mark.parametrize(
    ("name", "size_m", "frames_before"),
    [("punch", 0.03, 12), ("kick", 0.03, 12), ("throw", 0.03, 12), ("kick", 0.1, 0), ("throw", 0.1, 0)],
)
def test_spike_within_a_strike_is_found(name, size_m, frames_before):
    """Where a marker accelerates by 300 m/s2, its path alone does not show a spike of 30 mm; the body does, see the next test."""
    sound = compose_extreme_take(name, seed=2, rate=120.0, with_soft_tissue=True)
    for fastest, marker in find_fastest_samples(sound, 3):
        frame, markers = fastest - frames_before, sound.marker_positions.copy()
        markers[frame, marker] += size_m * UP
        faults = detect_sample_faults(build_take(sound, markers)).select_kinds(*REPLACED_SAMPLE_KINDS)
        assert [(fault.kind, fault.marker, fault.first, fault.last) for fault in faults] == [("spike", marker, frame, frame)]


def test_clean_changes_the_spike_of_a_punch_and_nothing_else():
    sound = compose_extreme_take("punch", seed=2, rate=60.0, with_soft_tissue=True)
    (frame, marker), *_ = find_fastest_samples(sound, 1)
    markers = sound.marker_positions.copy()
    markers[frame, marker] += 0.03 * UP
    result = clean_composed_take(replace(sound, damaged_positions=markers))
    changed = np.argwhere(compare_samples(result.input_take, result.take))
    assert [(int(t), result.input_take.bare_labels[m]) for t, m in changed] == [(frame, sound.labels[marker])]
    repaired = result.take.markers[frame, changed[0, 1]]
    assert np.linalg.norm(repaired - sound.marker_positions[frame, marker]) < 0.01
