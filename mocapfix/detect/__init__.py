"""What is wrong with a take, told from each marker's trajectory alone."""

from dataclasses import dataclass

from mocapfix.detect import gaps, jitter, spikes
from mocapfix.faults import Faults
from mocapfix.take import Take


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


def faults(take: Take, options: DetectOptions = DetectOptions()) -> Faults:
    """-> gaps, spikes and bursts of jitter, ordered by marker and first frame; a spike within a burst is part of the burst."""
    off = spikes.found(take, options.smallest_spike, options.longest_spike)
    smooth = Faults(tuple(off)).believed(take)
    bursts = jitter.found(take, smooth, options.smallest_jitter, options.jitter_ratio, options.shortest_jitter)
    trembling = Faults(tuple(bursts)).doubted(take)
    lone = [spike for spike in off if not trembling[spike.first : spike.last + 1, spike.marker].all()]
    return Faults(tuple(sorted(gaps.found(take) + lone + bursts, key=lambda fault: (fault.marker, fault.first))))
