"""Time integration of an organ: contact shapes of tools, symplectic Euler substeps, messages about faults."""

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.arithmetic import exp
from msdm_core.errors import OrganDivergedError, OrganError
from msdm_core.kernels.contact_kernels import QUADRATURE_COUNT
from msdm_core.kernels.structure_kernels import (
    FAULT_CONTACT_LOST,
    FAULT_INVERTED_TET,
    FAULT_NONE,
    ContactLaw,
    ContactShapes,
    OrganModel,
    OrganState,
    ToolResponse,
)
from msdm_core.kernels.substep_kernels import advance_substeps
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.measure import volume_ratios
from msdm_core.organ.stability import stable_dt


def round_shapes(
    ends: ArrayLike,
    radius: ArrayLike,
    *,
    span: ArrayLike | None = None,
    friction: ArrayLike = 1.0,
    tool: ArrayLike | None = None,
    centre: ArrayLike | None = None,
    twist: ArrayLike | None = None,
) -> ContactShapes:
    """Contact shapes, all points within a radius of a core: capsules, balls (equal ends), rounded boxes (with a span).

    Args:
        ends: of each core's axis [m], (n_shape, 2, 3).
        radius: [m], (n_shape,).
        span: from the axis to the border of a rounded box's core, normal to the axis [m], (n_shape, 3); default 0.
        friction: Coulomb coefficient over that of the contact law, (n_shape,) or a number for all.
        tool: index of each shape's tool, (n_shape,); default 0.
        centre: each tool's centre of mass [m], (n_tool, 3); default the middle of its first shape.
        twist: of each tool [m/s, rad/s], (n_tool, 6); default 0.
    """
    axes = np.array(ends, dtype=np.float64).reshape(-1, 2, 3)
    count = len(axes)
    carrier = np.zeros(count, dtype=np.int32) if tool is None else np.array(tool, dtype=np.int32)
    if centre is None:
        tools, first = np.unique(carrier, return_index=True)
        centre = axes[first].mean(axis=1).reshape(len(tools), 3)
    centres: FloatArray = np.array(centre, dtype=np.float64).reshape(-1, 3)
    return ContactShapes(
        shape_ends=axes,
        shape_radius=np.array(radius, dtype=np.float64).reshape(count),
        shape_tool=carrier,
        tool_centre=centres,
        tool_twist=np.zeros((len(centres), 6)) if twist is None else np.array(twist, dtype=np.float64).reshape(-1, 6),
        shape_span=np.zeros((count, 3)) if span is None else np.array(span, dtype=np.float64).reshape(count, 3),
        shape_friction=np.broadcast_to(np.asarray(friction, dtype=np.float64), (count,)).copy(),
        patch_layout=np.zeros((0, 4), dtype=np.int32),
        patch_frame=np.zeros((0, 3, 3)),
        taxel_force=np.zeros((0, 3)),
    )


NO_SHAPES = round_shapes(np.zeros((0, 2, 3)), np.zeros(0), centre=np.zeros((0, 3)))
NO_CONTACT = ContactLaw(stiffness=1.0, damping=0.0, friction=0.0, tangential_stiffness=1.0)


def advance(
    model: OrganModel,
    state: OrganState,
    *,
    dt: float,
    substep_count: int = 1,
    shapes: ContactShapes = NO_SHAPES,
    contact: ContactLaw = NO_CONTACT,
) -> FloatArray:
    """Advance an organ in place by `substep_count` symplectic Euler steps of dt [s]; shapes move along their twist.

    Returns:
        Mean wrench on each tool over the substeps, force [N] and torque [N m] about its centre of mass at the start,
        shape (n_tool, 6).

    Raises:
        OrganError: dt above the organ's stable step (with contact if there are shapes), a state of another organ,
            contact memory that does not fit the shapes.
        OrganDivergedError: an inverted tet (named, with its volume ratio) or a number that is not finite.
    """
    _check_state(model, state, len(shapes.shape_radius))
    limit = _contact_step(model, contact) if len(shapes.shape_radius) else model.stable_step
    if not 0.0 < dt <= limit:
        raise OrganError(
            f"dt is {dt:g} s; it must be above 0 and at most the stable step {limit:.4g} s (less with contact shapes): "
            "use more, shorter substeps"
        )
    return advance_or_raise(model, state, dt, substep_count, shapes, contact)


def advance_or_raise(
    model: OrganModel,
    state: OrganState,
    dt: float,
    substep_count: int,
    shapes: ContactShapes = NO_SHAPES,
    contact: ContactLaw = NO_CONTACT,
) -> FloatArray:
    """`advance` without the checks of its arguments.

    Raises:
        OrganDivergedError: a fault.
    """
    wrench = np.zeros((len(shapes.tool_centre), 6))
    fault = advance_organ(model, state, shapes, contact, dt, substep_count, wrench)
    if fault != FAULT_NONE:
        raise OrganDivergedError(describe_fault(model, state, fault))
    return wrench


def _check_state(model: OrganModel, state: OrganState, shape_count: int) -> None:
    # Kernels check no array's bounds.
    point_count = len(model.surface_triangles) * QUADRATURE_COUNT
    organ = (
        len(model.node_mass), point_count, len(model.support_nodes), len(model.support_kind),
        len(model.motion_node_shift),
    )  # fmt: skip
    memory = (state.contact_engaged.shape[1], *state.support_stretch.shape[:2], len(state.motion))
    if (len(state.node_position), *memory) != organ or shape_count > len(state.contact_engaged):
        raise OrganError(
            f"the state has {len(state.node_position)} nodes, memory of contact points, nodes on supports, supports "
            f"and motions {memory} and {len(state.contact_engaged)} shapes, the organ {organ[0]}, {organ[1:]} and "
            f"{shape_count}: make the state with rest_state(model, shape_count=...)"
        )


_contact_step_known: list[tuple[OrganModel, ContactLaw, float]] = []


def _contact_step(model: OrganModel, contact: ContactLaw) -> float:
    """`stable_dt` with contact, cached for the last organ: it takes as long as many steps."""
    for known, law, step in _contact_step_known:
        if known is model and law == contact:
            return step
    _contact_step_known[:] = [(model, contact, stable_dt(model, contact))]
    return _contact_step_known[0][2]


def advance_organ(
    model: OrganModel,
    state: OrganState,
    shapes: ContactShapes,
    contact: ContactLaw,
    dt: float,
    substep_count: int,
    wrench: FloatArray,
    response: ToolResponse | None = None,
) -> int:
    """`advance` without its checks, for loops: fills `wrench`, returns a FAULT_ code.

    With a `response` the force of the tissue changes `shapes.tool_twist` within the call.
    """
    decay = float(exp(-model.alpha * dt))
    reference = shapes.tool_centre.copy()
    if response is None:
        response = unyielding(len(reference))
    return advance_substeps(model, state, shapes, contact, response, dt, decay, substep_count, reference, wrench)


def unyielding(tool_count: int) -> ToolResponse:
    """Response of tools with a prescribed twist: no force of the tissue changes it."""
    return ToolResponse(*(np.zeros((tool_count, *shape)) for shape in ((6,), (tool_count, 6, 6), (6,), (6,))))


def describe_fault(model: OrganModel, state: OrganState, fault: int) -> str:
    """Message for a FAULT_ code, with the place of the fault."""
    bad = np.flatnonzero(~np.isfinite(state.node_position).all(axis=1) | ~np.isfinite(state.node_velocity).all(axis=1))
    if fault == FAULT_INVERTED_TET and not bad.size:
        ratios = volume_ratios(model, state)
        tet = int(np.argmin(ratios))
        return (
            f"tet {tet} turned inside out: volume ratio {ratios[tet]:.3g}, it must stay above 0: press less deep, use "
            "more substeps, smaller cells or a higher Poisson's ratio"
        )
    if fault == FAULT_CONTACT_LOST:
        shape, triangle = state.contact_passed.tolist()
        return (
            f"contact lost: contact shape {shape} passed through surface triangle {triangle}: press less deep or more "
            "slowly, use smaller cells or a larger shape"
        )
    return f"node {int(bad[0]) if bad.size else 0} is no longer finite: the step is too long for the forces at work"
