"""One organ in time: the structures of model and state, and the compiled loop over substeps.

Compiled code stands in the files `*kernels.py` and in `vector.py`; `numba_cache.kernel_cache` sees when one of them
changes. Arrays of `OrganModel` are read-only, which numba holds at compile time. Kernels work in place, allocate
nothing and use no fastmath: a run repeats to the bit.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from msdm_core.contact_kernels import add_contact_forces, find_candidates, stretch_by_lag
from msdm_core.guard_kernels import guard_axes
from msdm_core.squeeze_kernels import hold_squeezed
from msdm_core.support_kernels import add_support_forces
from msdm_core.tissue_kernels import (
    GROUP,
    add_spring_damping,
    add_spring_forces,
    add_tet_forces,
    add_volume_damping,
    add_volume_rates,
    integrate,
    set_gravity,
    set_node_tension,
    sum_volumes,
)

FloatArray = NDArray[np.float64]

FAULT_NONE = 0
FAULT_INVERTED_TET = 1
FAULT_NOT_FINITE = 2
FAULT_CONTACT_LOST = 3


class OrganModel(NamedTuple):
    """What an organ is: read-only arrays, SI units.

    Fields:
        node_rest_position: undeformed position [m]                              (n_node, 3)
        node_mass: lumped mass [kg]                                              (n_node,)
        node_inverse_mass: 1 / mass [1/kg], 0 where the node is anchored         (n_node,)
        spring_nodes: the two nodes of each spring; spring t is tet t's first edge (n_spring, 2)
        spring_stiffness: [N/m]                                                  (n_spring,)
        spring_rest_length: [m]                                                  (n_spring,)
        tet_nodes: corners of each tet                                           (n_tet, 4)
        tet_rest_volume: [m^3]                                                   (n_tet,)
        tet_inverse_volume: 1 / rest volume [1/m^3]                              (n_tet,)
        tet_bulk: modulus of the volume term of each tet [Pa]                    (n_tet,)
        tet_averaged_bulk: what a tet gives to the averaged volume term [Pa]     (n_tet,)
        node_rest_volume: volume averaged at a node, a quarter of its tets [m^3] (n_node,)
        node_inverse_volume: 1 / that [1/m^3]                                    (n_node,)
        node_bulk: modulus of the volume term averaged at nodes [Pa]             (n_node,)
        averages_volume: whether any node_bulk is above 0                        scalar
        surface_triangles: outer triangles an instrument may touch, outward      (n_surface, 3)
        surface_rest_area: [m^2]                                                 (n_surface,)
        support_kind: what the organ rests on, a kind of `support_kernels`       (n_support,)
        support_position: its middle or a plane's point [m]                      (n_support, 3)
        support_rotation: its axes in the world, one a column                    (n_support, 3, 3)
        support_size: radius, half length, half sizes [m]                        (n_support, 3)
        support_friction: Coulomb coefficient                                    (n_support,)
        support_nodes: nodes that supports may hold: free ones of the surface    (n_support_node,)
        support_area: surface area that belongs to each of them [m^2]            (n_support_node,)
        support_stiffness: pressure per penetration [N/m^3]                      scalar
        support_damping: pressure per closing speed [N s/m^3]                    scalar
        support_tangential_stiffness: traction per stretch while sticking [N/m^3] scalar
        gravity: [m/s^2]                                                         (3,)
        alpha: mass-proportional damping rate [1/s]                              scalar
        beta: stiffness-proportional damping time [s]                            scalar
        stable_step: largest stable step without contact of instruments [s]      scalar
        added_mass: how much of node_mass `mass_scaling.scale_mass` added [kg]   scalar
    """

    node_rest_position: FloatArray
    node_mass: FloatArray
    node_inverse_mass: FloatArray
    spring_nodes: NDArray[np.int32]
    spring_stiffness: FloatArray
    spring_rest_length: FloatArray
    tet_nodes: NDArray[np.int32]
    tet_rest_volume: FloatArray
    tet_inverse_volume: FloatArray
    tet_bulk: FloatArray
    tet_averaged_bulk: FloatArray
    node_rest_volume: FloatArray
    node_inverse_volume: FloatArray
    node_bulk: FloatArray
    averages_volume: bool
    surface_triangles: NDArray[np.int32]
    surface_rest_area: FloatArray
    support_kind: NDArray[np.int32]
    support_position: FloatArray
    support_rotation: FloatArray
    support_size: FloatArray
    support_friction: FloatArray
    support_nodes: NDArray[np.int32]
    support_area: FloatArray
    support_stiffness: float
    support_damping: float
    support_tangential_stiffness: float
    gravity: FloatArray
    alpha: float
    beta: float
    stable_step: float
    added_mass: float


class OrganState(NamedTuple):
    """What changes while an organ moves, SI units; all but SCRATCH_FIELDS is saved and restored.

    Fields:
        node_position: [m]                                                       (n_node, 3)
        node_velocity: [m/s]                                                     (n_node, 3)
        node_force: force of the last substep, without anchors' reactions [N]    (n_node, 3)
        node_tension: scratch: tension of the averaged volume term [Pa]          (n_node,)
        row_position: scratch: position in rows of four, which load as one       (n_node, 4)
        row_velocity: scratch: likewise                                          (n_node, 4)
        row_force: scratch: likewise                                             (n_node, 4)
        squeezed_tets: scratch: where tets are squeezed below SQUEEZED_RATIO     (n_tet,)
        contact_engaged: 1 where a quadrature point is held off by a shape       (n_shape, n_surface * 4)
        contact_stretch: tangential stretch of sticking friction [m]             (n_shape, n_surface * 4, 3)
        contact_candidates: scratch: triangles in reach, shape by shape          (n_shape, n_surface)
        contact_passed: the shape and the triangle it passed through, after such a fault  (2,)
        support_stretch: tangential stretch of nodes that stick to supports [m]  (n_support_node, n_support, 3)
        volume_ratio_smallest: smallest V / V0 seen since it was last set to 1   (1,)
    """

    node_position: FloatArray
    node_velocity: FloatArray
    node_force: FloatArray
    node_tension: FloatArray
    row_position: FloatArray
    row_velocity: FloatArray
    row_force: FloatArray
    squeezed_tets: NDArray[np.int32]
    contact_engaged: NDArray[np.uint8]
    contact_stretch: FloatArray
    contact_candidates: NDArray[np.int32]
    contact_passed: NDArray[np.int32]
    support_stretch: FloatArray
    volume_ratio_smallest: FloatArray


# Written anew in every call: need not be saved.
SCRATCH_FIELDS = ("node_tension", "row_position", "row_velocity", "row_force", "squeezed_tets", "contact_candidates")


class ContactShapes(NamedTuple):
    """Rounded bodies rigidly carried by tools, SI units, world frame: all within a radius of a core.

    The core is a point (a ball), an axis (a capsule) or a rectangle (a rounded box), given by its long centre line and
    the half way across; `shapes.round_shapes` makes balls and capsules.

    Fields:
        shape_ends: the two end points of the axis [m]                           (n_shape, 2, 3)
        shape_radius: [m]                                                        (n_shape,)
        shape_tool: the tool that carries the shape                              (n_shape,)
        tool_centre: centre of mass, moved along the twist by each substep [m]   (n_tool, 3)
        tool_twist: linear [m/s] at the centre of mass, angular [rad/s]          (n_tool, 6)
        shape_span: from the axis to the rectangle's border, square to it [m]    (n_shape, 3)
        shape_friction: Coulomb coefficient over the contact law's               (n_shape,)
    """

    shape_ends: FloatArray
    shape_radius: FloatArray
    shape_tool: NDArray[np.int32]
    tool_centre: FloatArray
    tool_twist: FloatArray
    shape_span: FloatArray
    shape_friction: FloatArray


class ToolResponse(NamedTuple):
    """How tools yield to the tissue within one haptic step, SI units; zeros for tools that move as told.

    Fields:
        tool_acceleration: rate of the twist without the tissue [m/s^2, rad/s^2]  (n_tool, 6)
        tool_mobility: rate of a tool's twist per wrench on each tool [1/kg, ...]  (n_tool, n_tool, 6, 6)
        tool_wrench: scratch: sum of the wrenches before the substep [N, N m]    (n_tool, 6)
        tool_lag: scratch: how far the tool ends behind twist times step [m, rad] (n_tool, 6)
    """

    tool_acceleration: FloatArray
    tool_mobility: FloatArray
    tool_wrench: FloatArray
    tool_lag: FloatArray


class ContactLaw(NamedTuple):
    """How tissue and instrument push on each other, per unit of surface area.

    Fields:
        stiffness: pressure per penetration, k_p [N/m^3]
        damping: pressure per closing speed [N s/m^3]
        friction: Coulomb coefficient mu
        tangential_stiffness: traction per stretch while sticking [N/m^3]
    """

    stiffness: float
    damping: float
    friction: float
    tangential_stiffness: float


@njit(cache=True, nogil=True, error_model="numpy")
def move_shapes(shapes, dt):
    """Carry the shapes along their tool's twist."""
    twist = shapes.tool_twist
    for shape in range(shapes.shape_radius.shape[0]):
        tool = shapes.shape_tool[shape]
        for end in range(2):
            ox = shapes.shape_ends[shape, end, 0] - shapes.tool_centre[tool, 0]
            oy = shapes.shape_ends[shape, end, 1] - shapes.tool_centre[tool, 1]
            oz = shapes.shape_ends[shape, end, 2] - shapes.tool_centre[tool, 2]
            shapes.shape_ends[shape, end, 0] += dt * (twist[tool, 0] + twist[tool, 4] * oz - twist[tool, 5] * oy)
            shapes.shape_ends[shape, end, 1] += dt * (twist[tool, 1] + twist[tool, 5] * ox - twist[tool, 3] * oz)
            shapes.shape_ends[shape, end, 2] += dt * (twist[tool, 2] + twist[tool, 3] * oy - twist[tool, 4] * ox)
        sx = shapes.shape_span[shape, 0]
        sy = shapes.shape_span[shape, 1]
        sz = shapes.shape_span[shape, 2]
        shapes.shape_span[shape, 0] += dt * (twist[tool, 4] * sz - twist[tool, 5] * sy)
        shapes.shape_span[shape, 1] += dt * (twist[tool, 5] * sx - twist[tool, 3] * sz)
        shapes.shape_span[shape, 2] += dt * (twist[tool, 3] * sy - twist[tool, 4] * sx)
    for tool in range(shapes.tool_centre.shape[0]):
        for axis in range(3):
            shapes.tool_centre[tool, axis] += dt * twist[tool, axis]


@njit(cache=True, nogil=True, error_model="numpy")
def push_tools(shapes, response, dt, substep, wrench):
    """Let the substep's wrench change the tools' twist: twist += dt (a + B w), before the shapes move along it."""
    twist, before, lag = shapes.tool_twist, response.tool_wrench, response.tool_lag
    acceleration, mobility = response.tool_acceleration, response.tool_mobility
    for tool in range(twist.shape[0]):
        for row in range(6):
            rate = acceleration[tool, row]
            for other in range(twist.shape[0]):
                for column in range(6):
                    rate += mobility[tool, other, row, column] * (wrench[other, column] - before[other, column])
            twist[tool, row] += dt * rate
            lag[tool, row] += dt * dt * substep * rate
    for tool in range(twist.shape[0]):
        for row in range(6):
            before[tool, row] = wrench[tool, row]


@njit(forceinline=True, error_model="numpy")
def _in_rows(state):
    """The state with rows of four in place of its node arrays; contact reads x, y and z of either."""
    return OrganState(
        state.row_position, state.row_velocity, state.row_force, state.node_tension,
        state.row_position, state.row_velocity, state.row_force, state.squeezed_tets,
        state.contact_engaged, state.contact_stretch, state.contact_candidates, state.contact_passed,
        state.support_stretch, state.volume_ratio_smallest,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _copy_rows(source, target):
    """The first three columns of an array."""
    for node in range(source.shape[0]):
        for axis in range(3):
            target[node, axis] = source[node, axis]


@njit(cache=True, nogil=True, error_model="numpy")
def _evaluate(model, rows):
    """Gravity, springs and volume term into the rows' force; returns how many groups have a squeezed tet."""
    position, velocity, force, tension = rows.node_position, rows.node_velocity, rows.node_force, rows.node_tension
    tets, beta = model.tet_nodes, model.beta
    set_gravity(force, model.node_mass, model.gravity)
    add_spring_forces(
        position, force, model.spring_nodes, model.spring_stiffness, model.spring_rest_length, tets.shape[0]
    )
    if beta > 0.0:
        add_spring_damping(position, velocity, force, model.spring_nodes, model.spring_stiffness, beta)
    tension[:] = 0.0
    if model.averages_volume:
        sum_volumes(position, tension, tets)
        if beta > 0.0:
            add_volume_rates(position, velocity, tension, tets, beta)
        set_node_tension(tension, model.node_inverse_volume, model.node_bulk)
    squeezed_count = add_tet_forces(
        position, force, tension, tets, model.tet_inverse_volume, model.tet_bulk, model.tet_averaged_bulk,
        model.spring_stiffness, model.spring_rest_length, rows.volume_ratio_smallest,
        rows.squeezed_tets,
    )  # fmt: skip
    if beta > 0.0:
        add_volume_damping(position, velocity, force, tets, model.tet_inverse_volume, model.tet_bulk, beta)
    return squeezed_count


@njit(cache=True, nogil=True, error_model="numpy")
def advance_substeps(model, state, shapes, law, response, dt, decay, substep_count, reference, wrench):
    """Advance an organ by some substeps against moving shapes; the kernel behind `organ.advance`.

    Model: model, law, response
    In:    dt [s], decay = exp(-alpha dt), substep_count, reference: point of each tool's torque [m] (n_tool, 3)
    Out:   state, shapes (moved), wrench: MEAN force [N] and torque [N m] on each tool (n_tool, 6)
    Returns a FAULT_ code; a fault stops at the substep that showed it.
    """
    wrench[:, :] = 0.0
    response.tool_wrench[:, :] = 0.0
    response.tool_lag[:, :] = 0.0
    rows = _in_rows(state)
    _copy_rows(state.node_position, rows.node_position)
    _copy_rows(state.node_velocity, rows.node_velocity)
    candidate_count = find_candidates(model, rows, shapes, dt * substep_count)
    position, velocity, force = rows.node_position, rows.node_velocity, rows.node_force
    fault = FAULT_NONE
    for substep in range(substep_count):
        squeezed_count = _evaluate(model, rows)
        if not state.volume_ratio_smallest[0] > 0.0:
            # Before anything moves: the state shows which tet it was.
            fault = FAULT_INVERTED_TET
            break
        add_support_forces(model, position, velocity, force, state.support_stretch, dt)
        add_contact_forces(model, rows, shapes, law, dt, candidate_count, reference, wrench)
        kept = guard_axes(model, rows, shapes, law, response, dt, candidate_count, reference, wrench)
        hold_squeezed(
            position, velocity, force, model.node_inverse_mass, model.tet_nodes, model.tet_inverse_volume,
            model.tet_averaged_bulk, state.squeezed_tets, squeezed_count, GROUP, dt,
        )  # fmt: skip
        total = integrate(position, velocity, force, model.node_inverse_mass, dt, decay)
        push_tools(shapes, response, dt, substep, wrench)
        move_shapes(shapes, dt)
        if not math.isfinite(total):
            fault = FAULT_NOT_FINITE
        elif not kept:
            fault = FAULT_CONTACT_LOST
        if fault != FAULT_NONE:
            break
    if fault == FAULT_NONE and law.friction > 0.0:
        stretch_by_lag(model, rows, shapes, response, candidate_count)
    _copy_rows(rows.node_position, state.node_position)
    _copy_rows(rows.node_velocity, state.node_velocity)
    _copy_rows(rows.node_force, state.node_force)
    if fault == FAULT_NONE:
        for tool in range(wrench.shape[0]):
            for part in range(6):
                wrench[tool, part] /= substep_count
    return fault


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate_forces(model, state):
    """Internal forces and gravity of a state into `state.node_force` [N], without contact and supports."""
    rows = _in_rows(state)
    _copy_rows(state.node_position, rows.node_position)
    _copy_rows(state.node_velocity, rows.node_velocity)
    _evaluate(model, rows)
    _copy_rows(rows.node_force, state.node_force)
