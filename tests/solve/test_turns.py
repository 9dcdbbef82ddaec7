"""Turns mended: what was put in goes away, and what was sound stays bit for bit."""

from functools import cache

import numpy as np
import pytest

from mocapfix.bench.animations import as_faults, interpolated
from mocapfix.bench.injected_turns import KINDS, damaged
from mocapfix.kernels import kinematics
from mocapfix.motion import Motion
from mocapfix.skeleton import cmu31
from mocapfix.solve import turns
from mocapfix.synthetic import motions
from mocapfix.synthetic.truth import person

RATE = 30.0
SKELETON = cmu31().skeleton
MOST = {"flip": 0.3, "pop": 0.3, "jitter": 0.5, "limb lost": 0.8, "figure lost": 0.9, "root off": 0.2}  # of linear's error


@cache
def composed() -> Motion:
    return motions.compose(person(np.random.default_rng(5), crooked=True), 16.0, RATE)


def places(root: np.ndarray, local: np.ndarray) -> np.ndarray:
    return kinematics.carried(kinematics.tree_of(SKELETON), np.ascontiguousarray(root), np.ascontiguousarray(local))[0]


@pytest.mark.parametrize("kind", list(KINDS))
def test_what_was_put_in_goes_and_what_was_sound_stays(kind):
    truth = composed()
    struck, put = damaged(truth, SKELETON, RATE, kind, "long", np.random.default_rng(1))
    faults = [fault for each in put for fault in as_faults(each, len(SKELETON.names))]
    mended = turns.mended(SKELETON.parents, struck.root, struck.rotations, ["ZYX"] * 31, faults, RATE)
    about = mended.way != turns.AS_IT_IS
    for fault in faults:
        assert about[fault.frames, list(fault.markers)].all()
        about[fault.frames, list(fault.markers)] = False
    assert not about.any()
    sound = mended.way == turns.AS_IT_IS
    assert (mended.local[sound[:, :-1]] == truth.rotations[sound[:, :-1]]).all()
    assert (mended.root[sound[:, -1]] == truth.root[sound[:, -1]]).all()
    assert (mended.variance > 0)[~sound].all()
    true = places(truth.root, truth.rotations)
    ours, linear = (
        np.linalg.norm(places(*each) - true, axis=-1).sum()
        for each in ((mended.root, mended.local), interpolated(struck.root, struck.rotations, put))
    )
    assert ours < MOST[kind] * linear


def test_nothing_wrong_nothing_done():
    truth = composed()
    mended = turns.mended(SKELETON.parents, truth.root, truth.rotations, ["ZYX"] * 31, [], RATE)
    assert (mended.local == truth.rotations).all()
    assert (mended.root == truth.root).all()
    assert not mended.way.any()


def test_a_joint_that_is_never_there_stays_so_without_harm():
    truth = composed()
    local = truth.rotations.copy()
    local[:, 5] = np.nan
    gap = as_faults(damaged(truth, SKELETON, RATE, "limb lost", "long", np.random.default_rng(0))[1][0], 31)[0]
    whole = type(gap)("gap", 5, 0, truth.frames - 1, np.nan, "")
    mended = turns.mended(SKELETON.parents, truth.root, local, ["ZYX"] * 31, [whole], RATE)
    assert np.isfinite(mended.local).all()
    assert not mended.way[:, 5].any()
