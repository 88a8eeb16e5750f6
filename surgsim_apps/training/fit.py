"""Least squares of a network by Adam: behaviour cloning, and the fits of DAgger (Ross, Gordon & Bagnell 2011)."""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import nn

GRADIENT_MOST = 1.0


def fit(
    network: nn.Module,
    inputs: Any,
    targets: NDArray[np.floating],
    *,
    updates: int,
    rates: tuple[float, float] = (1e-3, 1e-4),
    batch: int = 256,
    weight: ArrayLike = 1.0,
    seed: int = 0,
) -> float:
    """Fit a network to targets by weighted least squares.

    Args:
        network: changed in place.
        inputs: array (n, ...), or a dictionary of these.
        targets: shape (n, k).
        updates: number of minibatches.
        rates: learning rate at the first and at the last update; a cosine lies between.
        batch: samples of a minibatch.
        weight: of the squared errors, broadcast to (n, k).
        seed: of the order.

    Returns:
        The mean loss of the last tenth of the updates.
    """
    weights = np.broadcast_to(np.asarray(weight, dtype=np.float32), targets.shape)
    rng, order, losses = np.random.default_rng(seed), np.zeros(0, dtype=np.int64), []
    parameters = list(network.parameters())
    adam = torch.optim.Adam(parameters, lr=rates[0])
    for update in range(updates):
        if len(order) < batch:
            order = rng.permutation(len(targets))
        rows, order = order[:batch], order[batch:]
        share = 0.5 * (1.0 + math.cos(math.pi * update / updates))
        adam.param_groups[0]["lr"] = rates[1] + (rates[0] - rates[1]) * share
        missed = network(_rows(inputs, rows)) - torch.as_tensor(targets[rows], dtype=torch.float32)
        loss = (missed.square() * torch.as_tensor(weights[rows])).mean()
        adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, GRADIENT_MOST)
        adam.step()
        losses.append(loss.item())
    return float(np.mean(losses[-max(1, updates // 10) :]))


def _rows(inputs: Any, rows: NDArray[np.int64]) -> Any:
    """Rows of inputs as tensors."""
    if isinstance(inputs, dict):
        return {name: torch.as_tensor(part[rows]) for name, part in inputs.items()}
    return torch.as_tensor(inputs[rows])
