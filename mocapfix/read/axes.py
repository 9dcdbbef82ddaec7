"""Which way is up in a capture: laboratories write Z up, animation tools Y up, a few X up."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mocapfix.take import Take

# Rotations of file axes to Y up; all are proper, so left stays left. Z up: (x, y, z) -> (y, z, x), as CMU's releases.
TO_Y_UP = {"X": np.eye(3)[[2, 0, 1]], "Y": np.eye(3), "Z": np.eye(3)[[1, 2, 0]]}
HIGH = re.compile(r"head|[fb]hd$|hd[fb]$|ariel|c7$|cv7$|clav|sho$|shoulder", re.IGNORECASE)
LOW = re.compile(r"toe|hee$|hel$|heel|ank|mt[125]$|foot|fcc$|fm[125]$|cal$", re.IGNORECASE)
RISE = 0.3  # metres: heads above feet by less than this say nothing
CLEARLY_TALLER = 1.5  # arms held sideways make a person nearly as wide as tall; the usual axis has the doubt
ENOUGH_FRAMES = 200


def to_y_up(vertical: str, labels: Sequence[str], positions: np.ndarray, usual: str = "Z") -> np.ndarray:
    """-> (3, 3) rotation, file axes -> Y up.

    vertical   the file's POINT:Y_SCREEN ("+Z"); its sign tells the viewer's side, not where the sky is (Qualisys
               writes -Z on Z-up data), so only the letter counts
    labels     M marker labels
    positions  (T, M, 3) metres in the file's axes, NaN where not seen; asked where `vertical` says nothing
    usual      "Y" or "Z": the axis that is up in most files of the kind
    """
    letter = vertical[-1:]
    return TO_Y_UP[letter if letter in TO_Y_UP else _upward(labels, positions[:: max(1, len(positions) // ENOUGH_FRAMES)], usual)]


def turned(take: Take, up: str) -> Take:
    """-> the take as if its file's axis `up` ("X", "Y" or "Z") pointed to the sky, whatever was told from the file."""
    axes = TO_Y_UP[up]
    turn = axes if take.layout is None else axes @ take.layout.axes.T  # without a layout the file's axes are Y up
    loose = take.unlabelled
    return replace(
        take,
        markers=take.markers @ turn.T,
        layout=take.layout and replace(take.layout, axes=axes),
        unlabelled=loose and replace(loose, markers=loose.markers @ turn.T),
    )


def _upward(labels: Sequence[str], positions: np.ndarray, usual: str) -> str:
    """The axis along which heads lie above feet; where the labels do not say, the one along which the body is tallest."""
    rise = np.abs(_rise(labels, positions))
    if rise.max() > RISE:
        return "XYZ"[rise.argmax()]
    some = positions[np.isfinite(positions[..., 0]).any(1)]
    if not len(some):
        return usual
    tall = dict(zip("XYZ", np.median(np.nanmax(some, axis=1) - np.nanmin(some, axis=1), axis=0), strict=True))
    other = "Y" if usual == "Z" else "Z"
    return other if tall[other] > CLEARLY_TALLER * tall[usual] else usual


def _rise(labels: Sequence[str], positions: np.ndarray) -> np.ndarray:
    """(3,) the median way from the foot markers to the head markers, over the frames that show both; else zero."""
    seen = np.isfinite(positions[..., 0])
    high, low = (np.array([bool(kind.search(label)) for label in labels], bool) for kind in (HIGH, LOW))
    both = seen[:, high].any(1) & seen[:, low].any(1)
    if not both.any():
        return np.zeros(3)
    heads, feet = (np.nanmean(positions[both][:, kind], axis=1) for kind in (high, low))
    return np.median(heads - feet, axis=0)
