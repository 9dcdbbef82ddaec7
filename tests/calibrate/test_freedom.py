"""What calibration may change, and what it makes of a body."""

from dataclasses import replace

import numpy as np

from mocapfix import marker_set
from mocapfix.calibrate import freedom
from mocapfix.skeleton import cmu31
from mocapfix.subject import Subject

BODY, WORN = cmu31(), marker_set.load("cmu41")
START = Subject(BODY.skeleton, WORN.name, WORN.labels, WORN.joints, WORN.places, WORN.spread)
FREE = freedom.of(START, BODY)
GROUPS = list(BODY.groups)


def unknowns(**parts):
    """-> all zero but the size, a group's scale (by its name), the shape (P,) or the places' shifts (K, 3)"""
    x = np.zeros(len(FREE.information))
    for name, value in parts.items():
        if name == "places":
            x[-WORN.places.size :] = np.ravel(value)
        elif name == "shape":
            x[1 + len(GROUPS) : -WORN.places.size] = value
        else:
            x[0 if name == "size" else 1 + GROUPS.index(name)] = value
    return x


def test_nothing_changed_is_the_body_itself():
    offsets, places = FREE.body(unknowns())
    np.testing.assert_array_equal(offsets, BODY.skeleton.offsets)
    np.testing.assert_array_equal(places, WORN.places)


def test_size_takes_all_along_and_a_group_its_bones_alone():
    offsets, places = FREE.body(unknowns(size=0.1, thigh=-0.2))
    expected = 1.1 * BODY.skeleton.offsets
    thighs = list(BODY.groups["thigh"])
    expected[thighs] = 0.9 * BODY.skeleton.offsets[thighs]
    np.testing.assert_allclose(offsets, expected)
    np.testing.assert_allclose(places, 1.1 * WORN.places)


def test_places_shift_in_their_joints_axes():
    shifts = np.random.default_rng(0).normal(0, 0.02, WORN.places.shape)
    offsets, places = FREE.body(unknowns(places=shifts))
    np.testing.assert_array_equal(offsets, BODY.skeleton.offsets)
    np.testing.assert_allclose(places, WORN.places + shifts)


def test_a_group_is_a_part_of_the_body_it_starts_from():
    tall = replace(START, skeleton=replace(BODY.skeleton, offsets=1.2 * BODY.skeleton.offsets))
    offsets, _ = freedom.of(tall, BODY).body(unknowns(shin=0.05))
    shins = list(BODY.groups["shin"])
    np.testing.assert_allclose(offsets[shins], 1.05 * 1.2 * BODY.skeleton.offsets[shins])


def test_the_shape_is_a_sum_of_components_as_large_as_the_body():
    weights = np.random.default_rng(1).normal(size=len(BODY.shapes))
    offsets, places = FREE.body(unknowns(shape=weights))
    np.testing.assert_allclose(offsets - BODY.skeleton.offsets, np.tensordot(weights, BODY.shapes, 1), atol=1e-15)
    np.testing.assert_array_equal(places, WORN.places)
    tall = freedom.of(replace(START, skeleton=replace(BODY.skeleton, offsets=1.2 * BODY.skeleton.offsets)), BODY)
    np.testing.assert_allclose(tall.body(unknowns(shape=weights))[0], 1.2 * offsets)


def test_the_size_is_as_good_as_free_and_the_rest_is_doubted_by_its_deviation():
    assert FREE.information[0] < 1e-5
    np.testing.assert_allclose(FREE.information[unknowns(thigh=1.0) > 0], freedom.GROUP_SD**-2.0)
    np.testing.assert_allclose(FREE.information[unknowns(shape=1.0) > 0], 1.0)  # in deviations already
    np.testing.assert_allclose(FREE.information[-WORN.places.size :], freedom.PLACE_SD**-2.0)
