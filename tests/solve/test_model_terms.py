"""Poses under linear and nonlinear pose models: recovery, cost, convergence and independence of frames."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import LatentCodeTerm, PointTerm
from mocapfix.model.motion import FrameStatus
from mocapfix.solve import model_terms
from mocapfix.solve.minimise import SolverSettings, minimise
from mocapfix.solve.model_terms import PoseModelTerm
from mocapfix.solve.pose_prior import GaussianModel, PoseModel, compute_pose_vectors
from tests.kernels import dense_oracle, random_terms

JOINTS, CODE = 6, 3
NAMES = tuple("abcdef")


def build_linear_model(rng) -> GaussianModel:
    """Return a linear model whose rotations are much smaller than half a turn."""
    mean, components = rng.normal(0, 0.2, (JOINTS, 3)), rng.normal(0, 0.3, (CODE, JOINTS, 3))
    mean[0, 1] = components[:, 0, 1] = 0.0  # the root's is a tilt
    middle = random_terms.draw_rotations(rng, JOINTS, 1.0)
    middle[0] = np.eye(3)
    return GaussianModel(NAMES, middle, rng.uniform(0.02, 0.1, JOINTS), mean, components, 0.05)


@dataclass(frozen=True)
class Bent(GaussianModel):
    """A linear model with a sine on top; it counts how many codes it is linearised at."""

    evaluated_counts: list
    height: float = 0.3
    is_linear = False

    def decode(self, codes):
        return super().decode(codes) + self.height * np.sin(2 * super().decode(codes))

    def linearise(self, codes):
        self.evaluated_counts.append(len(codes))
        decoded, slopes = super().linearise(codes)
        return self.decode(codes), slopes * (1 + 2 * self.height * np.cos(2 * decoded))[..., None]

    @property
    def code_size(self):
        return len(self.components)


def bent(rng, **how) -> Bent:
    return Bent(**vars(build_linear_model(rng)), evaluated_counts=[], **how)


def solve(tree, points, model, start, *, prior_scale=1.0, codes=None, max_iterations=30):
    """Return the poses of least cost under points and a model."""
    term = PoseModelTerm(model, prior_scale, codes)
    return minimise(tree, (points, term), start, SolverSettings(max_iterations=max_iterations))


def record_rounds(monkeypatch):
    """Return a list to which each round of a solve adds roots, rotations and codes of all frames."""
    states, run_round = [], model_terms.ModelRounds.run_round

    def recorded(self, *arguments):
        run_round(self, *arguments)
        states.append((self.root_position.copy(), self.local_rotations.copy(), self.prior_scale * self.scaled_codes))

    monkeypatch.setattr(model_terms.ModelRounds, "run_round", recorded)
    return states


def body(rng) -> KinematicTree:
    return random_terms.draw_tree(rng, JOINTS)._replace(free=np.ones(JOINTS, bool))


def posed(model: PoseModel, codes):
    """Return (T, J, 3, 3) the poses that codes mean"""
    vectors = model.decode(codes)
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3) @ model.reference_rotations


def given(rng, tree, root, local, joints, sd=0.005, places=4) -> PointTerm:
    """Return exact points on some joints of each frame"""
    on = np.repeat(joints, places)
    where = rng.normal(0, 0.15, (len(on), 3))
    seen = np.stack(
        [
            dense_oracle.compute_point_positions(on, where, dense_oracle.compute_world(tree, r, q))
            for r, q in zip(root, local, strict=True)
        ]
    )
    return PointTerm(on, where, seen, np.full(seen.shape[:2], sd**-2))


def case(rng, model, frames=5, joints=(1, 3, 4)):
    """Return a body, points of it in some poses of the model, a start, and those poses' codes"""
    tree, codes = body(rng), rng.normal(0, 0.7, (frames, CODE))
    root, local = rng.normal(size=(frames, 3)), posed(model, codes)
    start = root + 0.05, np.tile(model.reference_rotations, (frames, 1, 1, 1))
    return tree, given(rng, tree, root, local, np.array(joints)), start, codes


def true_cost(tree, points, model, t, root, local, code, scale=1.0) -> float:
    """Return of frame t, all written out: the points, the pose about what the code means, the code"""
    rows, residuals = np.zeros(1, int), (code / scale)[None]
    prior = LatentCodeTerm.build(model.reference_rotations, model.decode(code[None]), np.zeros((1, JOINTS, 3, CODE)), residuals,
                         model.residual_information / scale**2, np.zeros(1), rows)  # fmt: skip
    seen = points._replace(measured=points.measured[t : t + 1], weight=points.weight[t : t + 1])
    return dense_oracle.compute_cost(dense_oracle.Frame(tree, (seen, prior), root, local, code / scale))


def costs(tree, points, model, found, scale=1.0):
    frames = zip(found.root_position, found.local_rotations, found.codes, strict=True)
    return np.array([true_cost(tree, points, model, t, *frame, scale) for t, frame in enumerate(frames)])


@pytest.mark.parametrize("make", [build_linear_model, bent])
def test_poses_of_the_model_are_recovered_from_all_joints(make):
    rng = np.random.default_rng(0)
    model = make(rng)
    tree, points, start, codes = case(rng, model, joints=range(JOINTS))
    found = solve(tree, points, model, start)
    np.testing.assert_allclose(
        found.local_rotations, posed(model, codes), atol=0.02
    )  # a code of zero is likelier than the true one
    np.testing.assert_allclose(found.codes, codes, atol=0.2)
    assert (found.status == FrameStatus.CONVERGED).all()


def test_linear_model_needs_few_iterations_with_little_damping_from_a_good_start():
    rng = np.random.default_rng(1)
    model = build_linear_model(rng)
    tree, points, start, _ = case(rng, model)
    found = solve(tree, points, model, start)
    settings = (SolverSettings(damping_ratio=ratio) for ratio in (1e-9, 0.1))
    little, much = (minimise(tree, (points, PoseModelTerm(model)), found.poses, each) for each in settings)
    assert little.iterations.max() <= 3 < much.iterations.min()
    np.testing.assert_allclose(little.cost, much.cost, atol=2e-3)


def test_linear_model_gives_the_least_squares_solution():
    rng = np.random.default_rng(1)
    model = build_linear_model(rng)
    tree, points, start, _ = case(rng, model)
    found = solve(tree, points, model, start, prior_scale=1.5)
    np.testing.assert_allclose(found.cost, costs(tree, points, model, found, 1.5), rtol=1e-9)
    for t, cost in enumerate(found.cost):
        slopes = 1.5 * np.moveaxis(model.components, 0, -1)[None]
        prior = LatentCodeTerm.build(
            model.reference_rotations,
            model.mean_vectors[None],
            slopes,
            np.zeros((1, CODE)),
            model.residual_information / 1.5**2,
            np.zeros(1),
            np.zeros(1, int),
        )
        seen = points._replace(measured=points.measured[t : t + 1], weight=points.weight[t : t + 1])
        frame = dense_oracle.Frame(tree, (seen, prior), found.root_position[t], found.local_rotations[t], found.codes[t] / 1.5)

        def residuals(x, frame=frame):
            after = dense_oracle.apply_change(frame, x)
            return np.concatenate(
                [
                    dense_oracle.compute_residual(each, dense_oracle.compute_world(*after[:1], *after[2:])).ravel()
                    for each in frame.terms
                ]
            )

        least = least_squares(residuals, np.zeros(dense_oracle.count_unknowns(frame)), method="lm").cost
        assert cost == pytest.approx(least, abs=2e-3)


def test_nonlinear_model_ends_at_a_local_minimum():
    rng = np.random.default_rng(2)
    model = bent(rng)
    tree, points, start, _ = case(rng, model)
    found = solve(tree, points, model, start, max_iterations=200)
    reached = costs(tree, points, model, found)
    for t in range(len(reached)):
        frame = dense_oracle.Frame(tree, (), found.root_position[t], found.local_rotations[t], found.codes[t])
        for _ in range(60):
            after = dense_oracle.apply_change(frame, rng.normal(0, 0.003, dense_oracle.count_unknowns(frame)))
            assert true_cost(tree, points, model, t, *after[2:]) > reached[t] - 0.02


@pytest.mark.parametrize("height", [0.3, 3.0])
def test_true_cost_never_increases(height, monkeypatch):
    rng = np.random.default_rng(3)
    model = bent(rng, height=height)
    tree, points, start, _ = case(rng, model, joints=(2, 5))
    states = record_rounds(monkeypatch)
    found = solve(tree, points, model, start)
    after = [costs(tree, points, model, replace(found, root_position=r, local_rotations=q, codes=z)) for r, q, z in states]
    fell = np.diff(after, axis=0)
    np.testing.assert_allclose(found.cost, after[-1], rtol=1e-6)
    assert (fell <= 1e-9).all()
    assert (fell < -1e-3).any()


@pytest.mark.parametrize("make", [build_linear_model, bent])
def test_batches_and_frame_order_are_irrelevant(make, monkeypatch):
    rng = np.random.default_rng(4)
    model = make(rng)
    tree, points, start, _ = case(rng, model, frames=7)
    found = solve(tree, points, model, start)
    order = rng.permutation(7)
    turned = points._replace(measured=points.measured[order], weight=points.weight[order])
    monkeypatch.setattr(model_terms, "MAX_BATCH_FRAMES", 2)
    for name, again in vars(solve(tree, turned, model, tuple(each[order] for each in start))).items():
        np.testing.assert_allclose(again, getattr(found, name)[order], atol=1e-9)


def test_prior_scale_multiplies_all_model_deviations():
    rng = np.random.default_rng(5)
    model = build_linear_model(rng)
    tree, points, start, _ = case(rng, model)
    wider = replace(model, residual_sd_rad=2 * model.residual_sd_rad, components=2 * model.components)
    expected, found = (
        solve(tree, points, wider, start),
        solve(tree, points, model, start, prior_scale=2.0),
    )
    np.testing.assert_allclose(found.local_rotations, expected.local_rotations, atol=1e-9)
    np.testing.assert_allclose(found.codes, 2 * expected.codes, atol=1e-9)


def test_converged_frames_are_not_linearised_again(monkeypatch):
    rng = np.random.default_rng(6)
    model = bent(rng)
    tree, points, start, _ = case(rng, model)
    with monkeypatch.context() as finer:
        finer.setattr(model_terms, "MIN_ROUND_COST_DECREASE", 1e-4)
        first = solve(tree, points, model, start, max_iterations=200)
    root, local, codes = start[0], start[1], np.zeros((5, CODE))
    for t in (0, 1, 3):  # three frames begin where they end
        root[t], local[t], codes[t] = first.root_position[t], first.local_rotations[t], first.codes[t]
    model.evaluated_counts.clear()
    again = solve(tree, points, model, (root, local), codes=codes, max_iterations=200)
    assert (again.status == FrameStatus.CONVERGED).all()
    assert model.evaluated_counts[:2] == [5, 2]  # the codes of the first round differ, otherwise one evaluation would serve all


def test_linear_model_is_linearised_once(monkeypatch):
    rng = np.random.default_rng(7)
    model, counts = build_linear_model(rng), []
    linearise = type(model).linearise
    monkeypatch.setattr(type(model), "linearise", lambda self, codes: counts.append(len(codes)) or linearise(self, codes))
    tree, points, start, _ = case(rng, model)
    solve(tree, points, model, start)
    assert counts == [1]


def test_start_is_not_modified_and_iterations_are_limited():
    rng = np.random.default_rng(8)
    model = bent(rng)
    tree, points, start, codes = case(rng, model)
    kept = *(each.copy() for each in start), codes.copy()
    found = solve(tree, points, model, start, codes=codes, max_iterations=1)
    for now, before in zip((*start, codes), kept, strict=True):
        np.testing.assert_array_equal(now, before)
    assert (found.status == FrameStatus.ITERATION_LIMIT).any()
    assert (found.iterations >= 1).all()


def test_model_determines_the_tilt_but_not_the_heading():
    """Nothing but the root's place is known: the body stands as the mean does, whichever way it faces."""
    rng = np.random.default_rng(9)
    model, tree = build_linear_model(rng), body(rng)
    root, local = np.zeros((1, 3)), np.tile(model.reference_rotations, (1, 1, 1, 1))
    heading = Rotation.from_rotvec([0, 1.2, 0]).as_matrix()
    local[0, 0] = heading @ Rotation.from_rotvec([0.4, 0, -0.3]).as_matrix()
    points = PointTerm(np.zeros(1, int), np.zeros((1, 3)), np.zeros((1, 1, 3)), np.full((1, 1), 1e4))
    found = solve(tree, points, model, (root, local))
    np.testing.assert_allclose(
        compute_pose_vectors(found.local_rotations, model.reference_rotations)[0], model.mean_vectors, atol=1e-3
    )
    np.testing.assert_allclose(found.codes, 0, atol=0.01)
