"""What is wrong with a take, told from its trajectories alone: first whose they are, then what is wrong with each."""

from dataclasses import dataclass

from mocapfix.detect import external_fills, frozen, gaps, ghosts, jitter, spikes
from mocapfix.faults import Faults, build_fault_mask
from mocapfix.marker_sets import MarkerSet
from mocapfix.take import Take


@dataclass(frozen=True)
class DetectOptions:
    """From where on a sample is judged faulty. What is judged faulty is replaced, so these favour the measurement."""

    min_spike_m: float = 0.02
    """How far a spike lies off the marker's own path at least, metres."""
    max_spike_duration_s: float = 0.05
    """How long a spike lasts at most, seconds."""
    min_jitter_m: float = 0.005
    """By how much a marker trembles in a burst of jitter at least, metres."""
    min_jitter_ratio: float = 6.0
    """How many times more than in the rest of the take it trembles there at least."""
    min_jitter_duration_s: float = 0.1
    """How long a burst of jitter lasts at least, seconds."""


def detect_sample_faults(take: Take, marker_set: MarkerSet | None = None, options: DetectOptions = DetectOptions()) -> Faults:
    """-> what is wrong with the samples under each label, ordered by marker and first frame; labels must be right by then.

    What a program put there was not measured and is not judged; a spike within a burst of jitter is part of the burst.
    """
    blind = external_fills.detect_virtual_samples(take)
    measured = take.masked(take.measured & ~build_fault_mask(blind, take.visible.shape))
    off = spikes.detect_spikes(measured, options.min_spike_m, options.max_spike_duration_s)
    held = frozen.detect_frozen(measured) + external_fills.detect_polynomial_fills(measured)
    smooth = measured.visible & ~build_fault_mask([*off, *held], take.visible.shape)
    bursts = jitter.detect_jitter(measured, smooth, options.min_jitter_m, options.min_jitter_ratio, options.min_jitter_duration_s)
    trembling = build_fault_mask(bursts, take.visible.shape)
    loud = [
        fault for fault in jitter.detect_noise(measured) if not trembling[:, fault.marker].any()
    ]  # what trembles is told as that
    lone = [spike for spike in off if not trembling[spike.frame_slice, spike.marker].all()]
    lost = gaps.detect_lost_segments(take, marker_set) if marker_set else []
    found = Faults((*gaps.detect_gaps(take), *blind, *lost, *loud, *lone, *held, *bursts))
    return found.add_faults(
        ghosts.detect_ghosts(measured.masked(found.compute_inlier_mask(measured) & ~build_fault_mask(held, take.visible.shape)))
    )
