"""Label swaps: two labels, or three in a cycle, that follow one another's markers for a while, or over the whole take.

Where labels are exchanged, each trajectory leaps to where another one was going. In between, the distances to each marker's
segment are broken, and they hold again after the exchange ends. Often the exchange happens in a gap and no leap is visible, or
the take ends before the exchange does. Then the distances decide which part is wrong; without them the shorter part is assumed
to be wrong. A swap without such evidence has a low confidence, and its labels are left unchanged.

Swaps are searched among few candidates. Marker i may have label j's samples if j leaps or appears where i would have
continued while i leaps or disappears, or if i's own samples contradict i's distances for some time and those of j match
them.

In a small group of candidates, the markers that the labels follow are found frame by frame, as the cheapest sequence of
permutations. In each state, every marker of the group has the samples of one label of the group. A sequence of states pays for
each leap of its markers, for samples that contradict the distances of the markers that they are assigned to, and for each change
of state. The cheapest sequence is found exactly (Viterbi's algorithm). All costs are in leaps, where 1 is the largest leap that
counts, so neither a spike nor a momentary contradiction causes a change. Where labels change within a gap, without a visible
leap, the distances alone decide.

Mislabelled markers have their labels exchanged over the whole take. Their trajectories are smooth and keep their distances, so
they do not show the exchange. A body is therefore fitted to some frames, with the labels as they are and with an exchange undone.
The difference between the two fits is the evidence. A marker is attached once, so all frames of a take are one observation of its
position, and one typical frame is as informative as all of them. The body is a known subject's, or the average one. Of the
average body only the size is estimated from the take, so that a label that is wrong throughout cannot shift the expected position
of its marker.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import format_name_list, join_words
from mocapfix.kernels import label_evidence
from mocapfix.kernels.viterbi import find_cheapest_chain
from mocapfix.model.faults import LABEL_KINDS, MIN_LABEL_CONFIDENCE, Fault, overlap_in_time
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import is_below, load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve.terms import compute_robust_costs
from mocapfix.stats.marker_distances import MarkerDistances, MarkerTrajectories, build_trajectories, estimate_distances
from mocapfix.stats.sequences import find_cheapest_states, find_runs, sample_evenly
from mocapfix.subject import average_body
from mocapfix.subject.library import MIRROR_X

MIN_PARTIAL_SWAP_DURATION_S = 0.1  # shortest exchange with a label that is missing at that time: a shorter one may be a spike
MAX_SPIKE_DURATION_S = 0.05  # longest spike that may look like an exchange with a missing label
SWAPPED_COST_PER_S = 0.1  # cost, in leaps a second, of all exchanged states: without evidence, labels are assumed to be correct
MIN_SWAP_GAIN = 0.7  # smallest cost, in leaps, that an exchange saves
# Largest contradiction of exchanged samples, relative to that of the labels as they are, if no leap shows the exchange. In a rare
# pose of several seconds neither fits: 0.76 to 0.96 were measured there for the two markers of a wrist.
MAX_EXCHANGED_MISFIT = 0.6


class LabelExchange(NamedTuple):
    """An exchange of labels over the frames first..last."""

    cycle: tuple[int, ...]  # marker indices. The samples of each marker are under the next one's label.
    first: int  # index of the first frame
    last: int  # index of the last frame
    gain: float  # cost in leaps that undoing the exchange saves
    counter_evidence: float  # cost in leaps, by the distances, if these frames were correct and all others exchanged


def find_exchanges(group: tuple[int, ...], trajectories: MarkerTrajectories, distances: MarkerDistances) -> list[LabelExchange]:
    """Find the exchanges of labels in a group of two or three markers, ordered by first frame."""
    states = np.array(list(permutations(range(len(group)))))  # marker i has the samples of label states[s, i]
    step_cost, state_cost = label_evidence.compute_exchange_costs(states, np.array(group), trajectories, distances)
    swapped_cost = SWAPPED_COST_PER_S / trajectories.rate * (np.arange(len(states)) > 0)
    state = find_cheapest_states(step_cost[1:], state_cost + swapped_cost)
    visible = ~np.isnan(trajectories.markers[:, group, 0])
    exchanges: list[LabelExchange] = []
    for s in range(1, len(states)):
        extra_cost = state_cost[:, s] - state_cost[:, 0]
        for first, last in find_runs(state == s):
            inside = slice(first, last + 1)
            unchanged = np.where((np.arange(len(state)) >= first) & (np.arange(len(state)) <= last), 0, state)
            t = np.arange(max(first, 1), min(last + 2, len(state)))
            leap_gain = float((step_cost[t, unchanged[t - 1], unchanged[t]] - step_cost[t, state[t - 1], state[t]]).sum())
            misfit_share = float(state_cost[inside, s].sum()) / max(float(state_cost[inside, 0].sum()), 1e-9)
            if leap_gain < MIN_SWAP_GAIN and misfit_share > MAX_EXCHANGED_MISFIT:
                continue
            gain = leap_gain - float(extra_cost[inside].sum())
            counter_evidence = float(extra_cost[state == 0].sum() - extra_cost[inside].sum())
            for cycle in find_permutation_cycles(states[s]):
                exchanged = first + np.flatnonzero(visible[inside][:, cycle].any(1))
                is_complete = visible[inside][:, cycle].any(0).all()
                if len(exchanged) >= (1 if is_complete else MIN_PARTIAL_SWAP_DURATION_S * trajectories.rate):
                    markers = tuple(group[i] for i in cycle)
                    exchanges.append(LabelExchange(markers, int(exchanged[0]), int(exchanged[-1]), gain, counter_evidence))
    return sorted(exchanges, key=lambda exchange: exchange.first)


def find_permutation_cycles(permutation: np.ndarray) -> list[tuple[int, ...]]:
    """Find the cycles of at least two elements of a permutation; each element i is followed by permutation[i]."""
    cycles: list[tuple[int, ...]] = []
    remaining = set(range(len(permutation)))
    while remaining:
        cycle = [min(remaining)]
        while (following := int(permutation[cycle[-1]])) != cycle[0]:
            cycle.append(following)
        remaining -= set(cycle)
        if len(cycle) > 1:
            cycles.append(tuple(cycle))
    return cycles


MAX_SWAP_PASSES = 5
MIN_LABEL_VISIBLE_FRACTION = 0.5  # a label that is visible in a smaller fraction of the take is a fragment, not a marker
MAX_SWAP_TRIPLES = 1000  # above which only pairs are compared: labels are then arbitrary, not exchanged here and there


def detect_label_swaps(take: Take) -> list[Fault]:
    """Detect the swaps of a take.

    Returns:
        The faults, in the order in which they have to be undone. Their severity is the median distance in metres between the
        exchanged samples.
    """
    swaps: list[Fault] = []
    for _ in range(MAX_SWAP_PASSES):
        found = [_build_swap_fault(take, exchange) for exchange in _reject_spikes(take, _select_exchanges(take))]
        found = [swap for swap in found if not any(swap.overlaps(old) for old in swaps)]
        swaps += found
        for swap in found:
            if swap.confidence >= MIN_LABEL_CONFIDENCE:
                take = take.exchange_labels(swap.markers, swap.first, swap.last)
        if not any(swap.confidence >= MIN_LABEL_CONFIDENCE for swap in found):
            break
    return swaps


def _select_exchanges(take: Take) -> list[LabelExchange]:
    """Select the exchanges with the largest gain by first frame; one that overlaps a better one is for the next pass."""
    if take.frame_count < 2 or not len(take.labels):
        return []
    trajectories, distances = build_trajectories(take.markers, take.rate), estimate_distances(take.markers)
    candidates = [
        exchange
        for group in find_swap_candidates(trajectories, distances)
        for exchange in find_exchanges(group, trajectories, distances)
    ]
    selected: list[LabelExchange] = []
    for exchange in sorted(candidates, key=lambda exchange: -exchange.gain):
        if exchange.gain > MIN_SWAP_GAIN and not any(overlap_in_time(exchange, other) for other in selected):
            selected.append(exchange)
    return sorted(selected, key=lambda exchange: exchange.first)


def _reject_spikes(take: Take, exchanges: list[LabelExchange]) -> list[LabelExchange]:
    """Return the exchanges without those with a missing label that are not found if the spikes of their labels are removed."""
    partial = {each for each in exchanges if not take.visible[each.first : each.last + 1, each.cycle].any(0).all()}
    markers, spike_frames = take.markers.copy(), max(1, round(MAX_SPIKE_DURATION_S * take.rate))
    for m in {m for each in partial for m in each.cycle}:
        frames = np.flatnonzero(take.visible[:, m])
        is_kept = find_cheapest_chain(frames, np.ascontiguousarray(markers[frames, m]), take.rate, spike_frames)
        markers[frames[~is_kept], m] = np.nan
    sound = [(set(each.cycle), each) for each in _select_exchanges(take.replace_markers(markers))] if partial else []
    confirmed = {each for each in partial if any(set(each.cycle) == of and overlap_in_time(each, other) for of, other in sound)}
    return [each for each in exchanges if each in confirmed or each not in partial]


def _build_swap_fault(take: Take, exchange: LabelExchange) -> Fault:
    share = (exchange.last - exchange.first + 1) / (take.frame_count + 1)
    wrong_part_odds = share / (1 - share) * np.exp(-np.clip(exchange.counter_evidence, -50, 50))
    confidence = float((1 - np.exp(-exchange.gain)) / (1 + wrong_part_odds))
    return build_exchange_fault(take, exchange.cycle, (exchange.first, exchange.last), confidence, take.bare_labels)


def build_exchange_fault(
    take: Take, cycle: tuple[int, ...], interval: tuple[int, int], confidence: float, labels: Sequence[str]
) -> Fault:
    """Build the fault of labels that are exchanged in a cycle of markers; `labels` are those of all markers in its reason."""
    first, last = interval
    points = take.markers[first : last + 1]
    distance_m = np.linalg.norm(points[:, cycle] - points[:, np.roll(cycle, -1)], axis=-1)
    separation_m = float(np.nanmedian(distance_m)) if np.isfinite(distance_m).any() else float("nan")
    duration = f"{(last - first + 1) / take.rate:.2f} s ({last - first + 1} frames)"
    distance = f"{separation_m * 1e3:.0f} mm" if np.isfinite(separation_m) else "away"
    exchange_text = "exchanged their labels" if len(cycle) == 2 else "exchanged their labels in a cycle"
    names = join_words([labels[m] for m in cycle])
    reason = f"{names} have {exchange_text} for {duration}: their samples lie {distance} from their markers."
    return Fault("swap", cycle[0], first, last, separation_m, reason, confidence, cycle[1:])


def find_swap_candidates(trajectories: MarkerTrajectories, distances: MarkerDistances) -> list[tuple[int, ...]]:
    """Find the pairs and triples of markers whose labels may have been exchanged; no triples if there are too many."""
    count = trajectories.previous_frame.shape[1]
    is_candidate = np.zeros((count, count), bool)
    own = label_evidence.compute_own_contradictions(trajectories.markers, distances, 1.0)
    label_evidence.mark_continuations(trajectories, distances, label_evidence.compute_own_leaps(trajectories), own, is_candidate)
    label_evidence.mark_distance_matches(trajectories, distances, own, is_candidate)
    is_rare = np.isnan(trajectories.markers[..., 0]).mean(0) > 1 - MIN_LABEL_VISIBLE_FRACTION
    is_candidate[is_rare] = is_candidate[:, is_rare] = False
    pairs: set[tuple[int, ...]] = {tuple(sorted(map(int, pair))) for pair in np.argwhere(is_candidate)}
    triples: set[tuple[int, ...]] = set()
    for i, j in np.argwhere(is_candidate):
        for k in np.flatnonzero(is_candidate[j]):
            if len({i, j, k}) == 3:
                triples.add(tuple(sorted((int(i), int(j), int(k)))))
    return sorted(pairs) + (sorted(triples) if len(triples) <= MAX_SWAP_TRIPLES else [])


MIN_CROSSING_PAIRS = 3  # of labels that exchange their paths in one frame, which markers cannot
MIN_CROSSING_M, MAX_CROSSING_RATIO = 0.05, 0.25  # least leap of each label, and its distance from the other's path relative to it
# Least share of the leaping labels that exchange their paths: 0.92 and more where legs or all labels of composed people are
# exchanged, at 30 to 120 Hz; 0.73 and less where takes are joined in which the person is turned by 150 to 200 degrees.
MIN_CROSSING_SHARE = 0.8
MAX_CROSSING_GAP_S, CROSSING_CONFIDENCE = 0.1, 0.9


def detect_limb_exchanges(take: Take) -> list[Fault]:
    """Detect exchanges of many pairs of labels at once, as of a left and a right leg, which keep the distances within the limb.

    The shorter part of the take is assumed to be exchanged. `detect_mislabelled` then judges the labels of the whole take.
    """
    markers, frames = take.markers, np.arange(take.frame_count)[:, None, None]
    known = np.maximum.accumulate(np.where(take.visible[..., None], frames, 0), axis=0)[:-1]  # the last visible sample before
    age, step = frames[1:] - known, np.nan_to_num(np.diff(markers, axis=0, prepend=np.nan))
    expected = np.take_along_axis(markers, known, axis=0) + age * np.take_along_axis(step, known, axis=0)
    expected = np.where(age <= MAX_CROSSING_GAP_S * take.rate, expected, np.nan)
    expected = np.concatenate([np.full_like(markers[:1], np.nan), expected])
    leap_m = np.nan_to_num(np.linalg.norm(markers - expected, axis=-1))
    crossings: dict[tuple[int, int], tuple[int, ...]] = {}
    for frame in np.flatnonzero((leap_m > MIN_CROSSING_M).sum(1) >= 2 * MIN_CROSSING_PAIRS).tolist():
        seen = np.flatnonzero(leap_m[frame] > MIN_CROSSING_M)
        away_m = np.linalg.norm(markers[frame, seen, None] - expected[frame, seen], axis=-1)
        other = away_m.argmin(1)
        is_crossed = (away_m.min(1) < MAX_CROSSING_RATIO * leap_m[frame, seen]) & (other[other] == np.arange(len(seen)))
        pairs = [(int(seen[n]), int(seen[other[n]])) for n in np.flatnonzero(is_crossed & is_crossed[other]) if n < other[n]]
        if len(pairs) >= max(MIN_CROSSING_PAIRS, MIN_CROSSING_SHARE * len(seen) / 2):
            crossings |= {pair: (*crossings.get(pair, ()), frame) for pair in pairs}
    counts = Counter(crossings.values())
    common = [each for each in sorted(counts, key=len) if counts[each] >= MIN_CROSSING_PAIRS]
    faults: list[Fault] = []
    for pair, own in crossings.items():
        # a pair that is hidden while others of its limb cross crosses with them
        hidden = {frame for each in common for frame in each if not take.visible[frame - 1, pair].all()}
        starts = next((each for each in common[::-1] if set(own) <= set(each) <= {*own, *hidden}), ())
        parts = list(zip((0, *starts), (*starts, take.frame_count), strict=True))
        wrong = min(parts[::2], parts[1::2], key=lambda part: sum(end - first for first, end in part))
        faults += [build_exchange_fault(take, pair, (a, end - 1), CROSSING_CONFIDENCE, take.bare_labels) for a, end in wrong]
    return faults


def undo_label_exchanges(take: Take, faults: Iterable[Fault]) -> Take:
    """Undo the exchanges of labels with a sufficient confidence, in the given order. Other faults are ignored."""
    exchanges = [
        (fault.markers, fault.first, fault.last)
        for fault in faults
        if fault.kind in LABEL_KINDS and fault.confidence >= MIN_LABEL_CONFIDENCE
    ]
    return take.exchange_labels_in_turn(exchanges) if exchanges else take


BODY_MARKER_SD_M = 0.030  # per axis: placement, the subject's proportions and skin motion together
ROBUST_SCALES_M = (0.4, 0.2, 0.1)  # scales of the robust loss (Geman & McClure 1987), from coarse to fine
MAX_BODY_FIT_ITERATIONS = 8  # number of iterations at each scale


def fit_markers(body: average_body.PosedBody, markers: Float[np.ndarray, "N K 3"]) -> Float[np.ndarray, "N K 3"]:
    """Return where the body, fitted to each frame by itself, has all its markers, in metres; `markers` are NaN where missing."""
    return body.predict(body.fit(markers, BODY_MARKER_SD_M, ROBUST_SCALES_M, MAX_BODY_FIT_ITERATIONS))


def compute_marker_misfit(markers: Float[np.ndarray, "... 3"], predicted: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
    """Compute half the robust squared distance in standard deviations (Geman & McClure 1987), 0 where missing."""
    square = ((markers - predicted) ** 2).sum(-1)
    return np.nan_to_num(compute_robust_costs(square, ROBUST_SCALES_M[-1] ** 2)) / BODY_MARKER_SD_M**2


# Distance of a marker from the mirrored place of another within which the two mirror each other.
MAX_TWIN_DISTANCE_M = 0.15
MAX_BODY_FIT_FRAMES = 16  # number of frames to which the body is fitted, evenly spread over the fullest ones
MIN_RELATIVE_MARKER_COUNT = 0.9  # number of visible markers in these frames, relative to the fullest frame
MIN_FITTED_MARKERS = 12  # no body is fitted to frames with fewer markers
MIN_MARKER_FRAMES = 5  # number of the frames in which a marker must be visible
MAX_TESTED_PAIRS = 16  # number of pairs of markers for whose exchange the body is fitted again
MIN_PRELIMINARY_GAIN = -2.0  # in log likelihood, with the body unchanged; a true exchange loses nothing
MIN_EXCHANGE_GAIN = 0.5  # smallest gain in log likelihood of an exchange
CORRECT_LABEL_LOG_ODDS = 1.6  # of the prior that the labels are correct; a gain of 2 is just sufficient to change them
MAX_EXCHANGE_COUNT = 12  # number of exchanges in a take
MAX_MEAN_MISFIT = 2.0  # in log likelihood; with more these are not the set's markers, whatever their labels
MAX_REMAINING_MISPLACEMENT = 0.7  # from the body after an exchange is undone, relative to that before


@dataclass(frozen=True)
class RelabelStep:
    """One exchange that was undone."""

    permutation: np.ndarray  # for each of K markers (K,), the index of the marker whose label it has
    gain: float  # gain in log likelihood

    @property
    def is_exchanged(self) -> Bool[np.ndarray, " K"]:
        """Whether each marker has another one's label."""
        return self.permutation != np.arange(len(self.permutation))


def detect_mislabelled(take: Take, marker_set: MarkerSet, subject: Subject | None = None) -> list[Fault]:
    """Detect the cycles of labels that are exchanged over the whole take.

    If a limb or the whole body is mirrored, each pair of mirrored markers is a fault; all of them have the same reason. An
    exchange that occurs equally on both sides is not a fault but a naming convention of the studio.

    Args:
        subject: The subject, if known; otherwise the average body is used.

    Returns:
        The faults. Undone together, they leave every marker with its own label. Their severity is the median distance in
        metres of the exchanged markers from the body.
    """
    columns = marker_set.find_columns(take.labels)
    markers = select_fullest_frames(take.select(columns, take.visible).markers)
    if len(markers) == 0:
        return []
    if subject is None:
        size = average_body.estimate_body_size_ratio(marker_set, markers, min_frames=1)
        subject = average_body.build_average_subject(marker_set, size)
    body = average_body.build_posed_body(subject)
    own, is_in_take = np.arange(len(columns)), columns >= 0  # a marker that is not in the take has no label to exchange
    permutations = [np.where(is_in_take & is_in_take[each], each, own) for each in list_mirror_exchanges(marker_set)]
    order, steps = find_correct_labels(markers, body, permutations)
    if not steps:
        return []
    relabelled = np.ascontiguousarray(markers[:, order])
    predicted_before, predicted_after = fit_markers(body, markers), fit_markers(body, relabelled)
    misfit = compute_marker_misfit(relabelled, predicted_after)
    if misfit.sum() > MAX_MEAN_MISFIT * (~np.isnan(relabelled[..., 0])).sum():
        return []
    before_m, after_m = (np.linalg.norm(a - b, axis=-1) for a, b in ((markers, predicted_before), (relabelled, predicted_after)))
    cycles = select_one_sided_cycles(find_permutation_cycles(order), find_twins(marker_set))
    faults = [_build_mislabelled_fault(take, columns, order, cycle, steps, (before_m, after_m)) for cycle in cycles]
    return [fault for fault in faults if fault is not None]


def select_fullest_frames(markers: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "N K 3"]:
    """Select up to MAX_BODY_FIT_FRAMES of the frames with the most visible markers, evenly over the take."""
    count = (~np.isnan(markers[..., 0])).sum(1)
    full = np.flatnonzero(count >= max(MIN_FITTED_MARKERS, MIN_RELATIVE_MARKER_COUNT * count.max(initial=0)))
    return np.ascontiguousarray(markers[full[sample_evenly(len(full), MAX_BODY_FIT_FRAMES)]])


def find_correct_labels(
    markers: Float[np.ndarray, "N K 3"], body: average_body.PosedBody, permutations: list[Int[np.ndarray, " K"]]
) -> tuple[Int[np.ndarray, " K"], list[RelabelStep]]:
    """Search the correct labels by undoing one exchange after the other, each time the one with the largest gain.

    Args:
        permutations: Exchanges that are tried in addition to those of two markers.

    Returns:
        The index of the label that each marker has, and the steps.
    """
    order, steps = np.arange(markers.shape[1]), list[RelabelStep]()
    is_testable = (~np.isnan(markers[..., 0])).sum(0) >= MIN_MARKER_FRAMES
    while len(steps) < MAX_EXCHANGE_COUNT:
        current = np.ascontiguousarray(markers[:, order])
        predicted = fit_markers(body, current)
        misfit = compute_marker_misfit(current, predicted).sum(1)
        candidates = [*permutations, *find_pair_exchanges(current, predicted, is_testable[order])]
        if not candidates:
            break
        permuted = np.ascontiguousarray(current[:, candidates].swapaxes(0, 1))
        predicted = fit_markers(body, permuted.reshape(-1, *current.shape[1:])).reshape(permuted.shape)
        tried: list[RelabelStep] = []
        for permutation, gain in zip(candidates, misfit - compute_marker_misfit(permuted, predicted).sum(-1), strict=True):
            is_visible = ~np.isnan(current[:, permutation != np.arange(len(permutation)), 0]).all(1)
            is_known = is_visible.sum() >= MIN_MARKER_FRAMES
            tried.append(RelabelStep(permutation, float(np.median(gain[is_visible])) if is_known else 0.0))
        best = max(tried, key=lambda step: step.gain)
        if best.gain < MIN_EXCHANGE_GAIN:
            break
        order = order[best.permutation]
        steps.append(best)
    return order, steps


def find_pair_exchanges(
    markers: Float[np.ndarray, "N K 3"], predicted: Float[np.ndarray, "N K 3"], is_testable: Bool[np.ndarray, " K"]
) -> list[Int[np.ndarray, " K"]]:
    """Find the exchanges of two markers that may fit better, judged with the body unchanged, the most promising first."""
    visible_count = np.maximum((~np.isnan(markers[..., 0])).sum(0), 1)
    # mean misfit of the samples (columns) as the markers (rows)
    misfit = compute_marker_misfit(markers[:, None], predicted[:, :, None]).sum(0) / visible_count
    gain = np.diag(misfit)[:, None] + np.diag(misfit) - misfit - misfit.T
    first, second = np.triu_indices(len(is_testable), 1)
    gain = np.where(is_testable[first] & is_testable[second], gain[first, second], -np.inf)
    promising = np.argsort(-gain, kind="stable")[:MAX_TESTED_PAIRS]
    exchanges = np.tile(np.arange(len(is_testable)), ((gain[promising] > MIN_PRELIMINARY_GAIN).sum(), 1))
    for exchange, pair in zip(exchanges, promising, strict=False):
        exchange[[first[pair], second[pair]]] = second[pair], first[pair]
    return list(exchanges)


def find_twins(marker_set: MarkerSet) -> Int[np.ndarray, " K"]:
    """Find the index of the marker that mirrors each one; its own index if there is none or it lies in the middle."""
    rest = average_body.compute_rest_marker_positions(marker_set)
    distance_m = np.linalg.norm(rest[:, None] * MIRROR_X - rest[None], axis=-1)
    nearest, own = distance_m.argmin(1), np.arange(len(rest))
    return np.where((nearest[nearest] == own) & (distance_m.min(1) <= MAX_TWIN_DISTANCE_M), nearest, own)


def list_mirror_exchanges(marker_set: MarkerSet) -> list[Int[np.ndarray, " K"]]:
    """List the exchanges of left and right of each segment, and of each segment with its descendants (limb, whole body)."""
    parents, own, twin = load_cmu31_body().skeleton.parents, np.arange(len(marker_set.joints)), find_twins(marker_set)
    exchanges: dict[tuple[int, ...], np.ndarray] = {}
    for joint in range(len(parents)):
        is_own = marker_set.joints == joint
        for is_on_part in (is_own, is_own | [is_below(each, joint, parents) for each in marker_set.joints.tolist()]):
            exchange = np.where(is_on_part | is_on_part[twin], twin, own)
            if (exchange != own).sum() > 2:  # a single pair is among the exchanges of two markers
                exchanges[tuple(exchange.tolist())] = exchange
    return list(exchanges.values())


def select_one_sided_cycles(cycles: list[tuple[int, ...]], twin: Int[np.ndarray, " K"]) -> list[tuple[int, ...]]:
    """Remove the cycles that the mirrored markers form as well: those are a naming convention, not a mistake."""
    members = [set(cycle) for cycle in cycles]
    return [cycle for cycle in cycles if (mirrored := set(twin[list(cycle)].tolist())) == set(cycle) or mirrored not in members]


def _build_mislabelled_fault(
    take: Take,
    columns: np.ndarray,
    order: np.ndarray,
    cycle: tuple[int, ...],
    steps: list[RelabelStep],
    misplacement: tuple[np.ndarray, np.ndarray],
) -> Fault | None:
    """Build the fault of a cycle; None if undoing it brings the markers no nearer to the body.

    Args:
        misplacement: Distances (N, K) in metres of the markers from the body, before and after the exchanges are undone.
    """
    own_steps = [step for step in steps if step.is_exchanged[list(cycle)].any()]
    gain = sum(step.gain for step in own_steps)
    exchanged = np.flatnonzero(np.any([step.is_exchanged for step in own_steps], axis=0))
    before_m, after_m = (float(np.nanmedian(each[:, exchanged])) for each in misplacement)
    if after_m > MAX_REMAINING_MISPLACEMENT * before_m:
        return None
    where = f"their samples lie {before_m * 1e3:.0f} mm from the marker set's positions on the body"
    where += f", and {after_m * 1e3:.0f} mm after the exchange is undone."
    labels = [take.bare_labels[columns[k]] for k in cycle]
    if len(cycle) == 2 < len(exchanged):
        names = format_name_list([take.bare_labels[columns[k]] for k in exchanged if k < order[k]])
        reason = f"Left and right are exchanged over the whole take ({names}): {where}"
    elif len(cycle) == 2:
        reason = f"{labels[0]} and {labels[1]} have exchanged their labels over the whole take: {where}"
    else:
        reason = f"{join_words(labels)} have exchanged their labels in a cycle over the whole take: {where}"
    marker, *others = (int(columns[k]) for k in cycle)
    confidence = float(1 / (1 + np.exp(CORRECT_LABEL_LOG_ODDS - gain)))
    return Fault("mislabelled", marker, 0, take.frame_count - 1, before_m, reason, confidence, tuple(others))
