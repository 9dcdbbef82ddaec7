"""BVH of the 31-joint CMU skeleton, as in Hahne's release of the CMU database and as mocapfix writes it.

The joints' axes must lie along the world's in the rest pose, which is so in both. Channels may come in any order.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.skeleton import cmu31
from mocapfix.train.recordings.recording import Recording, lines, step, subject


def read(path: Path) -> Iterator[Recording]:
    """Yield the motion of a BVH. Raises ReadError where a joint lacks or the frames are not as the header says."""
    text = lines(path)
    try:
        start = next(i for i, line in enumerate(text) if line.strip() == "MOTION")
        channels, rate = header(text[:start]), 1 / float(text[start + 2].split(":")[1])
        every = [np.array(line.split(), float) for line in text[start + 3 :] if line.strip()]
        values = np.stack(every)
        rotations = np.stack([joint(channels[name], values) for name in cmu31().skeleton.names], axis=1)
    except (StopIteration, IndexError, KeyError, ValueError, ZeroDivisionError) as error:
        raise ReadError(f"{path}: is no BVH of the 31 joints of the CMU skeleton ({error or 'it has no MOTION'}).") from error
    first = int(np.allclose(rotations[0], np.eye(3)))  # Hahne's begin with the T-pose
    yield Recording(path.stem, subject(path), rotations[first :: step(rate)], rate / step(rate))


def header(text: list[str]) -> dict[str, list[tuple[int, str]]]:
    """-> joint: column and axis of each of its rotations, in the order in which they are applied, outermost first."""
    channels: dict[str, list[tuple[int, str]]] = {}
    name, column = "", 0
    for words in (line.split() for line in text):
        if words and words[0] in ("ROOT", "JOINT"):
            name = words[1]
        elif words and words[0] == "CHANNELS":
            own = enumerate(words[2:], start=column)
            channels[name] = [(at, word[0].upper()) for at, word in own if word.lower().endswith("rotation")]
            column += int(words[1])
    return channels


def joint(channels: list[tuple[int, str]], values: np.ndarray) -> np.ndarray:
    """-> (T, 3, 3) of a joint's columns of values (T, C) in degrees."""
    columns, order = [at for at, _ in channels], "".join(axis for _, axis in channels)
    return Rotation.from_euler(order, values[:, columns], degrees=True).as_matrix()
