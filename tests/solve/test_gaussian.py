import numpy as np

from mocapfix.solve.pose_prior import GaussianModel

RNG = np.random.default_rng(0)
JOINTS = ("Hips", "Spine", "Head")
MEAN, COMPONENTS = RNG.normal(size=(3, 3)), RNG.normal(size=(2, 3, 3))


def build_model(noise_sd_rad):
    return GaussianModel(JOINTS, np.tile(np.eye(3), (3, 1, 1)), np.ones(3), MEAN, COMPONENTS, noise_sd_rad)


def test_decoding_adds_components_to_the_mean():
    np.testing.assert_allclose(build_model(0.1).decode(np.array([[0, 0], [0, 2.0]])), [MEAN, MEAN + 2 * COMPONENTS[1]])


def test_encoding_inverts_decoding_without_noise():
    codes = RNG.normal(size=(5, 2))
    np.testing.assert_allclose(build_model(0.0).encode(build_model(0.0).decode(codes)), codes, atol=1e-12)


def test_encoding_minimises_the_cost_of_code_and_residual():
    noise, model = 0.7, build_model(0.7)
    pose = MEAN + RNG.normal(size=(1, 3, 3))
    code = model.encode(pose)

    def cost(z):
        return (z**2).sum() + ((pose - model.decode(z)) ** 2).sum() / noise**2

    for step in 1e-3 * np.concatenate([np.eye(2), -np.eye(2)]):
        assert cost(code) < cost(code + step)


def test_linearisation_predicts_the_change_of_the_decoded_pose():
    codes, step = RNG.normal(size=(4, 2)), RNG.normal(size=(4, 2))
    decoded, jacobian = build_model(0.1).linearise(codes)
    assert jacobian.shape == (4, 3, 3, 2)
    np.testing.assert_allclose(decoded, build_model(0.1).decode(codes))
    np.testing.assert_allclose(
        decoded + np.einsum("njap,np->nja", jacobian, step), build_model(0.1).decode(codes + step), atol=1e-12
    )
