"""The bound on the evidence against cases where it is known."""

import math

import numpy as np
import pytest
import torch

from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.network import NetworkArchitecture, build_network
from mocapfix.pose_prior.pose_features import FEATURE_TYPES
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train.autoencoder import ResidualModel, compute_evidence_loss

MIDDLE = mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations
VECTORS = FEATURE_TYPES["vectors"](torch.as_tensor(MIDDLE, dtype=torch.float32))


def straight_network(gain):
    """-> a network without layers to bend anything: code = gain first numbers of the pose, pose = the code in those"""
    network = build_network(NetworkArchitecture("vectors", "vectors", (), 4, 0, "silu", skip_connection=False), MIDDLE)
    with torch.no_grad():
        for layers, weight in ((network.encoder, gain * torch.eye(4, 93)), (network.decoder, torch.eye(93, 4))):
            slope, offset = layers.parameters()
            slope.copy_(weight)
            offset.zero_()
    return network


def test_the_bound_is_the_likelihood_where_the_code_is_known_as_well_as_it_can_be():
    """Of a linear model with noise s the posterior of a code is normal, its mean x / (1 + s^2), its variance s^2 / (1 + s^2)."""
    noise = 0.5
    doubt = ResidualModel(93, 0, 4)
    with torch.no_grad():
        doubt.log_feature_sd.fill_(math.log(noise))
        doubt.code.fill_(0.5 * math.log(noise**2 / (1 + noise**2)))
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    pose = torch.as_tensor(rng.normal(0, 0.5, (1, 31, 3)), dtype=torch.float32)
    many = pose.expand(40_000, 31, 3)
    found = compute_evidence_loss(
        straight_network(1 / (1 + noise**2)), doubt, VECTORS.compute_features(many), many, VECTORS, generator
    )
    deviation = np.where(np.arange(93) < 4, math.sqrt(1 + noise**2), noise)
    likelihood = (0.5 * (pose.flatten().numpy() / deviation) ** 2 + np.log(deviation)).sum()
    assert float(found.detach()) - 4 / 2 == pytest.approx(
        likelihood, abs=0.03
    )  # the constant left out: half a unit for each number of the code


def test_a_code_that_is_known_otherwise_costs_more():
    doubt, rng = ResidualModel(93, 0, 4), np.random.default_rng(1)
    poses = torch.as_tensor(rng.normal(0, 0.5, (20_000, 31, 3)), dtype=torch.float32)

    def costs(gain, code):
        with torch.no_grad():
            doubt.log_feature_sd.fill_(math.log(0.5))
            doubt.code.fill_(math.log(code))
        found = compute_evidence_loss(
            straight_network(gain), doubt, VECTORS.compute_features(poses), poses, VECTORS, torch.Generator().manual_seed(0)
        )
        return float(found.detach())

    best = costs(0.8, math.sqrt(0.2))
    assert best < min(costs(1.0, math.sqrt(0.2)), costs(0.6, math.sqrt(0.2)), costs(0.8, 0.2), costs(0.8, 0.9))


def test_straying_together_is_as_likely_as_its_covariance_says():
    doubt, away = ResidualModel(5, 2, 1), torch.randn(50, 5, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        doubt.astray.copy_(torch.randn(2, 5, generator=torch.Generator().manual_seed(3)))
        covariance = torch.diag(doubt.feature_sd**2) + doubt.astray.T @ doubt.astray
    known = torch.distributions.MultivariateNormal(torch.zeros(5), covariance).log_prob(away)
    torch.testing.assert_close(-doubt.compute_negative_log_likelihood(away).detach(), known + 2.5 * math.log(2 * math.pi))
