"""Estimates of missing samples, and their mean by precision."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

WAYS = (
    "its own path, by splines",
    "the markers that move with it",
    "the solved body",
    "all markers, as they went at other moments",
)
PATH, CLUSTER, BODY, RECALLED = range(len(WAYS))
ALIKE = 0.5  # correlation of the errors of two estimates of one sample


class Estimate(NamedTuple):
    """Places of missing samples (T, M, 3) in metres, their deviation per axis (T, M), NaN where there is none, and by which of
    WAYS (T, M) they were found."""

    place: np.ndarray
    deviation: np.ndarray
    way: np.ndarray


def one_way(place: np.ndarray, deviation: np.ndarray, way: int) -> Estimate:
    """-> an estimate all of which was found by one way."""
    return Estimate(place, deviation, np.full(deviation.shape, way, np.int8))


def weighed(estimates: Iterable[Estimate], alike: float = ALIKE) -> Estimate:
    """-> the mean of several estimates by their precision, by the way that counts most in it; NaN where none is.

    They err together, for all go by the same neighbours and edges, so the mean is less sure than independent ones would make
    it: `alike` is the correlation of their errors. Where they lie farther apart than they say, they say too little: the
    deviation grows by as much (Birge 1932, "The calculation of errors by the method of least squares").
    """
    place = precision = root = count = square = most = way = np.zeros(())
    for there, sure, by in estimates:
        if not count.shape:
            place, way = np.zeros(there.shape), np.zeros(sure.shape, np.int8)
            precision, root, count, square, most = (np.zeros(sure.shape) for _ in range(5))
        known = ~np.isnan(sure)
        weight = 1 / sure[known] ** 2
        place[known] += weight[:, None] * there[known]
        precision[known] += weight
        root[known] += 1 / sure[known]
        count[known] += 1
        square[known] += weight * (there[known] ** 2).sum(1)
        more = known & (np.nan_to_num(1 / sure) > most)
        most[more], way[more] = 1 / sure[more], by[more]
        del there  # before the next one is made
    precision[count == 0] = np.nan
    place /= precision[..., None]
    apart = square - precision * (place**2).sum(-1)
    birge = np.maximum(apart / np.maximum(3 * (count - 1), 1), 1)
    return Estimate(place, np.sqrt((alike * root**2 + (1 - alike) * precision) * birge) / precision, way)
