"""Estimates from rigid groups."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.fill.gap_estimates import estimate_missing_samples
from mocapfix.fill.gap_windows import FillMethod
from mocapfix.fill.rigid_group_fill import RigidGroupPlacement
from mocapfix.stats.marker_distances import RigidGroup, find_rigid_groups, measure_distance_spread
from mocapfix.stats.sequences import find_runs
from tests.fill.gap_examples import build_gap, build_take

FRAMES, NOISE_M = 300, 0.0005
SHAPE = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0.1, 0.1, 0.25], [0.25, 0.2, 0.1]])


@pytest.fixture
def prop() -> np.ndarray:
    """Return the true places (T, 5, 3) of a prop's markers in motion."""
    time = np.linspace(0, 6, FRAMES)
    rotation = Rotation.from_rotvec(np.stack([np.sin(time), np.sin(1.3 * time), np.cos(0.7 * time)], axis=1))
    return (
        np.stack([rotation.apply(place) for place in SHAPE], axis=1) + np.stack([time, np.sin(time), 0 * time], axis=1)[:, None]
    )


@pytest.fixture
def measured(prop) -> np.ndarray:
    return prop + np.random.default_rng(0).normal(0, NOISE_M, prop.shape)


def fill_rigid_group(markers):
    """Return positions and standard deviations per axis of the missing samples of a group, NaN where unknown."""
    take = build_take(markers, rigid_groups=[RigidGroup(tuple(range(markers.shape[1])), 0.001, np.nan)])
    place = RigidGroupPlacement(take)
    position, sd = np.full(markers.shape, np.nan), np.full(markers.shape[:2], np.nan)
    for marker in range(markers.shape[1]):
        for first, last in find_runs(np.isnan(markers[:, marker, 0])):
            for estimate in place(build_gap(take, marker, first, last)):
                gap, offsets = slice(first, last + 1), np.arange(last - first + 1)
                points = np.linspace(0, last - first, len(estimate.expected_sd))
                position[gap, marker], sd[gap, marker] = estimate.position, np.interp(offsets, points, estimate.expected_sd)
    return position, sd


def test_a_marker_is_filled_to_the_noise_whichever_others_are_visible(prop, measured):
    is_lost = np.zeros(prop.shape[:2], bool)
    is_lost[50:200, 0] = True
    is_lost[60:120, 1], is_lost[120:190, 2] = True, True  # four markers, then three, other ones each time
    filled, sd = fill_rigid_group(np.where(is_lost[..., None], np.nan, measured))
    error = (filled - prop)[is_lost]
    assert np.isnan(filled[~is_lost]).all()
    assert np.sqrt((error**2).mean()) < 1.5 * NOISE_M
    expected = np.hypot(np.sqrt((error**2).mean()), NOISE_M)  # that of a measured sample
    assert 0.7 < np.sqrt((sd[is_lost] ** 2).mean()) / expected < 1.5


def test_two_visible_markers_and_the_motion_place_a_third(prop, measured):
    lost = measured.copy()
    lost[100:130, 2:] = np.nan
    filled, sd = fill_rigid_group(lost)
    error = np.linalg.norm(filled - prop, axis=-1)[100:130, 2:]
    assert error.max() < 0.02
    assert error.max() < 4 * sd[100:130, 2:].max()
    assert sd[115, 2:].max() > sd[101, 2:].max()  # the angle about the line is least certain in the middle


@pytest.mark.parametrize("visible", [[0], [], [0, 1]], ids=["one", "none", "two, with no known pose nearby"])
def test_what_the_visible_markers_do_not_show_stays_empty(measured, visible):
    lost = measured.copy()
    hidden = [k for k in range(5) if k not in visible]
    lost[:, hidden] = np.nan
    filled, sd = fill_rigid_group(lost)
    assert np.isnan(filled).all()
    assert np.isnan(sd).all()


def test_markers_on_one_line_give_no_pose():
    time = np.linspace(0, 6, FRAMES)[:, None]
    line = np.stack([np.array([k, 0, 0]) + np.hstack([np.sin(time), np.cos(time), 0 * time]) for k in range(4)], axis=1)
    line = np.concatenate([line, line[:, :1] + [0.5, 0.3, 0]], axis=1) + np.random.default_rng(0).normal(
        0, NOISE_M, (FRAMES, 5, 3)
    )
    lost = line.copy()
    lost[100:150, 4] = np.nan
    sd = fill_rigid_group(lost)[1]
    assert not (sd[100:150, 4] < 0.005).any()


def test_errors_are_measured_with_the_markers_that_the_gap_shows(measured):
    """Two markers of a group that is not quite rigid: hidden stretches show what they cost."""
    lost = measured.copy()
    lost[100:110, 2:] = np.nan
    take = build_take(lost, rigid_groups=[RigidGroup((0, 1, 2, 3, 4), 0.001, np.nan)])
    [by_two] = RigidGroupPlacement(take)(build_gap(take, 2, 100, 109))
    damaged = measured.copy()
    damaged[100:110, 2] = np.nan
    take = build_take(damaged, rigid_groups=take.rigid_groups)
    [by_four] = RigidGroupPlacement(take)(build_gap(take, 2, 100, 109))
    two, four = (float(np.sqrt(np.nanmean(each.error**2))) for each in (by_two, by_four))
    assert 0.5 * NOISE_M < four < 2 * NOISE_M
    assert two > 1.2 * four


def test_a_group_fills_the_frames_that_show_it(measured):
    lost = measured.copy()
    lost[20:40, 0], lost[30:33, 1:] = np.nan, np.nan
    groups = find_rigid_groups(measure_distance_spread(np.concatenate([lost, np.zeros((FRAMES, 1, 3))], axis=1)))
    assert [group.markers for group in groups] == [(0, 1, 2, 3, 4)]
    filled = next(estimate_missing_samples(lost, 50.0, rigid_groups=groups))
    shown = np.r_[20:30, 33:40]
    assert (filled.method[shown, 0] == FillMethod.RIGID_GROUP).mean() > 0.5
    assert np.linalg.norm(filled.position[shown, 0] - measured[shown, 0], axis=-1).max() < 0.005
    assert not np.isnan(filled.sd[20:40, 0]).any()
