"""Takes of rigid segments that turn and travel: enough for distances to be kept and trajectories to go on."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.model.take import Take


def turning(seconds=4.0, rate=120.0, segments=2, each=5, noise=0.0005, seed=0) -> Take:
    """Build `segments` rigid segments of `each` markers, 10 to 25 cm apart, that rotate and move next to one another."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate)) / rate
    places = []
    for s in range(segments):
        angles = rng.uniform(0.5, 1.0, 3) * np.sin(np.outer(t, rng.uniform(2, 5, 3)) + rng.uniform(0, 6, 3))
        turn = Rotation.from_euler("xyz", angles).as_matrix()
        shape = rng.uniform(-0.12, 0.12, (each, 3))
        centre = np.stack([0.3 * s + 0.1 * np.sin(3 * t + s), 1 + 0.05 * np.cos(5 * t), 0.8 * t], 1)
        places.append(np.einsum("tab,mb->tma", turn, shape) + centre[:, None])
    markers = np.concatenate(places, axis=1)
    markers += rng.normal(0, noise, markers.shape)
    return Take(markers, tuple(f"M{m}" for m in range(markers.shape[1])), rate)


def exchanged(take: Take, cycle: tuple[int, ...], first: int, last: int) -> Take:
    """Move the samples of each marker in the cycle over first..last to the next one's label."""
    markers, frames = take.markers.copy(), slice(first, last + 1)
    markers[frames, list(cycle[1:] + cycle[:1])] = markers[frames, list(cycle)]
    return take.replace_markers(markers)


def hidden(take: Take, marker: int, first: int, last: int) -> Take:
    markers = take.markers.copy()
    markers[first : last + 1, marker] = np.nan
    return take.replace_markers(markers)
