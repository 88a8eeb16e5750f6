"""The largest stable step of an organ, and the mass that makes a longer one stable.

The step follows from springs, volume term, damping, supports and contact together.
"""

import math
from bisect import bisect_left
from collections.abc import Callable

import numpy as np

from msdm_core.arithmetic import ANGLE_MOST, dot, eigh, exp, matmul, norm, power, sin
from msdm_core.errors import OrganError
from msdm_core.kernels.contact_kernels import SWEEPS
from msdm_core.kernels.element_kernels import STEEP_EXCESS
from msdm_core.kernels.linear_kernels import multiply_stiffness
from msdm_core.kernels.squeeze_kernels import SWEEPS_LEAST, SWEEPS_PER_TANGENT
from msdm_core.kernels.structure_kernels import ContactLaw, OrganModel
from msdm_core.mesh.tet_mesh import FloatArray

# Relative accuracy of the largest eigenvalue: 1 % of the step. Lanczos converges from below, so it is added back.
EIGENVALUE_TOLERANCE = 0.02
# Vectors of the Lanczos basis, and those that a restart keeps.
LANCZOS_VECTORS, LANCZOS_KEPT = 12, 6
RESTARTS_MOST = 1000
# What stiffening adds to the tangent is integrated implicitly, by so many sweeps at most; larger tangents than these
# hold shorten the step.
SWEEPS_MOST = 12
HELD_TANGENT = SWEEPS_MOST / SWEEPS_PER_TANGENT
# A step is found to this part of its upper bound.
ROOT_PARTS = 2**40


def apply_stiffness(
    model: OrganModel, displacement: FloatArray, force: FloatArray, spring_stiffness: FloatArray | None = None
) -> None:
    """Fill `force` with the linearised forces at rest, K u [N], of a displacement u [m]; both (n_node, 3).

    K is that of the tissue and of its foundations.

    The springs have the stiffness of the model, in equilibrium, or the one given [N/m], (n_spring,).
    """
    stiffness = model.spring_stiffness if spring_stiffness is None else spring_stiffness
    multiply_stiffness(
        model.node_rest_position, model.spring_nodes, stiffness, model.tet_nodes, model.tet_rest_volume,
        model.tet_bulk, model.node_rest_volume, model.node_bulk, displacement, np.empty(len(model.node_mass)), force,
    )  # fmt: skip
    held = model.foundation_nodes
    if len(held):
        force[held] += dot(model.foundation_stiffness, displacement[held][:, None])


def explicit_stiffness(model: OrganModel) -> FloatArray:
    """Largest tangent of each spring that the step must bear, Maxwell arms included [N/m], shape (n_spring,).

    What stiffening adds beyond STEEP_EXCESS is integrated implicitly (`squeeze_kernels.hold_steep`), which holds a
    tangent of up to HELD_TANGENT times that at rest; a larger cap c counts as c / HELD_TANGENT, so that the step is
    shorter by its root.
    """
    stiffness = model.spring_stiffness
    if model.stiffens:
        rise = (model.node_excess * model.node_growth)[model.spring_nodes].mean(axis=1)
        stiffness = stiffness * (1.0 + np.minimum(rise, STEEP_EXCESS)) * np.maximum((1.0 + rise) / HELD_TANGENT, 1.0)
    return stiffness * model.spring_gain if model.relaxes else stiffness


def steep_sweeps(tangent_cap: float) -> int:
    """Sweeps of `squeeze_kernels.hold_steep` that hold springs up to a tangent over that at rest; an even number."""
    wanted = 2 * math.ceil(0.5 * SWEEPS_PER_TANGENT * tangent_cap)
    return min(max(wanted, SWEEPS_LEAST), SWEEPS_MOST)


def largest_frequency(model: OrganModel, node_stiffness: FloatArray | None = None) -> float:
    """Largest angular frequency at rest, w_max = sqrt(lambda_max(M^-1 (K + diag))) [rad/s] (Lanczos, fixed start).

    K has the springs' `explicit_stiffness`.

    Args:
        model: the organ.
        node_stiffness: stiffness that holds each node, such as contact's [N/m], shape (n_node,).
    """
    shape = model.node_rest_position.shape
    scale = np.sqrt(model.node_inverse_mass)[:, None]
    held = np.zeros((shape[0], 1)) if node_stiffness is None else node_stiffness[:, None]
    force, springs = np.empty(shape), explicit_stiffness(model)

    def apply(vector: FloatArray) -> FloatArray:
        displacement = scale * vector.reshape(shape)
        apply_stiffness(model, displacement, force, springs)
        return (scale * (force + held * displacement)).ravel()

    count = 3 * shape[0]
    if not model.node_inverse_mass.any():
        return 0.0
    if count < 60:
        matrix = np.column_stack([apply(column) for column in np.eye(count)])
        return math.sqrt(max(float(eigh(0.5 * (matrix + matrix.T))[0][-1]), 0.0))
    # A fixed start without symmetry: the same organ gives the same step, to the bit. Of more than 48 000 nodes some
    # angles are beyond those that `sin` takes.
    start = sin(np.fmod(1.0 + 1.7 * power(np.arange(count), 1.1), ANGLE_MOST))
    return math.sqrt(_largest_eigenvalue(apply, start) * (1.0 + EIGENVALUE_TOLERANCE))


def _largest_eigenvalue(apply: Callable[[FloatArray], FloatArray], start: FloatArray) -> float:
    """Largest eigenvalue of a symmetric operator on vectors (n,), from below, to EIGENVALUE_TOLERANCE.

    Lanczos' method with full orthogonalisation, restarted from the best Ritz vectors (Wu and Simon 2000); ARPACK
    (Lehoucq et al. 1998) searches the same subspaces, but by sums whose order depends on the processor.
    """
    basis = np.zeros((LANCZOS_VECTORS + 1, len(start)))
    projected = np.zeros((LANCZOS_VECTORS, LANCZOS_VECTORS))
    begin = apply(start)
    basis[0], first, rest = begin / norm(begin), 0, 0.0
    for _ in range(RESTARTS_MOST):
        for last in range(first, LANCZOS_VECTORS):
            pushed = apply(basis[last])
            known = basis[: last + 1]
            for _ in range(2):
                share = dot(known, pushed)
                projected[last, last] += share[last]
                pushed = pushed - matmul(share, known)
            rest = float(norm(pushed))
            if rest == 0.0:
                return float(eigh(projected[: last + 1, : last + 1])[0][-1])
            basis[last + 1] = pushed / rest
            if last + 1 < LANCZOS_VECTORS:
                projected[last, last + 1] = projected[last + 1, last] = rest
        values, vectors = eigh(projected)
        left = rest * vectors[-1, -LANCZOS_KEPT:]
        if abs(left[-1]) <= EIGENVALUE_TOLERANCE * abs(values[-1]):
            return float(values[-1])
        first = LANCZOS_KEPT
        basis[:first] = matmul(vectors[:, -first:].T, basis[:-1])
        basis[first] = basis[-1]
        projected[:] = 0.0
        projected[range(first), range(first)] = values[-first:]
        projected[first, :first] = projected[:first, first] = left
    raise OrganError(
        f"the largest frequency of the organ was not found in {RESTARTS_MOST} restarts of Lanczos' method: are masses "
        "and stiffnesses finite?"
    )


def contact_node_area(model: OrganModel) -> FloatArray:
    """Surface area that belongs to each node, a third of each triangle around it [m^2], shape (n_node,)."""
    thirds = np.repeat(model.surface_rest_area / 3.0, 3)
    return np.bincount(model.surface_triangles.ravel(), thirds, len(model.node_mass)).astype(np.float64)


def contact_hold(model: OrganModel, contact: ContactLaw, dt: float) -> tuple[float, float]:
    """Most that contact holds a node with in a substep over its mass, and the share of it that is stiffness.

    h = dt max(k_p dt + c_p, k_t dt) A / m, where A is a third of the area of each triangle around the node and k_t
    counts where there is friction. Faces that meet in an edge or a corner count together, whatever their directions.
    """
    across = contact.tangential_stiffness if contact.friction > 0.0 else 0.0
    held = max(contact.stiffness * dt + contact.damping, across * dt)
    share = max(contact.stiffness, across) * dt / held if held > 0.0 else 0.0
    return dt * held * float((contact_node_area(model) * model.node_inverse_mass).max()), share


def contact_excess(hold: float, share: float = 1.0) -> float:
    """What implicit contact leaves of a hold h for the step to bear, of a limit of 4; 0 for h up to 7.

    A motion that contact holds with k <= h (over its mass, times dt^2, as all here) gets its stiffness, a share of k,
    as it is at the start of the substep; the sweeps of `contact_kernels.hold_contact` then leave v (1 + k R) / (1 + k)
    of a velocity v, where R = prod (1 - w_j (1 + k) / (1 + h)) over the factors w_j of the sweeps. That is a mass of
    Q = (1 + k) / (1 + k R), with which symplectic Euler is stable where this stiffness and what the organ itself holds
    with, t, are share k + t <= 2 (1 + Q). So t must stay below 4 less the largest share k - 2 (Q - 1). Damping alone
    (share 0) asks for nothing.
    """
    held = hold * np.linspace(0.0, 1.0, 1001)
    left = np.prod([1.0 - factor * (1.0 + held) / (1.0 + hold) for factor in SWEEPS], axis=0)
    return max(0.0, float((share * held - 2.0 * ((1.0 + held) / (1.0 + held * left) - 1.0)).max()))


def step_limit(omega: float, alpha: float, beta: float, drag_rate: float = 0.0) -> float:
    """Stable step of symplectic Euler for one mode, v' = e^(-alpha dt) v - dt (w^2 x + (beta w^2 + drag) v) [s].

    The characteristic polynomial leaves the unit circle at z = -1, where
    2 (1 + e^(-alpha dt)) = 2 dt (beta w^2 + drag) + w^2 dt^2; without damping this is dt = 2 / w.
    """
    if omega == 0.0 and drag_rate == 0.0:
        return math.inf
    rate = beta * omega * omega + drag_rate

    def margin(dt: float) -> float:
        return 2.0 * (1.0 + float(exp(-alpha * dt))) - 2.0 * dt * rate - (omega * dt) * (omega * dt)

    ceiling = 2.0 / omega if omega > 0.0 else 2.0 / rate
    return _root_below(ceiling, margin)


def stable_dt(model: OrganModel, contact: ContactLaw | None = None) -> float:
    """Largest stable step [s]: springs, volume term, alpha, beta, supports, and contact of instruments if given.

    Supports hold and drag each node with `support_hold`. Contact is implicit, with its damping and its friction: it
    costs no more than `contact_excess` of `contact_hold`. The step is stable where what the organ takes of the limit,
    at most (dt / stable_step)^n of it (n = 2, with beta or damped supports 1), and this excess together stay below
    2 (1 + e^(-alpha dt)). The guard of the shapes' axes is implicit and counts nothing; beta damps the organ alone.
    The organ is linearised at rest: stretched by 20 % it bears 0.92 to 0.96 of this step.
    """
    own = model.stable_step
    if contact is None or not math.isfinite(own) or not np.any(model.node_inverse_mass):
        return own
    damped = model.beta > 0.0 or (len(model.support_kind) > 0 and model.support_damping > 0.0)

    def limit(dt: float) -> float:
        return 2.0 * (1.0 + float(exp(-model.alpha * dt)))

    def margin(dt: float) -> float:
        share = dt / own if damped else (dt / own) * (dt / own)
        return limit(dt) - limit(own) * share - contact_excess(*contact_hold(model, contact, dt))

    return _root_below(own, margin)


def _root_below(ceiling: float, margin: Callable[[float], float]) -> float:
    """The largest step [s] without a negative margin, which falls with the step: `ceiling`, or just below the root."""
    if margin(ceiling) >= 0.0:
        return ceiling
    # scipy.optimize would take a fifth of a second to import, a sixth of the time to the first step.
    last = bisect_left(range(1, ROOT_PARTS), True, key=lambda part: margin(ceiling * part / ROOT_PARTS) < 0.0)
    return ceiling * last / ROOT_PARTS


def own_step(model: OrganModel) -> float:
    """Largest stable step without instruments [s]: springs, volume term, alpha, beta, supports and foundations."""
    if not len(model.support_kind):
        return step_limit(largest_frequency(model), model.alpha, model.beta)
    return _held_step(model, *support_hold(model))


def support_hold(model: OrganModel) -> tuple[FloatArray, FloatArray]:
    """The most that supports can hold each node with in any direction [N/m] and drag it with [N s/m], (n_node,) each.

    One support holds a node of area A with k_p A along its normal and less across it; all of them may meet in it.
    """
    area = np.zeros(len(model.node_mass))
    area[model.support_nodes] = len(model.support_kind) * model.support_area
    return max(model.support_stiffness, model.support_tangential_stiffness) * area, model.support_damping * area


def _held_step(model: OrganModel, held: FloatArray, drag: FloatArray) -> float:
    """Stable step [s] with what holds each node [N/m] and drags it [N s/m], shape (n_node,) each."""
    most_drag = float((drag * model.node_inverse_mass).max())
    dt = step_limit(largest_frequency(model, held), model.alpha, model.beta, most_drag)
    if (not drag.any() and model.beta == 0.0) or not math.isfinite(dt):
        return dt
    # From below: damping counts as stiffer, the shorter the step. With beta the first guess is far off.
    for _ in range(1 if model.beta == 0.0 else 3):
        organ = 1.0 + 2.0 * model.beta / dt
        omega = math.sqrt(organ) * largest_frequency(model, (held + 2.0 * drag / dt) / organ)
        dt = max(dt, step_limit(omega, model.alpha, 0.0))
    return dt


# ---- mass scaling -------------------------------------------------------------------------------------------------

# Largest share of the organ's mass that may be added.
ADDED_SHARE_LIMIT = 0.1
# Relative accuracy of w^2 in the bisection, and the most steps of a tenth by which the first guess is lowered.
FREQUENCY_TOLERANCE = 2.0**-6
LOWERINGS = 20


def scale_mass(model: OrganModel, step: float, contact: ContactLaw | None = None) -> OrganModel:
    """The organ with mass added to those nodes that limit the step, so that `step` [s] is stable; itself if it is.

    A node of stiffness k_i (the largest eigenvalue of its own 3 x 3 block of K) gets the mass
    max(m_i, k_i / w^2), with the largest w, found by bisection to 1 %, for which `stable_dt` reaches the step.

    Raises:
        OrganError: an organ under gravity (the added mass would have weight), or one that needs more than a tenth of
            its mass; says how much.
    """
    before = stable_dt(model, contact)
    if before >= step:
        return model
    if np.any(model.gravity != 0.0):
        raise OrganError(
            f"gravity is {model.gravity.tolist()}: added mass would have weight: leave out mass scaling or gravity"
        )
    stiffness = _node_stiffness(model)
    free = model.node_inverse_mass > 0.0
    high = float((stiffness * model.node_inverse_mass).max())

    def is_stable(trial: OrganModel) -> bool:
        return stable_dt(trial, contact) >= step

    def with_frequency(square: float) -> OrganModel:
        return _with_mass(model, np.where(free, np.maximum(model.node_mass, stiffness / square), model.node_mass))

    # The step grows as 1 / w at most: the first guess. Neighbouring nodes may make a lower w necessary.
    low, scaled = high * (before / step) * (before / step), model
    for _ in range(LOWERINGS):
        trial = with_frequency(low)
        if is_stable(trial):
            scaled = trial
            break
        low, high = 0.9 * low, low
    while scaled is not model and high - low > FREQUENCY_TOLERANCE * high:
        middle = 0.5 * (low + high)
        trial = with_frequency(middle)
        if is_stable(trial):
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
    return scaled


def _with_mass(model: OrganModel, mass: FloatArray) -> OrganModel:
    """The organ with other masses [kg] (n_node,)."""
    inverse = np.where(model.node_inverse_mass > 0.0, 1.0 / mass, 0.0)
    for array in (mass, inverse):
        array.setflags(write=False)
    added = float((mass - model.node_mass).sum()) + model.added_mass
    heavier = model._replace(node_mass=mass, node_inverse_mass=inverse, added_mass=added)
    return heavier._replace(stable_step=own_step(heavier))


def _node_stiffness(model: OrganModel) -> FloatArray:
    """Stiffness of each node while all others are fixed, with what holds it [N/m], shape (n_node,)."""
    block = np.zeros((len(model.node_mass), 3, 3))
    span = model.node_rest_position[model.spring_nodes]
    along = (span[:, 1] - span[:, 0]) / model.spring_rest_length[:, None]
    springs = explicit_stiffness(model)[:, None, None] * along[:, :, None] * along[:, None, :]
    for end in range(2):
        np.add.at(block, model.spring_nodes[:, end], springs)
    corners = model.node_rest_position[model.tet_nodes]
    modulus = (model.tet_bulk + model.tet_averaged_bulk) * model.tet_inverse_volume
    for corner in range(4):
        p, q, r = (corners[:, (corner + turn) % 4] for turn in (1, 2, 3))
        gradient = np.cross(q - p, r - p) / 6.0
        np.add.at(
            block, model.tet_nodes[:, corner], modulus[:, None, None] * gradient[:, :, None] * gradient[:, None, :]
        )
    block[model.foundation_nodes] += model.foundation_stiffness
    return eigh(block)[0][:, -1] + support_hold(model)[0]
