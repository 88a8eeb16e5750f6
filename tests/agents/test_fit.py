"""Least squares of a policy's network finds policies that are known."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the `agents` extra")
import torch

from surgsim_apps.training.fit import fit
from surgsim_apps.training.policy_network import NetworkLayout, PolicyNetwork

pytestmark = pytest.mark.agents
GAIN = np.array([[0.5, -0.3], [0.2, 0.4], [-0.3, 0.1]])
# Observations of very different scales; the best action is linear in them.
SCALE = np.array([0.01, 1.0, 100.0])


def demonstrations(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    plain = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3))
    return (plain * SCALE).astype(np.float32), (plain @ GAIN).astype(np.float32)


def made(*, normalised: bool) -> PolicyNetwork:
    torch.manual_seed(0)
    return PolicyNetwork(NetworkLayout(), (3, 64, 64, 2), normalised=normalised)


def test_a_known_policy_is_found():
    network, (observations, actions) = made(normalised=True), demonstrations(2000, 0)
    network.normalise_by(observations)
    loss = fit(network, observations, actions, updates=400)
    fresh, wanted = demonstrations(500, 1)
    # The actions' own spread is 0.3; of a smooth function of three numbers a small network misses little.
    assert np.sqrt(np.square(network.actions(fresh, ()) - wanted).mean()) < 0.05 and loss < 0.003


def test_what_is_scarce_can_be_weighted():
    """Two actions for the same observation: the mean lies where the weights put it, for each number of the action."""
    network, observations = made(normalised=False), np.zeros((400, 3), dtype=np.float32)
    actions = np.zeros((400, 2), dtype=np.float32)
    actions[:100] = 0.8
    weight = np.ones((400, 2))
    weight[:100] = [9.0, 1.0]
    fit(network, observations, actions, updates=400, weight=weight)
    # (9 x 100 x 0.8) / (9 x 100 + 300) = 0.6, and 0.8 / 4 = 0.2.
    assert network.actions(observations[:1], ())[0] == pytest.approx([0.6, 0.2], abs=0.06)
