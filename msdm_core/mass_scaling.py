"""Selective mass scaling: a little mass on the few nodes that limit the stable step, for presses that are quasi-static.

Usual in explicit dynamics (Olovsson et al. 2005). It changes no force at rest, only how fast the scaled nodes follow;
what was added stands in `OrganModel.added_mass`.
"""

import numpy as np

from msdm_core.errors import OrganError
from msdm_core.kernels import ContactLaw, OrganModel
from msdm_core.mesh import FloatArray
from msdm_core.stability import contact_node_stiffness, own_step, stable_dt, support_hold

# More than this share of the organ's mass is no longer a detail.
ADDED_SHARE_LIMIT = 0.1
# How exactly w^2 is found, and how often it is lowered by a tenth at most, beyond the first guess.
FREQUENCY_TOLERANCE = 2.0**-6
LOWERINGS = 20


def scale_mass(model: OrganModel, step: float, contact: ContactLaw | None = None) -> OrganModel:
    """The organ with mass added, where it must be, till a step [s] is stable; the organ itself where it is already.

    A node of stiffness k_i (the largest eigenvalue of its own 3 x 3 block of K, with contact) gets the mass
    max(m_i, k_i / w^2), with the largest w, found by bisection to 1 %, for which `stable_dt` reaches the step.

    Raises:
        OrganError: a step that is not above 0, an organ under gravity (what is added would weigh), or one that would
            need more than a tenth of its mass; says how much.
    """
    if not (np.isfinite(step) and step > 0.0):
        raise OrganError(f"step is {step} s; it must be finite and above 0")
    before = stable_dt(model, contact)
    if before >= step:
        return model
    if np.any(model.gravity != 0.0):
        raise OrganError(f"gravity is {model.gravity.tolist()}: added mass would weigh; scale no mass, or no gravity")
    stiffness = _node_stiffness(model, contact)
    free = model.node_inverse_mass > 0.0
    high = float((stiffness * model.node_inverse_mass).max())

    def bears(trial: OrganModel) -> bool:
        return (own_step(trial) if contact is None else stable_dt(trial, contact)) >= step

    def with_frequency(square: float) -> OrganModel:
        return _with_mass(model, np.where(free, np.maximum(model.node_mass, stiffness / square), model.node_mass))

    # A step grows as 1 / w at most: what this misses, and what the nodes' neighbours ask for, is found by halving.
    low, scaled = high * (before / step) ** 2, model
    for _ in range(LOWERINGS):
        trial = with_frequency(low)
        if bears(trial):
            scaled = trial
            break
        low, high = 0.9 * low, low
    while scaled is not model and high - low > FREQUENCY_TOLERANCE * high:
        middle = 0.5 * (low + high)
        trial = with_frequency(middle)
        if bears(trial):
            low, scaled = middle, trial
        else:
            high = middle
    share = scaled.added_mass / float(model.node_mass.sum())
    if scaled is model or share > ADDED_SHARE_LIMIT:
        raise OrganError(
            f"a stable step of {step * 1e3:.3g} ms instead of {before * 1e3:.3g} ms would add "
            f"{share:.0%} to the organ's mass; the rule is at most {ADDED_SHARE_LIMIT:.0%}: use more substeps, softer "
            "lesions or larger cells"
        )
    return scaled._replace(stable_step=own_step(scaled))


def _with_mass(model: OrganModel, mass: FloatArray) -> OrganModel:
    """The organ with other masses [kg] (n_node,); its stable step is left to the caller."""
    inverse = np.where(model.node_inverse_mass > 0.0, 1.0 / mass, 0.0)
    for array in (mass, inverse):
        array.setflags(write=False)
    added = float((mass - model.node_mass).sum()) + model.added_mass
    return model._replace(node_mass=mass, node_inverse_mass=inverse, added_mass=added)


def _node_stiffness(model: OrganModel, contact: ContactLaw | None) -> FloatArray:
    """Stiffness of each node while all others stand still, with contact and supports [N/m], shape (n_node,)."""
    block = np.zeros((len(model.node_mass), 3, 3))
    span = model.node_rest_position[model.spring_nodes]
    along = (span[:, 1] - span[:, 0]) / model.spring_rest_length[:, None]
    springs = model.spring_stiffness[:, None, None] * np.einsum("si,sj->sij", along, along)
    for end in range(2):
        np.add.at(block, model.spring_nodes[:, end], springs)
    corners = model.node_rest_position[model.tet_nodes]
    modulus = (model.tet_bulk + model.tet_averaged_bulk) * model.tet_inverse_volume
    for corner in range(4):
        p, q, r = (corners[:, (corner + turn) % 4] for turn in (1, 2, 3))
        gradient = np.cross(q - p, r - p) / 6.0
        np.add.at(
            block, model.tet_nodes[:, corner], modulus[:, None, None] * np.einsum("ti,tj->tij", gradient, gradient)
        )
    held = 0.0 if contact is None else contact_node_stiffness(model, contact)
    return np.linalg.eigvalsh(block)[:, -1].astype(np.float64) + held + support_hold(model)[0]
