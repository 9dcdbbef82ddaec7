import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.detect.loop import detect_on_trajectories
from mocapfix.io import capture
from mocapfix.kernels import label_evidence
from mocapfix.lab.clean_speed import compose_heavily_damaged_take
from mocapfix.labels import label_swaps
from mocapfix.model.faults import MIN_LABEL_CONFIDENCE, FaultReview
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions
from mocapfix.stats.marker_distances import build_trajectories, estimate_distances
from mocapfix.stats.sequences import find_runs
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take
from tests.captures import CAPTURES, needs_captures
from tests.detect.bodies import exchanged, hidden, turning


def undone(take, found):
    for swap in found:
        if swap.confidence >= MIN_LABEL_CONFIDENCE:
            take = take.exchange_labels(swap.markers, swap.first, swap.last)
    return take


def where(found):
    return [(swap.markers, swap.first, swap.last) for swap in found]


@given(
    seed=st.integers(0, 20),
    pair=st.sampled_from([(0, 1), (2, 4), (1, 7), (5, 9)]),
    first=st.integers(1, 300),
    length=st.integers(12, 170),
)
def test_visible_swap_is_found_to_the_frame(seed, pair, first, length):
    take = exchanged(turning(seed=seed), pair, first, first + length - 1)
    (swap,) = label_swaps.detect_label_swaps(take)
    assert where([swap]) == [(pair, first, first + length - 1)]
    assert swap.confidence > 0.9


@pytest.mark.parametrize("cycle", [(0, 1, 2), (0, 2, 1), (1, 6, 3)])
def test_cycle_of_three_is_found_in_the_right_direction(cycle):
    sound = turning()
    (swap,) = label_swaps.detect_label_swaps(exchanged(sound, cycle, 100, 180))
    assert where([swap]) == [(cycle, 100, 180)]
    np.testing.assert_array_equal(undone(exchanged(sound, cycle, 100, 180), [swap]).markers, sound.markers)


@pytest.mark.parametrize(("first", "last"), [(0, 99), (360, 479)])
def test_distances_decide_which_part_is_swapped(first, last):
    (swap,) = label_swaps.detect_label_swaps(exchanged(turning(), (1, 3), first, last))
    assert where([swap]) == [((1, 3), first, last)]
    assert swap.confidence > 0.95


def test_swap_that_begins_and_ends_in_gaps():
    take = exchanged(turning(), (1, 3), 150, 250)
    for marker in (1, 3):
        take = hidden(hidden(take, marker, 120, 170), marker, 230, 290)
    (swap,) = label_swaps.detect_label_swaps(take)
    assert where([swap]) == [((1, 3), 171, 229)]


def test_swap_with_a_missing_marker():
    sound = turning()
    take = hidden(exchanged(sound, (1, 3), 150, 250), 1, 150, 250)  # marker 3 is missing, and marker 1 has its label
    (swap,) = label_swaps.detect_label_swaps(take)
    assert where([swap]) == [((1, 3), 150, 250)]
    np.testing.assert_array_equal(undone(take, [swap]).markers[:, 1], sound.markers[:, 1])


def test_without_distances_the_shorter_part_is_assumed_to_be_swapped():
    t = np.arange(480) / 120
    apart = np.stack([np.sin(3 * t), np.cos(2 * t), 0.5 * t, -np.sin(5 * t), np.sin(4 * t), 0.2 * t], 1).reshape(-1, 2, 3)
    take = Take(apart, ("A", "B"), 120.0)
    (short,) = label_swaps.detect_label_swaps(exchanged(take, (0, 1), 430, 479))
    (half,) = label_swaps.detect_label_swaps(exchanged(take, (0, 1), 240, 479))
    assert half.confidence < short.confidence < 0.65
    assert half.confidence < MIN_LABEL_CONFIDENCE
    uncertain = exchanged(take, (0, 1), 240, 479)
    np.testing.assert_array_equal(undone(uncertain, [half]).markers, uncertain.markers)


LEGS = [(f"L{name}", f"R{name}") for name in ("THI", "KNE", "SHN", "ANK", "HEE", "TOE", "MT5")]
ARMS = [(f"L{name}", f"R{name}") for name in ("SHO", "UPA", "ELB", "FRM", "WRA", "WRB", "FIN")]


@pytest.mark.parametrize("rate", [30.0, 120.0])
@pytest.mark.parametrize(
    ("exchanges", "gap"),
    [
        ([(LEGS, 0.25, 0.4)], None),  # the shorter part is wrong
        ([(LEGS, 0.7, 1.0)], None),
        ([(LEGS, 0.1, 0.9)], None),  # the longer part is wrong, which a body shows
        ([(ARMS, 0.3, 1.0), (LEGS, 0.25, 0.6)], None),
        ([(LEGS + ARMS, 0.0, 0.45)], None),
        ([(LEGS, 0.2, 0.7)], LEGS[3:]),  # feet that are hidden when the legs are exchanged
    ],
)
def test_limbs_that_are_exchanged_as_a_whole_are_exchanged_back(rate, exchanges, gap):
    truth = compose_take(5, 6.0, rate)
    sound = Take(truth.marker_positions, truth.labels, rate)
    if gap:
        frame = round(0.2 * sound.frame_count)
        for label in {label for pair in gap for label in pair}:
            sound = hidden(sound, sound.labels.index(label), frame - 3, frame - 1)
    assert label_swaps.detect_limb_exchanges(sound) == []
    take = sound
    for pairs, start, end in exchanges:
        for pair in pairs:
            markers = tuple(map(sound.labels.index, pair))
            take = exchanged(take, markers, round(start * take.frame_count), round(end * take.frame_count) - 1)
    detected = detect_on_trajectories(take, load_marker_set("cmu41"), None, FaultReview(), CleanOptions())
    np.testing.assert_array_equal(detected.take.markers, sound.markers)


def test_fewer_than_three_pairs_are_no_exchange_of_limbs():
    truth = compose_take(5, 2.0, 120.0)
    take = Take(truth.marker_positions, truth.labels, 120.0)
    for pair in LEGS[:2]:
        take = exchanged(take, tuple(map(take.labels.index, pair)), 100, 149)
    assert label_swaps.detect_limb_exchanges(take) == []
    (fault, *_) = label_swaps.detect_limb_exchanges(exchanged(take, tuple(map(take.labels.index, LEGS[2])), 100, 149))
    assert (fault.first, fault.last, fault.kind) == (100, 149, "swap")


@pytest.mark.parametrize("angle_deg", [150.0, 165.0, 180.0, 195.0])
def test_a_person_who_is_turned_round_where_takes_are_joined_has_not_exchanged_limbs(angle_deg):
    truth = compose_take(1, 6.0, 120.0)
    for frame in range(120, 600, 60):
        markers = truth.marker_positions.copy()
        centre = markers[frame].mean(0)
        turn = Rotation.from_euler("y", angle_deg, degrees=True)
        markers[frame:] = turn.apply((markers[frame:] - centre).reshape(-1, 3)).reshape(markers[frame:].shape) + centre
        assert label_swaps.detect_limb_exchanges(Take(markers, truth.labels, 120.0)) == []


def test_two_simultaneous_swaps_are_found():
    sound = turning()
    take = exchanged(exchanged(sound, (0, 2), 100, 200), (6, 8), 150, 260)
    found = label_swaps.detect_label_swaps(take)
    assert sorted(where(found)) == [((0, 2), 100, 200), ((6, 8), 150, 260)]
    np.testing.assert_array_equal(undone(take, found).markers, sound.markers)


def test_gaps_spikes_and_jitter_are_no_swaps():
    take, rng = turning(), np.random.default_rng(1)
    markers = take.markers.copy()
    for _ in range(30):
        m, f = rng.integers(10), rng.integers(450)
        markers[f : f + rng.integers(1, 25), m] = np.nan
        m, f = rng.integers(10), rng.integers(470)
        markers[f : f + rng.integers(1, 4), m] += rng.normal(0, 0.1, 3)
    markers[200:260, 4] += rng.normal(0, 0.012, (60, 3))
    assert label_swaps.detect_label_swaps(take) == label_swaps.detect_label_swaps(take.replace_markers(markers)) == []


def test_spikes_beside_a_missing_marker_are_no_exchange_with_it():
    take = compose_heavily_damaged_take(seed=13)  # in a gap of RMT1, the other markers of the foot have six spikes in 30 frames
    found = label_swaps.detect_label_swaps(Take(take.damaged_positions, take.labels, take.rate))
    assert [swap for swap in found if swap.last - swap.first > 2] == []


def test_reason_names_labels_duration_and_distance():
    (swap,) = label_swaps.detect_label_swaps(exchanged(turning(), (1, 3), 100, 159))
    apart = np.linalg.norm(turning().markers[100:160, 1] - turning().markers[100:160, 3], axis=-1)
    assert swap.severity == pytest.approx(np.median(apart))
    expected = f"M1 and M3 have exchanged their labels for 0.50 s (60 frames): their samples lie {swap.severity * 1e3:.0f} mm"
    assert swap.reason == f"{expected} from their markers."


def test_takes_without_frames_or_markers_have_no_swaps():
    for shape in [(0, 3, 3), (1, 3, 3), (10, 0, 3)]:
        assert label_swaps.detect_label_swaps(Take(np.zeros(shape), ("A", "B", "C")[: shape[1]], 100.0)) == []
    assert label_swaps.detect_label_swaps(Take(np.full((50, 3, 3), np.nan), ("A", "B", "C"), 100.0)) == []


@needs_captures
def test_single_frame_swap_of_a_capture():
    take = capture.read_take(CAPTURES / "c3d" / "walkingOptiTrack.c3d")
    (swap,) = label_swaps.detect_label_swaps(take)
    assert [take.labels[m] for m in swap.markers] == ["Foot_Marker3", "Foot_Marker5"]
    assert swap.first == swap.last == 1952


@needs_captures
@pytest.mark.parametrize("name", ["cmu/02_05", "cmu/85_02", "cmu/06_01", "c3d/tennis_serve_motive"])
def test_sound_captures_have_no_swaps(name):
    assert label_swaps.detect_label_swaps(capture.read_take(CAPTURES / f"{name}.c3d")) == []


def test_distance_matches_equal_a_full_comparison():
    """Every label against every marker, without the shortcuts of the kernel."""
    take = hidden(exchanged(exchanged(turning(), (0, 1), 40, 90), (2, 6), 200, 207), 5, 120, 140)
    distances, visible = estimate_distances(take.markers), take.visible
    own = label_evidence.compute_own_contradictions(take.markers, distances, 1.0)
    is_excluded, count = np.zeros(len(take.labels), bool), len(take.labels)
    expected = np.zeros((count, count), bool)
    for j in range(count):
        for first, last in find_runs(visible[:, j] & (own[:, j] > label_evidence.MIN_SWAP_CONTRADICTION)):
            if last - first + 1 < label_evidence.MIN_CONTRADICTION_DURATION_S * take.rate:
                continue
            frames = np.unique(np.linspace(first, last, label_evidence.MAX_COMPARED_FRAMES).astype(int))
            for i in set(range(count)) - {j}:
                costs = [
                    label_evidence.compute_contradiction(take.markers, distances, t, j, i, is_excluded, 1.0)
                    for t in frames.tolist()
                ]
                is_better = np.mean(costs) < label_evidence.MAX_RELATIVE_CONTRADICTION * own[frames, j].mean()
                expected[i, j] |= is_better and own[frames, i].mean() > label_evidence.MIN_SWAP_CONTRADICTION
    found = np.zeros((count, count), bool)
    label_evidence.mark_distance_matches(build_trajectories(take.markers, take.rate), distances, own, found)
    np.testing.assert_array_equal(found, expected)
    assert found.any()
