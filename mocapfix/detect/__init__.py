"""What is wrong with a take, told from its trajectories alone: first whose they are, then what is wrong with each."""

from dataclasses import dataclass

from mocapfix.detect import (
    computed,
    fragments,
    gaps,
    ghosts,
    jitter,
    mislabelled,
    noise,
    second_look,
    segments,
    spikes,
    straight,
    stuck,
    swaps,
)
from mocapfix.detect.pieces import namesakes
from mocapfix.faults import Faults, over
from mocapfix.marker_set import MarkerSet
from mocapfix.take import Take

__all__ = ["DetectOptions", "faults", "fragments", "mislabelled", "namesakes", "second_look", "swaps"]


@dataclass(frozen=True)
class DetectOptions:
    """From where on a sample is judged faulty. What is judged faulty is replaced, so these favour the measurement."""

    smallest_spike: float = 0.02
    """How far a spike lies off the marker's own path at least, metres."""
    longest_spike: float = 0.05
    """How long a spike lasts at most, seconds."""
    smallest_jitter: float = 0.005
    """By how much a marker trembles in a burst of jitter at least, metres."""
    jitter_ratio: float = 6.0
    """How many times more than in the rest of the take it trembles there at least."""
    shortest_jitter: float = 0.1
    """How long a burst of jitter lasts at least, seconds."""


def faults(take: Take, worn_set: MarkerSet | None = None, options: DetectOptions = DetectOptions()) -> Faults:
    """-> what is wrong with the samples under each label, ordered by marker and first frame; labels must be right by then.

    What a program put there was not measured and is not judged; a spike within a burst of jitter is part of the burst.
    """
    blind = computed.found(take)
    measured = take.only(take.measured & ~over(blind, take.seen.shape))
    off = spikes.found(measured, options.smallest_spike, options.longest_spike)
    held = stuck.found(measured) + straight.found(measured)
    smooth = measured.seen & ~over([*off, *held], take.seen.shape)
    bursts = jitter.found(measured, smooth, options.smallest_jitter, options.jitter_ratio, options.shortest_jitter)
    trembling = over(bursts, take.seen.shape)
    loud = [fault for fault in noise.found(measured) if not trembling[:, fault.marker].any()]  # what trembles is told as that
    lone = [spike for spike in off if not trembling[spike.frames, spike.marker].all()]
    lost = segments.found(take, worn_set) if worn_set else []
    found = Faults((*gaps.found(take), *blind, *lost, *loud, *lone, *held, *bursts))
    return found.with_more(ghosts.found(measured.only(found.believed(measured) & ~over(held, take.seen.shape))))
