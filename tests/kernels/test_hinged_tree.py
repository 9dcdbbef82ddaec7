"""The model of frames of a tree of hinges and slides: derivatives against differences of the cost."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.kernels.hinged_tree import (
    ROOT_UNKNOWNS,
    BalanceTerm,
    CollisionTerm,
    FloorTerm,
    HingedTerms,
    HingedTree,
    LineTerm,
    LinkRotationTerm,
    PlaceTerm,
    linearise_hinged_frames,
    place_points_of_frames,
)

STEP = 1e-5
JOINT_LINKS = (1, 1, 2, 3, 3, 4, 5, 6)
UNKNOWNS = np.array([0, 1, 2, 3, 1, 4, 2, 5])
"""Joint 4 follows the unknown of joint 1 in the same limb, joint 6 that of joint 2 in the other."""
PARENTS = np.array([-1, 0, 1, 2, 0, 4, 5, 3])
"""Two limbs of three links with joints, and a link that is fixed to the end of one."""


@pytest.fixture(scope="module")
def rng():
    return np.random.default_rng(4)


@pytest.fixture(scope="module")
def tree(rng) -> HingedTree:
    """A tree with oblique axes, anchors off the origins, slides, couplings and offsets."""
    count, links = len(JOINT_LINKS), len(PARENTS)
    axes = rng.normal(size=(count, 3))
    first = np.searchsorted(JOINT_LINKS, np.arange(links + 1))
    paths, lengths = np.zeros((links, count), int), np.zeros(links, int)
    for link in range(1, links):
        path = [*paths[PARENTS[link], : lengths[PARENTS[link]]], *range(first[link], first[link + 1])]
        paths[link, : len(path)], lengths[link] = path, len(path)
    return HingedTree(
        PARENTS,
        rng.normal(size=(links, 3)) * 0.3,
        Rotation.random(links, rng=rng).as_matrix(),
        first,
        axes / np.linalg.norm(axes, axis=1, keepdims=True),
        rng.normal(size=(count, 3)) * 0.1,
        np.array([False, False, True, False, False, False, True, False]),
        UNKNOWNS,
        np.array([1.0, 1.0, 1.0, 1.0, -0.7, 1.0, 0.6, 1.0]),
        rng.normal(size=count) * 0.2,
        paths,
        lengths,
    )


@pytest.fixture(scope="module")
def pose(tree, rng) -> tuple[np.ndarray, np.ndarray]:
    """References and unknowns of two frames; the second one has no rotation vector."""
    unknowns = rng.normal(size=(2, ROOT_UNKNOWNS + UNKNOWNS.max() + 1)) * 0.5
    unknowns[1, 3:6] = 0.0
    return Rotation.random(2, rng=rng).as_matrix(), unknowns


def build_terms(**terms) -> HingedTerms:
    """Return the terms, and empty ones for the others."""
    none, links, nowhere = np.zeros((0, 3)), np.zeros(0, int), np.zeros((2, 0, 3))
    pairs, solid = np.zeros((0, 2), int), np.zeros((0, 3, 3))
    empty = HingedTerms(
        PlaceTerm(links, none, nowhere, nowhere),
        FloorTerm(links, none, np.zeros(0), 1.0),
        LineTerm(pairs, np.zeros((0, 2, 3)), nowhere, np.zeros((2, 0))),
        LinkRotationTerm(links, np.zeros((2, 0, 3, 3)), np.zeros((2, 0))),
        CollisionTerm(links, np.zeros((0, 2, 3)), np.zeros(0), pairs, links, none, solid, none, pairs, 0.1, 1.0),
        BalanceTerm(links, none, np.zeros(0), np.zeros((2, 2)), np.zeros(2)),
    )
    return empty._replace(**terms)


def linearise(tree, terms, pose, unknowns, frame) -> tuple[float, np.ndarray, np.ndarray]:
    """Return cost, gradient and the symmetric curvature of a frame."""
    size = unknowns.shape[1]
    curvature, gradient = np.empty((1, size, size)), np.empty((1, size))
    cost = linearise_hinged_frames(tree, terms, np.array([frame]), pose[0], unknowns, True, curvature, gradient)
    return cost, gradient[0], np.tril(curvature[0]) + np.tril(curvature[0], -1).T


def differentiate(tree, terms, pose, frame, which, step=STEP) -> np.ndarray:
    """Return central differences of the cost (`which` 0) or of the gradient (1) by each unknown."""
    rows = []
    for k in range(pose[1].shape[1]):
        sides = []
        for sign in (-1, 1):
            moved = pose[1].copy()
            moved[frame, k] += sign * step
            sides.append(linearise(tree, terms, pose, moved, frame)[which])
        rows.append((sides[1] - sides[0]) / (2 * step))
    return np.array(rows)


def place(tree, pose, links, offsets) -> tuple[np.ndarray, np.ndarray]:
    """Return places and rotations of points of links in the frames of the pose."""
    places, rotations = np.empty((2, len(links), 3)), np.empty((2, len(links), 3, 3))
    place_points_of_frames(tree, *pose, np.array(links), offsets, places, rotations)
    return places, rotations


def build_measured_terms(tree, pose, rng, noise: float) -> dict[str, HingedTerms]:
    """Return a term of each kind that is measured, with values that are off by `noise`."""
    links, offsets = np.array([0, 3, 6, 7]), rng.normal(size=(4, 3)) * 0.2
    places, rotations = place(tree, pose, links, offsets)
    weights = rng.uniform(1.0, 5.0, (2, 4, 3))
    turns = Rotation.from_rotvec(rng.normal(size=(8, 3)) * noise).as_matrix().reshape(2, 4, 3, 3)
    lines, ends = np.array([[1, 3], [2, 7], [6, 6]]), rng.normal(size=(3, 2, 3)) * 0.2
    near, far = (place(tree, pose, lines[:, k], np.ascontiguousarray(ends[:, k]))[0] for k in (0, 1))
    directions = far - near + noise * rng.normal(size=near.shape)
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    shares = np.array([0.1, 0.4, 0.3, 0.2])
    centres = np.einsum("k,tka->ta", shares, places)[:, :2] + noise * rng.normal(size=(2, 2))
    return {
        "balance": build_terms(balance=BalanceTerm(links, offsets, shares, centres, weights[:, 0, 0].copy())),
        "place": build_terms(place=PlaceTerm(links, offsets, places + noise * rng.normal(size=places.shape), weights)),
        "line": build_terms(line=LineTerm(lines, ends, directions, weights[:, :3, 0].copy())),
        "rotation": build_terms(rotation=LinkRotationTerm(links, turns @ rotations, weights[..., 0].copy())),
    }


@pytest.mark.parametrize("kind", ["place", "line", "rotation", "balance"])
def test_gradient_of_measured_terms_is_that_of_the_cost(tree, pose, rng, kind):
    terms = build_measured_terms(tree, pose, rng, 0.4)[kind]
    for frame in range(2):
        _, gradient, _ = linearise(tree, terms, pose, pose[1], frame)
        assert np.abs(gradient).max() > 0.1
        np.testing.assert_allclose(gradient, differentiate(tree, terms, pose, frame, 0), atol=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("kind", ["place", "line", "rotation", "balance"])
def test_curvature_where_all_errors_are_zero_is_that_of_the_cost(tree, pose, rng, kind):
    terms = build_measured_terms(tree, pose, rng, 0.0)[kind]
    for frame in range(2):
        cost, gradient, curvature = linearise(tree, terms, pose, pose[1], frame)
        assert cost < 1e-12
        assert np.abs(gradient).max() < 1e-6
        expected = differentiate(tree, terms, pose, frame, 1)
        np.testing.assert_allclose(curvature, expected, atol=1e-5 * np.abs(expected).max())


def test_only_points_below_their_height_cost(tree, pose, rng):
    links, offsets = np.array([3, 6, 7, 2]), rng.normal(size=(4, 3)) * 0.2
    heights = place(tree, pose, links, offsets)[0][0, :, 2] + [0.3, -0.3, 0.1, -1e-3]
    terms = build_terms(floor=FloorTerm(links, offsets, heights, 40.0))
    cost, gradient, _ = linearise(tree, terms, pose, pose[1], 0)
    assert cost == pytest.approx(0.5 * 40.0 * (0.3**2 + 0.1**2))
    np.testing.assert_allclose(gradient, differentiate(tree, terms, pose, 0, 0), atol=1e-6 * np.abs(gradient).max())


def build_collisions(rng, pairs, box_pairs) -> HingedTerms:
    """Return capsules and boxes that are all nearer to each other than they may be."""
    term = CollisionTerm(
        np.array([3, 6, 1, 7]),
        rng.normal(size=(4, 2, 3)) * 0.1,
        np.array([0.1, 0.2, 0.05, 0.1]),
        np.array(pairs, int).reshape(-1, 2),
        np.array([5, 2]),
        rng.normal(size=(2, 3)) * 0.1,
        Rotation.random(2, rng=rng).as_matrix(),
        np.array([[0.05, 0.1, 0.2], [0.1, 0.1, 0.15]]),
        np.array(box_pairs, int).reshape(-1, 2),
        3.0,
        2.0,
    )
    return build_terms(collision=term)


def test_gradient_of_capsules_is_that_of_the_cost(tree, pose, rng):
    terms = build_collisions(rng, [(0, 1), (2, 3), (1, 3)], [])
    for frame in range(2):
        cost, gradient, _ = linearise(tree, terms, pose, pose[1], frame)
        assert cost > 1.0
        np.testing.assert_array_equal(gradient[:ROOT_UNKNOWNS], 0.0)
        np.testing.assert_allclose(gradient, differentiate(tree, terms, pose, frame, 0), atol=1e-6 * np.abs(gradient).max())


def test_gradient_of_capsules_and_boxes_is_that_of_the_cost(tree, pose, rng):
    """The place on the capsule is found by a search, to 0.1 % of its length."""
    terms = build_collisions(rng, [], [(0, 0), (1, 1), (3, 0)])
    for frame in range(2):
        cost, gradient, _ = linearise(tree, terms, pose, pose[1], frame)
        expected = differentiate(tree, terms, pose, frame, 0, step=1e-3)
        assert cost > 1.0
        np.testing.assert_allclose(gradient, expected, atol=2e-3 * np.abs(gradient).max())


def test_cost_of_capsules_is_by_their_distance():
    """Two links side by side, whose capsules cross at a distance of 0.3 m along Z, and one beside a box."""
    tree = HingedTree(
        np.array([-1, 0]),
        np.array([[0.0, 0, 0], [0, 0, 0.3]]),
        np.tile(np.eye(3), (2, 1, 1)),
        np.array([0, 0, 1]),
        np.array([[0.0, 0, 1]]),
        np.zeros((1, 3)),
        np.array([True]),
        np.array([0]),
        np.ones(1),
        np.zeros(1),
        np.array([[0], [0]]),
        np.array([0, 1]),
    )
    ends = np.array([[[-1.0, 0, 0], [1, 0, 0]], [[0.0, -1, 0], [0, 1, 0]]])
    term = CollisionTerm(
        np.array([0, 1]), ends, np.array([0.1, 0.15]), np.array([[0, 1]]),
        np.array([0]), np.zeros((1, 3)), np.eye(3)[None], np.array([[0.2, 0.2, 0.1]]), np.array([[1, 0]]), 0.1, 2.0,
    )  # fmt: skip
    pose = np.eye(3)[None], np.zeros((1, 7))
    cost, gradient, _ = linearise(tree, build_terms(collision=term), pose, pose[1], 0)
    capsules, box = 0.3 - 0.1 - 0.15 - 0.1, 0.3 - 0.1 - 0.15 - 0.1
    assert cost == pytest.approx(capsules**2 + box**2)
    assert gradient[6] == pytest.approx(2.0 * (capsules + box))
    apart = pose[1].copy()
    apart[0, 6] = 0.06
    assert linearise(tree, build_terms(collision=term), pose, apart, 0)[0] == 0.0
