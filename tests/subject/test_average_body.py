from dataclasses import replace

import numpy as np
import pytest

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from mocapfix.subject import average_body
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take

MARKER_SET, SKELETON = load_marker_set("cmu41"), load_cmu31_body().skeleton


@pytest.fixture(scope="module")
def motion():
    return compose_take(seed=0, seconds=6.0, rate=30.0).motion


def build_markers(motion, factor, rng):
    """Return markers (T, K, 3) of a body `factor` times the average one, a third of the samples missing, 2 mm of noise."""
    skeleton = replace(SKELETON, offsets=SKELETON.offsets * factor)
    subject = Subject(
        skeleton,
        MARKER_SET.name,
        MARKER_SET.labels,
        MARKER_SET.joints,
        MARKER_SET.marker_offsets * factor,
        MARKER_SET.marker_spread,
    )
    markers = kinematics.compute_joint_and_marker_positions(
        subject, replace(motion, root_position=motion.root_position * factor)
    )[1]
    markers += rng.normal(0, 0.002, markers.shape)
    markers[rng.random(markers.shape[:2]) < 1 / 3] = np.nan
    return markers


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.0, 1.2])
def test_size_of_a_scaled_moving_body_is_estimated(motion, factor):
    markers = build_markers(motion, factor, np.random.default_rng(0))
    assert average_body.estimate_body_size_ratio(MARKER_SET, markers) == pytest.approx(factor, rel=0.02)


def test_missing_markers_and_outlier_frames_are_tolerated(motion):
    rng = np.random.default_rng(1)
    markers = build_markers(motion, 0.9, rng)
    markers[:, rng.permutation(len(MARKER_SET.labels))[:20]] = np.nan
    markers[:20] *= 3.0  # an eighth of the take in other units
    assert average_body.estimate_body_size_ratio(MARKER_SET, markers) == pytest.approx(0.9, rel=0.03)


def test_uninformative_take_gives_the_average_size(motion):
    markers = build_markers(motion, 0.8, np.random.default_rng(2))
    assert average_body.estimate_body_size_ratio(MARKER_SET, np.full_like(markers, np.nan)) == 1.0
    assert average_body.estimate_body_size_ratio(MARKER_SET, markers[:5]) == 1.0
    assert (
        average_body.estimate_body_size_ratio(MARKER_SET, np.random.default_rng(3).normal(size=markers.shape)) == 1.0
    )  # no distance is constant


def test_wrong_units_give_the_limits(motion):
    assert average_body.estimate_body_size_ratio(MARKER_SET, build_markers(motion, 100.0, np.random.default_rng(4))) == 1.6
    assert average_body.estimate_body_size_ratio(MARKER_SET, np.ones((20, len(MARKER_SET.labels), 3))) == 0.3  # all at one point


def test_rest_positions_are_sums_of_offsets():
    places = dict(zip(MARKER_SET.labels, average_body.compute_rest_marker_positions(MARKER_SET), strict=True))
    shin = MARKER_SET.marker_offsets[MARKER_SET.labels.index("LANK")]
    down = [SKELETON.find_joint(name) for name in ("LHipJoint", "LeftUpLeg", "LeftLeg")]
    joint = SKELETON.names[MARKER_SET.joints[MARKER_SET.labels.index("LANK")]]
    if joint == "LeftFoot":
        down.append(SKELETON.find_joint(joint))
    np.testing.assert_allclose(places["LANK"], SKELETON.offsets[down].sum(0) + shin)
