"""Stable step of an organ, from springs, volume term, damping, supports and contact; mass scaling for a longer step."""

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
from msdm_core.organ.measure import element_means, element_stiffness

# Relative accuracy of the largest eigenvalue: 1 % of the step. Lanczos converges from below, so it is added back.
EIGENVALUE_TOLERANCE = 0.02
# Vectors of the Lanczos basis, and of them after a restart.
LANCZOS_VECTORS, LANCZOS_KEPT = 12, 6
RESTARTS_MOST = 1000
# Largest number of sweeps of the implicit integration of stiffening, and the tangent up to which they suffice; a larger
# tangent shortens the step.
SWEEPS_MOST = 12
HELD_TANGENT = SWEEPS_MOST / SWEEPS_PER_TANGENT
# Resolution of the stable step, as a share of its upper bound.
ROOT_PARTS = 2**40


def apply_stiffness(model: OrganModel, displacement: FloatArray, force: FloatArray) -> None:
    """Fill `force` with forces K u [N] of tissue and foundations, linearised at rest, of u [m]; both (n_node, 3)."""
    multiply_stiffness(
        model.node_rest_position, model.spring_nodes, model.spring_stiffness, model.tet_nodes, model.tet_rest_volume,
        model.tet_bulk, model.node_rest_volume, model.node_bulk, displacement, np.empty(len(model.node_mass)), force,
    )  # fmt: skip
    held = model.foundation_nodes
    if len(held):
        force[held] += dot(model.foundation_stiffness, displacement[held][:, None])


def explicit_tissue(model: OrganModel) -> OrganModel:
    """The organ with its largest explicitly integrated tangents as moduli, Maxwell arms included.

    The rise beyond STEEP_EXCESS is integrated implicitly (`squeeze_kernels.hold_steep`), up to HELD_TANGENT times the
    tangent at rest; a larger cap c counts as c / HELD_TANGENT, so that the step is shorter by its root.
    """
    if not (model.stiffens or model.relaxes):
        return model
    springs, tets = len(model.spring_nodes), len(model.tet_nodes)
    factor = model.element_gain if model.relaxes else np.ones(springs + tets + len(model.node_mass))
    if model.stiffens:
        rise = element_means(model, model.node_excess * model.node_growth)
        factor = factor * (1.0 + np.minimum(rise, STEEP_EXCESS))
        factor[:springs] *= np.maximum((1.0 + rise[:springs]) / HELD_TANGENT, 1.0)
    stiffness, bulk, node_bulk = np.split(factor * element_stiffness(model), [springs, springs + tets])
    return model._replace(spring_stiffness=stiffness, tet_bulk=bulk, node_bulk=node_bulk)


def steep_sweeps(tangent_cap: float) -> int:
    """Even number of sweeps of `squeeze_kernels.hold_steep` for springs up to a tangent over that at rest."""
    return min(max(2 * math.ceil(0.5 * SWEEPS_PER_TANGENT * tangent_cap), SWEEPS_LEAST), SWEEPS_MOST)


def largest_frequency(model: OrganModel, node_stiffness: FloatArray | None = None) -> float:
    """Largest angular frequency at rest, w_max = sqrt(lambda_max(M^-1 (K + diag))) [rad/s] (Lanczos, fixed start).

    K is that of `explicit_tissue`.

    Args:
        model: the organ.
        node_stiffness: of each node against the ground, for instance by contact [N/m], shape (n_node,).
    """
    shape = model.node_rest_position.shape
    scale = np.sqrt(model.node_inverse_mass)[:, None]
    held = np.zeros((shape[0], 1)) if node_stiffness is None else node_stiffness[:, None]
    force, explicit = np.empty(shape), explicit_tissue(model)

    def apply(vector: FloatArray) -> FloatArray:
        displacement = scale * vector.reshape(shape)
        apply_stiffness(explicit, displacement, force)
        return (scale * (force + held * displacement)).ravel()

    count = 3 * shape[0]
    if not model.node_inverse_mass.any():
        return 0.0
    if count < 60:
        matrix = np.column_stack([apply(column) for column in np.eye(count)])
        return math.sqrt(max(float(eigh(0.5 * (matrix + matrix.T))[0][-1]), 0.0))
    # A fixed start without symmetry: the same organ gives the same step, to the bit. With more than 48 000 nodes some
    # angles exceed the range of `sin`.
    start = sin(np.fmod(1.0 + 1.7 * power(np.arange(count), 1.1), ANGLE_MOST))
    return math.sqrt(_largest_eigenvalue(apply, start) * (1.0 + EIGENVALUE_TOLERANCE))


def _largest_eigenvalue(apply: Callable[[FloatArray], FloatArray], start: FloatArray) -> float:
    """Largest eigenvalue of a symmetric operator on vectors (n,), from below, to EIGENVALUE_TOLERANCE.

    Lanczos' method with full orthogonalisation, restarted from the best Ritz vectors (Wu and Simon 2000); ARPACK
    (Lehoucq et al. 1998) searches the same subspaces, but by sums whose order depends on the processor.
    """
    basis = np.zeros((LANCZOS_VECTORS + 1, len(start)))
    projected = np.zeros((LANCZOS_VECTORS, LANCZOS_VECTORS))
    image = apply(start)
    basis[0], first, residual = image / norm(image), 0, 0.0
    for _ in range(RESTARTS_MOST):
        for last in range(first, LANCZOS_VECTORS):
            image = apply(basis[last])
            span = basis[: last + 1]
            for _ in range(2):
                share = dot(span, image)
                projected[last, last] += share[last]
                image = image - matmul(share, span)
            residual = float(norm(image))
            if residual == 0.0:
                return float(eigh(projected[: last + 1, : last + 1])[0][-1])
            basis[last + 1] = image / residual
            if last + 1 < LANCZOS_VECTORS:
                projected[last, last + 1] = projected[last + 1, last] = residual
        values, vectors = eigh(projected)
        errors = residual * vectors[-1, -LANCZOS_KEPT:]
        if abs(errors[-1]) <= EIGENVALUE_TOLERANCE * abs(values[-1]):
            return float(values[-1])
        first = LANCZOS_KEPT
        basis[:first] = matmul(vectors[:, -first:].T, basis[:-1])
        basis[first] = basis[-1]
        projected[:] = 0.0
        projected[range(first), range(first)] = values[-first:]
        projected[first, :first] = projected[:first, first] = errors
    raise OrganError(
        f"Lanczos' method did not converge to the largest frequency of the organ in {RESTARTS_MOST} restarts: are "
        "masses and stiffnesses finite?"
    )


def contact_node_area(model: OrganModel) -> FloatArray:
    """Surface area of each node, a third of each triangle around it [m^2], shape (n_node,)."""
    thirds = np.repeat(model.surface_rest_area / 3.0, 3)
    return np.bincount(model.surface_triangles.ravel(), thirds, len(model.node_mass)).astype(np.float64)


def contact_hold(model: OrganModel, contact: ContactLaw, dt: float) -> tuple[float, float]:
    """Largest hold h of a node by contact, and the share of stiffness in it.

    h = dt max(k_p dt + c_p, k_t dt) A / m, with A a third of the area of each triangle around the node and k_t = 0
    without friction. Faces at a common edge or corner add up, independent of their directions.
    """
    across = contact.tangential_stiffness if contact.friction > 0.0 else 0.0
    held = max(contact.stiffness * dt + contact.damping, across * dt)
    share = max(contact.stiffness, across) * dt / held if held > 0.0 else 0.0
    return dt * held * float((contact_node_area(model) * model.node_inverse_mass).max()), share


def contact_excess(hold: float, share: float = 1.0) -> float:
    """Part of the hold h of implicit contact that still limits the explicit step, of the limit 4; 0 for h <= 16.

    Stiffness is over mass and times dt^2 here. A motion with the hold k <= h gets the force of its stiffness, a share
    of k, at the start of the substep; the sweeps of `contact_kernels.hold_contact` then leave v (1 + k R) / (1 + k) of
    a velocity v, with R = prod (1 - w_j (1 + k) / (1 + h)) over the factors w_j of the sweeps. This acts as a mass of
    Q = (1 + k) / (1 + k R): symplectic Euler is stable for share k + t <= 2 (1 + Q), with t the stiffness of the organ
    itself. So t must stay below 4 less the largest share k - 2 (Q - 1). Pure damping (share 0) leaves 0.
    Infinite where the sweeps overshoot, 1 + k R <= 0.
    """
    held = hold * np.linspace(0.0, 1.0, 1001)
    left = np.prod([1.0 - factor * (1.0 + held) / (1.0 + hold) for factor in SWEEPS], axis=0)
    slowed = 1.0 + held * left
    if not (slowed > 0.0).all():
        return math.inf
    return max(0.0, float((share * held - 2.0 * ((1.0 + held) / slowed - 1.0)).max()))


def step_limit(omega: float, alpha: float, beta: float, drag_rate: float = 0.0) -> float:
    """Stable step of symplectic Euler for one mode, v' = e^(-alpha dt) v - dt (w^2 x + (beta w^2 + drag) v) [s].

    A root of the characteristic polynomial leaves the unit circle at z = -1:
    2 (1 + e^(-alpha dt)) = 2 dt (beta w^2 + drag) + w^2 dt^2; without damping dt = 2 / w.
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

    Supports hold and drag each node with `support_hold`. Contact is implicit, with its damping and its friction, and
    takes `contact_excess` of the limit 2 (1 + e^(-alpha dt)) at most; the organ takes at most (dt / stable_step)^n of
    it (n = 2, with beta or damped supports 1). The implicit guard of the shapes' axes takes nothing; beta damps the
    organ alone. The organ is linearised at rest. Contact is that of tips: under a plate the rise of edges counts twice,
    and above a hold of 16 (`contact_hold`) its step is shorter.
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
    """Largest step [s] without a negative margin (falling with the step): `ceiling`, or just below the root."""
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
    """Largest stiffness [N/m] and drag [N s/m] of supports on each node in any direction, (n_node,) each.

    A support holds a node of area A with k_p A along its normal and less across it; all of them may touch it.
    """
    area = np.zeros(len(model.node_mass))
    area[model.support_nodes] = len(model.support_kind) * model.support_area
    return max(model.support_stiffness, model.support_tangential_stiffness) * area, model.support_damping * area


def _held_step(model: OrganModel, held: FloatArray, drag: FloatArray) -> float:
    """Stable step [s] with a stiffness [N/m] and drag [N s/m] on each node, shape (n_node,) each."""
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

# Largest added mass, as a share of the organ's.
ADDED_SHARE_LIMIT = 0.15
# Relative accuracy of w^2 in the bisection; largest number of reductions of the first guess by a tenth.
FREQUENCY_TOLERANCE = 2.0**-6
LOWERINGS = 20


def scale_mass(model: OrganModel, step: float, contact: ContactLaw | None = None) -> OrganModel:
    """The organ with mass added to the nodes that limit the step, so that `step` [s] is stable; itself if it is.

    A node of stiffness k_i (the largest eigenvalue of its own 3 x 3 block of K) gets the mass max(m_i, k_i / w^2), with
    w by bisection to 1 % the largest for a `stable_dt` of at least the step.

    Raises:
        OrganError: an organ under gravity (the added mass would have weight), or more added mass than
            ADDED_SHARE_LIMIT of the organ's; names the share.
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

    def with_frequency(square: float) -> OrganModel:
        return _with_mass(model, np.where(free, np.maximum(model.node_mass, stiffness / square), model.node_mass))

    # The step grows as 1 / w at most: the first guess. Neighbouring nodes may make a lower w necessary.
    low, scaled = high * (before / step) * (before / step), model
    for _ in range(LOWERINGS):
        trial = with_frequency(low)
        if stable_dt(trial, contact) >= step:
            scaled = trial
            break
        low, high = 0.9 * low, low
    while scaled is not model and high - low > FREQUENCY_TOLERANCE * high:
        middle = 0.5 * (low + high)
        trial = with_frequency(middle)
        if stable_dt(trial, contact) >= step:
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
    """Stiffness of each node with all others fixed, supports and foundations included [N/m], shape (n_node,)."""
    block = np.zeros((len(model.node_mass), 3, 3))
    span = model.node_rest_position[model.spring_nodes]
    along = (span[:, 1] - span[:, 0]) / model.spring_rest_length[:, None]
    explicit = explicit_tissue(model)
    springs = explicit.spring_stiffness[:, None, None] * along[:, :, None] * along[:, None, :]
    for end in range(2):
        np.add.at(block, model.spring_nodes[:, end], springs)
    corners = model.node_rest_position[model.tet_nodes]
    averaged = model.tet_barrier_bulk - model.tet_bulk
    modulus = (explicit.tet_bulk + averaged) * model.tet_inverse_volume
    for corner in range(4):
        p, q, r = (corners[:, (corner + turn) % 4] for turn in (1, 2, 3))
        gradient = np.cross(q - p, r - p) / 6.0
        np.add.at(
            block, model.tet_nodes[:, corner], modulus[:, None, None] * gradient[:, :, None] * gradient[:, None, :]
        )
    block[model.foundation_nodes] += model.foundation_stiffness
    return eigh(block)[0][:, -1] + support_hold(model)[0]
