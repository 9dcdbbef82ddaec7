"""The evidence lower bound, compared with cases where it is known."""

import math

import numpy as np
import pytest
import torch

from mocapfix.lab.autoencoder_training import ResidualModel, compute_evidence_loss
from mocapfix.lab.networks import AutoencoderNetwork
from mocapfix.solve.trained_priors import NetworkArchitecture


def build_linear_network(gain):
    """Return a linear network: the code is `gain` times the first four features, and these are decoded from the code."""
    network = AutoencoderNetwork(NetworkArchitecture("vectors", "vectors", (), 4, 0, "silu", skip_connection=False), 31)
    with torch.no_grad():
        for layers, weight in ((network.encoder, gain * torch.eye(4, 93)), (network.decoder, torch.eye(93, 4))):
            weights, bias = layers.parameters()
            weights.copy_(weight)
            bias.zero_()
    return network


def test_bound_equals_the_likelihood_for_the_exact_posterior():
    """A linear model with noise s has a normal posterior of the code with mean x / (1 + s^2) and variance s^2 / (1 + s^2)."""
    noise = 0.5
    residual_model = ResidualModel(93, 0, 4)
    with torch.no_grad():
        residual_model.log_feature_sd.fill_(math.log(noise))
        residual_model.log_code_sd.fill_(0.5 * math.log(noise**2 / (1 + noise**2)))
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    pose = torch.as_tensor(rng.normal(0, 0.5, (1, 93)), dtype=torch.float32)
    many = pose.expand(40_000, 93)
    loss = compute_evidence_loss(build_linear_network(1 / (1 + noise**2)), residual_model, many, many, generator)
    sd = np.where(np.arange(93) < 4, math.sqrt(1 + noise**2), noise)
    likelihood = (0.5 * (pose[0].numpy() / sd) ** 2 + np.log(sd)).sum()
    # the constant that the loss omits is half a unit for each dimension of the code
    assert float(loss.detach()) - 4 / 2 == pytest.approx(likelihood, abs=0.03)


def test_any_other_posterior_increases_the_loss():
    residual_model, rng = ResidualModel(93, 0, 4), np.random.default_rng(1)
    poses = torch.as_tensor(rng.normal(0, 0.5, (20_000, 93)), dtype=torch.float32)

    def costs(gain, code):
        with torch.no_grad():
            residual_model.log_feature_sd.fill_(math.log(0.5))
            residual_model.log_code_sd.fill_(math.log(code))
        network, generator = build_linear_network(gain), torch.Generator().manual_seed(0)
        loss = compute_evidence_loss(network, residual_model, poses, poses, generator)
        return float(loss.detach())

    best = costs(0.8, math.sqrt(0.2))
    assert best < min(costs(1.0, math.sqrt(0.2)), costs(0.6, math.sqrt(0.2)), costs(0.8, 0.2), costs(0.8, 0.9))


def test_correlated_residuals_have_the_likelihood_of_their_covariance():
    residual_model, residuals = ResidualModel(5, 2, 1), torch.randn(50, 5, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        residual_model.residual_directions.copy_(torch.randn(2, 5, generator=torch.Generator().manual_seed(3)))
        covariance = (
            torch.diag(residual_model.feature_sd**2) + residual_model.residual_directions.T @ residual_model.residual_directions
        )
    known = torch.distributions.MultivariateNormal(torch.zeros(5), covariance).log_prob(residuals)
    torch.testing.assert_close(
        -residual_model.compute_negative_log_likelihood(residuals).detach(), known + 2.5 * math.log(2 * math.pi)
    )
