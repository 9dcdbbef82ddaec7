"""Faults of the samples under correct labels, detected from the trajectories alone."""

from mocapfix.detect import external_fills, gaps, ghosts, jitter, spikes
from mocapfix.detect.round_memory import RoundMemory
from mocapfix.faults import Faults, build_fault_mask
from mocapfix.marker_set import MarkerSet
from mocapfix.options import DetectOptions
from mocapfix.take import Take

DEFAULT_DETECT_OPTIONS = DetectOptions()


def detect_sample_faults(
    take: Take,
    marker_set: MarkerSet | None = None,
    options: DetectOptions = DEFAULT_DETECT_OPTIONS,
    memory: RoundMemory | None = None,
) -> Faults:
    """Detect the faults of the samples under each label. The labels have to be correct.

    Samples that a program filled are not judged. A spike within a burst of jitter is part of the burst.

    Args:
        take: The take.
        marker_set: Its marker set.
        options: The limits of the detectors.
        memory: What earlier rounds on the same positions found. Only the samples that are set aside may differ.
    """
    memory, shape = memory or RoundMemory(), take.visible.shape
    virtual = external_fills.detect_virtual_samples(take)
    measured = take.masked(take.measured & ~build_fault_mask(virtual, shape))
    all_spikes = spikes.detect_spikes(measured, options.min_spike_m, options.max_spike_duration_s, memory)
    exact = external_fills.detect_frozen(measured, memory=memory) + external_fills.detect_polynomial_fills(
        measured, memory=memory
    )
    is_usable = measured.visible & ~build_fault_mask([*all_spikes, *exact], shape)
    bursts = jitter.detect_jitter(
        measured, is_usable, options.min_jitter_m, options.min_jitter_ratio, options.min_jitter_duration_s, memory
    )
    has_jitter = build_fault_mask(bursts, shape)
    # a marker with bursts of jitter is not reported as noisy as well
    noisy = [fault for fault in jitter.detect_noise(measured, memory) if not has_jitter[:, fault.marker].any()]
    isolated_spikes = [spike for spike in all_spikes if not has_jitter[spike.frame_slice, spike.marker].all()]
    lost = gaps.detect_lost_segments(take, marker_set) if marker_set else []
    faults = Faults((*gaps.detect_gaps(take), *virtual, *lost, *noisy, *isolated_spikes, *exact, *bursts))
    is_sound = faults.compute_inlier_mask(measured) & ~build_fault_mask(exact, shape)
    return faults.add_faults(ghosts.detect_ghosts(measured.masked(is_sound)))
