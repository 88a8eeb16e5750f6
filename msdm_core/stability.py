"""The largest stable step of an organ, from its springs, volume term, damping and contact together."""

import math

import numpy as np
from scipy.optimize import brentq
from scipy.sparse.linalg import LinearOperator, eigsh

from msdm_core.kernels import ContactLaw, OrganModel, apply_stiffness
from msdm_core.mesh import FloatArray

# Relative accuracy asked of the largest eigenvalue: 1 % of the step. Lanczos comes from below, so it is added back.
EIGENVALUE_TOLERANCE = 0.02
LANCZOS_VECTORS = 12


def largest_frequency(model: OrganModel, node_stiffness: FloatArray | None = None) -> float:
    """Largest angular frequency at rest, w_max = sqrt(lambda_max(M^-1 (K + diag))) [rad/s] (Lanczos, fixed start).

    Args:
        model: the organ.
        node_stiffness: stiffness that holds each node, such as contact's [N/m], shape (n_node,).
    """
    shape = model.node_rest_position.shape
    scale = np.sqrt(model.node_inverse_mass)[:, None]
    held = np.zeros((shape[0], 1)) if node_stiffness is None else node_stiffness[:, None]
    force = np.empty(shape)

    def apply(vector: FloatArray) -> FloatArray:
        displacement = scale * vector.reshape(shape)
        apply_stiffness(model, displacement, force)
        return (scale * (force + held * displacement)).ravel()

    count = 3 * shape[0]
    if not model.node_inverse_mass.any():
        return 0.0
    if count < 60:
        matrix = np.column_stack([apply(column) for column in np.eye(count)])
        return math.sqrt(max(float(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[-1]), 0.0))
    # A fixed start without symmetry: the same organ gives the same step, to the bit.
    start = np.sin(1.0 + 1.7 * np.arange(count) ** 1.1)
    # scipy's stubs know neither the factory form of LinearOperator nor a real tolerance.
    operator = LinearOperator((count, count), matvec=apply, dtype=np.float64)  # pyright: ignore[reportCallIssue]
    settings = {"which": "LA", "v0": start, "ncv": LANCZOS_VECTORS, "tol": EIGENVALUE_TOLERANCE}
    value = eigsh(operator, k=1, return_eigenvectors=False, **settings)[0]
    return math.sqrt(float(value) * (1.0 + EIGENVALUE_TOLERANCE))


def contact_node_area(model: OrganModel) -> FloatArray:
    """Surface area that belongs to each node, a third of each triangle around it [m^2], shape (n_node,)."""
    thirds = np.repeat(model.surface_rest_area / 3.0, 3)
    return np.bincount(model.surface_triangles.ravel(), thirds, len(model.node_mass)).astype(np.float64)


def step_limit(omega: float, alpha: float, beta: float, drag_rate: float = 0.0) -> float:
    """Stable step of symplectic Euler for one mode, v' = e^(-alpha dt) v - dt (w^2 x + (beta w^2 + drag) v) [s].

    The characteristic polynomial leaves the unit circle at z = -1, where
    2 (1 + e^(-alpha dt)) = 2 dt (beta w^2 + drag) + w^2 dt^2; without damping this is dt = 2 / w.
    """
    if omega == 0.0 and drag_rate == 0.0:
        return math.inf
    rate = beta * omega * omega + drag_rate

    def margin(dt: float) -> float:
        return 2.0 * (1.0 + math.exp(-alpha * dt)) - 2.0 * dt * rate - (omega * dt) ** 2

    ceiling = 2.0 / omega if omega > 0.0 else 2.0 / rate
    return ceiling if margin(ceiling) >= 0.0 else float(brentq(margin, 0.0, ceiling, xtol=1e-12))  # pyright: ignore


def stable_dt(model: OrganModel, contact: ContactLaw | None = None) -> float:
    """Largest stable step [s]: springs, volume term, alpha, beta, and contact stiffness, damping and friction if given.

    Contact holds a node of surface area A_i with at most k_p A_i in any direction and drags it with c_p A_i (the rows
    of a triangle's contact stiffness sum to that); k_p stands for the larger of normal and tangential stiffness. Beta
    damps the organ alone: it counts with the organ's own w_max, and the largest of each part are added.
    """
    if contact is None:
        return model.stable_step
    area = contact_node_area(model)
    stiffest = max(contact.stiffness, contact.tangential_stiffness if contact.friction > 0.0 else 0.0)
    omega = largest_frequency(model, stiffest * area)
    drag_rate = contact.damping * float((area * model.node_inverse_mass).max())
    if model.beta > 0.0:
        drag_rate += model.beta * largest_frequency(model) ** 2
    return step_limit(omega, model.alpha, 0.0, drag_rate)
