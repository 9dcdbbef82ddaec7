"""The pose solve: poses and codes are recovered, outliers rejected, and every end has its status."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.kernels.levenberg_marquardt import INITIAL_DAMPING_RATIO, MIN_COST_DECREASE, solve_frames
from mocapfix.kernels.terms import (
    GEMAN_MCCLURE,
    HUBER,
    DistanceTerm,
    JointLimitTerm,
    LatentCodeTerm,
    PointTerm,
    TrackingTerm,
    count_rows,
)
from mocapfix.model.motion import FrameStatus
from mocapfix.solve.parallel import order_independently
from tests.kernels import dense_oracle, random_terms
from tests.kernels.solver_runs import solve_frames_from

PLAIN = np.array([np.inf])
seeds = st.integers(0, 2**32 - 1)


def draw_exact_markers(rng, frame, each=4, sd=1e-6, loss=GEMAN_MCCLURE) -> PointTerm:
    """Return exact markers, `each` on every joint, of so small an sd that the smallest error is worth a step."""
    joints = np.repeat(np.arange(len(frame.local)), each)
    places, at = rng.normal(0, 0.15, (len(joints), 3)), dense_oracle.compute_world(*frame[:1], *frame[2:])
    return PointTerm(
        joints, places, dense_oracle.compute_point_positions(joints, places, at)[None], np.full((1, len(joints)), sd**-2), loss
    )


def draw_start(rng, frame, sd):
    """Return a start whose unknowns differ from the frame's by about `sd`."""
    return dense_oracle.apply_change(frame, rng.normal(0, sd, dense_oracle.count_unknowns(frame)))[2:]


def build_chain(joints) -> dense_oracle.KinematicTree:
    """Return joints 0.3 m apart along x, all free."""
    offsets = np.tile([0.3, 0.0, 0.0], (joints, 1))
    return random_terms.KinematicTree(np.arange(-1, joints - 1), offsets, np.ones(joints, bool))


def build_tracking(local, weight) -> TrackingTerm:
    """Return a tracking term of a pose, its root at the origin, with one weight (1/rad^2) for all joints."""
    return TrackingTerm(local[None].copy(), np.full((1, len(local)), weight), np.zeros((1, 3)), np.ones(1))


@given(seeds, st.integers(1, 12))
def test_exact_markers_recover_a_pose(seed, joints):
    rng = np.random.default_rng(seed)
    frame = random_terms.draw_frame(rng, joints, [])
    frame = frame._replace(terms=random_terms.build_terms(joints, points=draw_exact_markers(rng, frame)))
    root, local, _, status, _ = solve_frames_from(frame, PLAIN, start=draw_start(rng, frame, 0.1))
    assert status[0] in (FrameStatus.CONVERGED, FrameStatus.EXACT)
    np.testing.assert_allclose(root[0], frame.root, atol=1e-6)
    np.testing.assert_allclose(local[0], frame.local, atol=1e-6)


@given(seeds)
def test_markers_recover_the_code_of_a_decoded_pose(seed):
    """Some joints have no markers: the decoder determines them from the others."""
    rng, joints, size = np.random.default_rng(seed), 8, 3
    middle, slope = random_terms.draw_rotations(rng, joints), rng.normal(0, 0.2, (joints, 3, size))
    middle[0], slope[0, 1] = np.eye(3), 0.0  # the root's is a tilt
    code = rng.normal(size=size)
    local = Rotation.from_rotvec(slope @ code).as_matrix() @ middle
    body = random_terms.draw_tree(rng, joints)._replace(free=np.ones(joints, bool))
    frame = dense_oracle.Frame(body, (), rng.normal(size=3), local, code)
    markers = draw_exact_markers(rng, frame, sd=1e-5)
    markers.weight[:, np.isin(markers.joints, [3, 6])] = 0.0
    elsewhere = rng.normal(size=(1, size))  # where the decoder was linearised; it is linear, so the place is irrelevant
    decoded = (slope @ elsewhere[0])[None]
    information = np.tile(1e8 * np.eye(3), (joints, 1, 1))
    prior = LatentCodeTerm.build(middle, decoded, slope[None], elsewhere, information, np.zeros(1), np.zeros(1, int))
    frame = frame._replace(terms=random_terms.build_terms(joints, points=markers, latent_code=prior))
    start = frame.root + 0.02, random_terms.draw_rotations(rng, joints, 0.1) @ local, np.zeros(size)
    _, found, shared, _, _ = solve_frames_from(frame, PLAIN, start=start)
    np.testing.assert_allclose(shared[0], code, atol=1e-3)
    np.testing.assert_allclose(found[0], local, atol=1e-3)


@given(seeds)
def test_second_solve_from_the_solution_changes_the_cost_little(seed):
    frame = random_terms.draw_frame(
        np.random.default_rng(seed), 6, ["points", "tracking", "pose_prior", "latent_code", "distances"], codes=2
    )
    *first, status, _ = solve_frames_from(frame, PLAIN, most=300)
    *again, _, _ = solve_frames_from(frame, PLAIN, most=300, start=tuple(each[0] for each in first))
    costs = [dense_oracle.compute_cost(frame._replace(root=r[0], local=q[0], shared=s[0])) for r, q, s in (first, again)]
    assert status[0] == FrameStatus.CONVERGED
    assert costs[0] - costs[1] < 0.01 + 1e-2 * costs[0]  # conflicting data can leave a kink, where only small steps help


@given(seeds, st.sampled_from([np.inf, 9.0]))
def test_cost_never_increases(seed, scale2):
    """More iterations continue from the end of fewer; only the last, negligible step is not checked and may increase the cost."""
    frame = random_terms.draw_frame(np.random.default_rng(seed), 5)
    ends = [solve_frames_from(frame, np.array([scale2]), most=most)[:3] for most in range(10)]
    costs = [dense_oracle.compute_cost(frame._replace(root=r[0], local=q[0], shared=s[0]), scale2) for r, q, s in ends]
    assert (np.diff(costs) <= MIN_COST_DECREASE).all()
    assert costs[-1] < costs[0]


def test_negligible_step_after_a_rejection_is_not_accepted():
    """A target beyond half a turn, where the rotation vector jumps to the other side: the solve ends just before half a turn.

    Every step beyond is rejected, until the damping is so large that the predicted decrease is negligible.
    """
    wanted, information = np.array([[[0, 0, 0], [np.pi + 2, 0, 0]]]), np.array([np.zeros((3, 3)), 9 * np.eye(3)])
    middle, none, row = np.tile(np.eye(3), (2, 1, 1)), np.zeros((1, 0)), np.zeros(1, int)
    beyond = LatentCodeTerm.build(middle, wanted, np.zeros((1, 2, 3, 0)), none, information, np.zeros(1), row)
    for angle in np.arange(2.2, 3.1, 0.02):
        start = np.zeros(3), Rotation.from_rotvec([[0, 0, 0], [angle, 0, 0]]).as_matrix(), np.zeros(0)
        _, local, _, status, _ = solve_frames_from(
            dense_oracle.Frame(build_chain(2), random_terms.build_terms(2, latent_code=beyond), *start), PLAIN, most=100
        )
        assert status[0] == FrameStatus.CONVERGED
        np.testing.assert_allclose(Rotation.from_matrix(local[0, 1]).as_rotvec(), [np.pi, 0, 0], atol=0.002)


def test_every_end_has_its_status():
    rng = np.random.default_rng(2)
    frame = random_terms.draw_frame(rng, 5, [])
    seen = frame._replace(terms=random_terms.build_terms(5, points=draw_exact_markers(rng, frame)))
    far = draw_start(rng, frame, 0.3)

    def end(frame, **options):
        *_, status, iterations = solve_frames_from(frame, PLAIN, **options)
        return status[0], iterations[0]

    assert end(seen, start=far, most=2) == (FrameStatus.ITERATION_LIMIT, 2)
    assert end(seen, start=far)[0] in (FrameStatus.CONVERGED, FrameStatus.EXACT)
    assert end(seen)[0] == FrameStatus.EXACT
    assert end(frame) == (FrameStatus.UNCONSTRAINED, 0)
    pulled = frame._replace(terms=random_terms.build_terms(5, tracking=build_tracking(frame.local, 1.0)))
    assert end(pulled)[0] == FrameStatus.CONVERGED


@pytest.mark.parametrize("loss", [GEMAN_MCCLURE, HUBER])
def test_outliers_are_rejected(loss):
    """With wide scales first, a good marker far from the start is not rejected as an outlier."""
    rng = np.random.default_rng(3)
    frame = random_terms.draw_frame(rng, 6, [])
    truth = draw_exact_markers(rng, frame, each=6, sd=0.01, loss=loss)
    wild = truth._replace(measured=truth.measured.copy())
    wild.measured[0, [8, 21]] += [[0.3, -0.4, 0.2], [5.0, 0.0, 0.0]]
    frame, start = frame._replace(terms=random_terms.build_terms(6, points=wild)), draw_start(rng, frame, 0.1)
    scales2, worst = (np.array([0.4, 0.2, 0.1, 0.05]) / 0.01) ** 2, []
    for scales in (scales2, PLAIN):
        root, local, *_ = solve_frames_from(frame, scales, start=start)
        placed = dense_oracle.compute_point_positions(
            truth.joints, truth.offsets, dense_oracle.compute_world(frame.tree, root[0], local[0])
        )
        worst.append(np.abs(placed - truth.measured[0]).max())
    assert worst[0] < (0.001 if loss == GEMAN_MCCLURE else 0.1)  # with Huber's loss its gradient is bounded, not zero
    assert worst[1] > 0.3


def test_distance_term_keeps_the_length_of_a_held_stick():
    offsets = np.array([[0, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [-0.2, 0, 0], [-0.3, 0, 0]])
    tree = random_terms.KinematicTree(np.array([-1, 0, 1, 0, 3]), offsets, np.ones(5, bool))
    local = np.tile(np.eye(3), (5, 1, 1))
    stick = DistanceTerm(np.array([[2, 4]]), np.zeros((1, 2, 3)), np.array([[0.8]]), np.array([[1e6]]))
    terms = random_terms.build_terms(5, tracking=build_tracking(local, 1.0), distances=stick)
    start = (
        np.zeros(3),
        random_terms.draw_rotations(np.random.default_rng(1), 5, 0.1),
        np.zeros(0),
    )  # a stretched body has no gradient
    root, local, *_ = solve_frames_from(dense_oracle.Frame(tree, terms, *start), PLAIN)
    position = dense_oracle.compute_world(tree, root[0], local[0]).position
    assert np.linalg.norm(position[2] - position[4]) == pytest.approx(0.8, abs=1e-4)  # 1 m without the stick
    np.testing.assert_allclose(root[0], 0, atol=0.2)


def test_joint_limit_balances_a_tracking_term():
    """Two springs in balance: the target at 1 rad and the limit at 0.4 rad; the axes within their ranges follow the target."""
    local, (tracking, limit) = np.tile(np.eye(3), (2, 1, 1)), (50.0, 1e4)
    wanted = local.copy()
    wanted[1] = Rotation.from_rotvec([1.0, 0, 0]).as_matrix()
    bounds = np.full((2, 3), 0.4)
    terms = random_terms.build_terms(
        2, tracking=build_tracking(wanted, tracking), joint_limits=JointLimitTerm(local.copy(), -bounds, bounds, limit)
    )
    _, found, *_ = solve_frames_from(dense_oracle.Frame(build_chain(2), terms, np.zeros(3), local, np.zeros(0)), PLAIN)
    vector = Rotation.from_matrix(found[0, 1]).as_rotvec()
    np.testing.assert_allclose(vector, [(tracking * 1.0 + limit * 0.4) / (tracking + limit), 0, 0], atol=1e-3)


def test_solutions_do_not_depend_on_the_blocks():
    rng, joints, frames = np.random.default_rng(5), 8, 12
    frame = random_terms.draw_frame(rng, joints, [])
    exact = draw_exact_markers(rng, frame, sd=0.01)
    seen = exact.measured + rng.normal(0, 0.05, (frames, *exact.measured.shape[1:]))
    terms = random_terms.build_terms(joints, frames, points=exact._replace(measured=seen, weight=np.full(seen.shape[:2], 1e4)))
    order, results = order_independently(np.arange(frames), joints), []
    for blocks in ([(0, 12)], [(0, 5), (5, 12)], [(t, t + 1) for t in reversed(range(12))]):
        root, local = np.tile(frame.root, (frames, 1)), np.tile(frame.local, (frames, 1, 1, 1))
        out = root, local, np.zeros((frames, 0)), np.zeros(frames, int), np.zeros(frames, int)
        for block in blocks:
            solve_frames(
                frame.tree, terms, order, np.array([400.0, 25.0]), INITIAL_DAMPING_RATIO, 8, count_rows(terms), *out, *block
            )
        results.append(out)
    for other in results[1:]:
        for found, expected in zip(other, results[0], strict=True):
            np.testing.assert_array_equal(found, expected)
    assert len(np.unique(results[0][0], axis=0)) == frames
