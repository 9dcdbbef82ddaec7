import numpy as np

from mocapfix.pose_prior.gaussian import GaussianModel

RNG = np.random.default_rng(0)
JOINTS = ("Hips", "Spine", "Head")
MEAN, COMPONENTS = RNG.normal(size=(3, 3)), RNG.normal(size=(2, 3, 3))


def linear(noise):
    return GaussianModel(JOINTS, np.tile(np.eye(3), (3, 1, 1)), np.ones(3), MEAN, COMPONENTS, noise)


def test_a_code_moves_the_pose_along_its_components():
    np.testing.assert_allclose(linear(0.1).decode(np.array([[0, 0], [0, 2.0]])), [MEAN, MEAN + 2 * COMPONENTS[1]])


def test_without_noise_encoding_undoes_decoding():
    codes = RNG.normal(size=(5, 2))
    np.testing.assert_allclose(linear(0.0).encode(linear(0.0).decode(codes)), codes, atol=1e-12)


def test_a_code_is_the_least_of_its_own_cost_and_the_poses():
    noise, model = 0.7, linear(0.7)
    pose = MEAN + RNG.normal(size=(1, 3, 3))
    code = model.encode(pose)

    def cost(z):
        return (z**2).sum() + ((pose - model.decode(z)) ** 2).sum() / noise**2

    for step in 1e-3 * np.concatenate([np.eye(2), -np.eye(2)]):
        assert cost(code) < cost(code + step)


def test_linearising_says_how_decoding_changes():
    codes, step = RNG.normal(size=(4, 2)), RNG.normal(size=(4, 2))
    decoded, slopes = linear(0.1).linearise(codes)
    assert slopes.shape == (4, 3, 3, 2)
    np.testing.assert_allclose(decoded, linear(0.1).decode(codes))
    np.testing.assert_allclose(decoded + np.einsum("njap,np->nja", slopes, step), linear(0.1).decode(codes + step), atol=1e-12)
