"""Model, state, contact shapes, tools and contact law of organs: what the compiled code reads and writes.

An organ alone has `OrganModel` and `OrganState`; organs of the same tets that advance together, one a lane, have
`LaneModel` and `LaneState`. The functions at the end give what contact and tools need of one lane; for an organ alone
that is the whole. Arrays of models are read-only, which numba enforces at compile time.
"""

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload
from numpy.typing import NDArray

from msdm_core.kernels.option_kernels import INLINED, INLINED_VIEW, JITABLE

FloatArray = NDArray[np.float64]
# float64 or float32, eight or sixteen lanes.
LaneArray = NDArray[Any]

FAULT_NONE = 0
FAULT_INVERTED_TET = 1
FAULT_NOT_FINITE = 2
FAULT_CONTACT_LOST = 3
# Instead of a fault: the lane has no organ, or its organ must not move.
LANE_EMPTY = -1


class OrganModel(NamedTuple):
    """The constants of an organ: read-only arrays, SI units.

    Fields:
        node_rest_position: undeformed position [m]                              (n_node, 3)
        node_mass: lumped mass [kg]                                              (n_node,)
        node_inverse_mass: 1 / mass [1/kg], 0 where the node is anchored         (n_node,)
        spring_nodes: the two nodes of each spring; spring t is tet t's first edge (n_spring, 2)
        spring_stiffness: [N/m]                                                  (n_spring,)
        spring_rest_length: [m]                                                  (n_spring,)
        stiffens: whether any spring stiffens with strain                        scalar
        node_softness: 5 / sum of k l0^2 over the springs of a node [1/J]        (n_node,), (0,) if none stiffens
        node_onset: e0 of its `Stiffening`                                       likewise
        node_growth: 1 / (e1 - e0)                                               likewise
        node_excess: (c - 1) (e1 - e0)                                           likewise
        steep_rise: the least rise of a spring with a steepness of STEEP_EXCESS  scalar
        steep_sweeps: the most of `hold_steep`                                   scalar
        relaxes: whether any spring has Maxwell arms                             scalar
        spring_gain: tension at once over that at equilibrium, 1 + sum g_i       (n_spring,), (0,) if none relaxes
        spring_arm_modulus: g_i, arm by arm                                      (3 * n_spring,), likewise
        arm_time: tau_i of all springs, inf for an arm that is not used [s]      (3,)
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
        support_kind: the solids it rests on, PLANE, SPHERE, ...                 (n_support,)
        support_position: its middle or a plane's point [m]                      (n_support, 3)
        support_rotation: its axes in the world, one a column                    (n_support, 3, 3)
        support_size: radius, half length, half sizes [m]                        (n_support, 3)
        support_friction: Coulomb coefficient                                    (n_support,)
        support_nodes: nodes that supports may hold: free ones of the surface    (n_support_node,)
        support_area: surface area that belongs to each of them [m^2]            (n_support_node,)
        support_stiffness: pressure per penetration [N/m^3]                      scalar
        support_damping: pressure per closing speed [N s/m^3]                    scalar
        support_tangential_stiffness: traction per stretch while sticking [N/m^3] scalar
        foundation_nodes: nodes that elastic foundations hold                    (n_held,)
        foundation_position: where those nodes are without force [m]             (n_held, 3)
        foundation_stiffness: force per displacement, all foundations together [N/m] (n_held, 3, 3)
        motion_node_shift: how far a unit of a motion's signal moves the ground [m], and 0 (n_motion, n_node, 4)
        motion_anchored_nodes: anchored nodes of an organ whose ground moves     (n_anchored,)
        motion_foundation_shift: the same of foundations, at the nodes they hold [m] (n_motion, n_held, 3)
        motion_support_shift: the same of supports [m]                           (n_motion, n_support, 3)
        gravity: [m/s^2]                                                         (3,)
        alpha: mass-proportional damping rate [1/s]                              scalar
        beta: stiffness-proportional damping time [s]                            scalar
        stable_step: largest stable step without contact of instruments [s]      scalar
        added_mass: how much of node_mass `stability.scale_mass` added [kg]      scalar
    """

    node_rest_position: FloatArray
    node_mass: FloatArray
    node_inverse_mass: FloatArray
    spring_nodes: NDArray[np.int32]
    spring_stiffness: FloatArray
    spring_rest_length: FloatArray
    stiffens: bool
    node_softness: FloatArray
    node_onset: FloatArray
    node_growth: FloatArray
    node_excess: FloatArray
    steep_rise: float
    steep_sweeps: int
    relaxes: bool
    spring_gain: FloatArray
    spring_arm_modulus: FloatArray
    arm_time: FloatArray
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
    foundation_nodes: NDArray[np.int32]
    foundation_position: FloatArray
    foundation_stiffness: FloatArray
    motion_node_shift: FloatArray
    motion_anchored_nodes: NDArray[np.intp]
    motion_foundation_shift: FloatArray
    motion_support_shift: FloatArray
    gravity: FloatArray
    alpha: float
    beta: float
    stable_step: float
    added_mass: float

    def __deepcopy__(self, memo: dict) -> "OrganModel":
        """The same: nothing writes to it, and numba would compile everything again for copies that can be written."""
        return self


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
        node_pairs: scratch: sums of volumes [m^3] and energies [J] around nodes, then tension [Pa] and half the factor
            on springs, see tissue_kernels.set_node_laws                         (n_node, 2), (0, 2) if none stiffens
        node_steepness: scratch: what the springs' tangent is above 1            (n_node,), (0,) if none stiffens
        spring_lengths: scratch: [m]                                             (n_spring,), likewise
        steep_springs: scratch: where springs are steep                          (n_spring,), (0,) if none stiffens
        steep_places: scratch: those springs, see squeeze_kernels                (n_spring,), likewise
        steep_rows: scratch: likewise                                            (n_spring, STEEP_WIDTH), likewise
        steep_speed: scratch: speed that their nodes get to [m/s]                (n_node, 3), (0, 3) if none stiffens
        spring_arm_tension: what each arm has given way to, over l0, arm by arm [N/m] (3 * n_spring,), (0,) without arms
        spring_relief: sum_i g_i times that [N/m]                                (n_spring,), (0,) without arms
        contact_engaged: 1 where a quadrature point is held off by a shape       (n_shape, n_surface * 4)
        contact_stretch: tangential stretch of sticking friction [m]             (n_shape, n_surface * 4, 3)
        contact_candidates: scratch: triangles in reach, shape by shape          (n_shape, n_surface)
        contact_rows: scratch: one a point held off, see contact_kernels         (n_shape * n_surface * 4, ROW_WIDTH)
        contact_places: scratch: whose they are                                  (n_shape * n_surface * 4, PLACE_WIDTH)
        contact_hold: scratch: what contact holds a node with, times dt^2 [kg]   (n_node,)
        contact_passed: the shape and the triangle it passed through, after such a fault  (2,)
        support_stretch: tangential stretch of nodes that stick to supports [m]  (n_support_node, n_support, 3)
        motion: signal, its rate, rate of the substep before [1/s], work of the ground on the organ [J] (n_motion, 4)
        ground_foundation: scratch: where foundations hold nodes now [m]         (n_held, 3)
        ground_support: scratch: position [m] and velocity [m/s] of supports now (n_support, 2, 3)
        ground_load: scratch: force of each support on the organ [N]             (n_support, 3)
        ground_rate: scratch: rates of the motions' signals [1/s]                (n_motion,)
        volume_ratio_smallest: smallest V / V0 seen since it was last set to 1   (1,)
        lane_fault: scratch: FAULT_ code of the last call                        (1,)
        moving: scratch: 1 until a fault stops the organ, then 0                 (1,)
        finite_sum: scratch: finite where positions and velocities are           (1,)
        candidate_count: scratch: candidates of the busiest shape                (1,)
        contact_kept: scratch: 0 where the surface passed through an axis        (1,)
        contact_count: scratch: rows of contact_rows and contact_places in use   (1,)
    """

    node_position: FloatArray
    node_velocity: FloatArray
    node_force: FloatArray
    node_tension: FloatArray
    row_position: FloatArray
    row_velocity: FloatArray
    row_force: FloatArray
    squeezed_tets: NDArray[np.int32]
    node_pairs: FloatArray
    node_steepness: FloatArray
    spring_lengths: FloatArray
    steep_springs: NDArray[np.int32]
    steep_places: NDArray[np.int32]
    steep_rows: FloatArray
    steep_speed: FloatArray
    spring_arm_tension: FloatArray
    spring_relief: FloatArray
    contact_engaged: NDArray[np.uint8]
    contact_stretch: FloatArray
    contact_candidates: NDArray[np.int32]
    contact_rows: FloatArray
    contact_places: NDArray[np.int32]
    contact_hold: FloatArray
    contact_passed: NDArray[np.int32]
    support_stretch: FloatArray
    motion: FloatArray
    ground_foundation: FloatArray
    ground_support: FloatArray
    ground_load: FloatArray
    ground_rate: FloatArray
    volume_ratio_smallest: FloatArray
    lane_fault: NDArray[np.int32]
    moving: FloatArray
    finite_sum: FloatArray
    candidate_count: NDArray[np.int32]
    contact_kept: NDArray[np.uint8]
    contact_count: NDArray[np.int32]


# Written anew in every call: need not be saved.
SCRATCH_FIELDS = (
    *("node_tension", "row_position", "row_velocity", "row_force", "squeezed_tets"),
    *("node_pairs", "node_steepness", "spring_lengths", "steep_springs", "steep_places", "steep_rows", "steep_speed"),
    *("contact_candidates", "contact_rows", "contact_places", "contact_hold"),
    *("ground_foundation", "ground_support", "ground_load", "ground_rate"),
    *("lane_fault", "moving", "finite_sum", "candidate_count", "contact_kept", "contact_count"),
)


LaneModel = namedtuple(
    "LaneModel",
    (
        "lanes",
        *(name for name in OrganModel._fields if name not in ("tet_rest_volume", "node_rest_volume", "added_mass")),
        *("surface_count", "support_count", "anchor_count"),
    ),
)
LaneModel.__doc__ = """The constants of organs side by side: read-only arrays, SI units; tets are shared.

Fields are those of OrganModel, and `lanes`: as many zeros as there are lanes, so that their number is part of the
compiled type. Each lane has its own node_mass, node_inverse_mass, spring_stiffness, node_softness, tet_bulk,
tet_averaged_bulk and node_bulk (n, n_lane), and its own averages_volume and stable_step (n_lane,).

Rest shapes and anchors are shared too, or each lane's own. spring_rest_length, tet_inverse_volume, node_inverse_volume
and motion_node_shift are then (..., n_lane), and those of surface, supports and foundations have the lane as their
first index; of the surface, of supports and of anchored nodes a lane uses as many rows as it has: surface_count,
support_count and anchor_count (n_lane,). node_rest_position is that of lane 0 if they differ.
"""

# Fields of the state that have the lane as last index in lanes, in their floating-point type; as first index; those
# with one number a lane; and scratch that one lane uses after the other.
LANE_COLUMNS = (
    *("node_position", "node_velocity", "node_force", "spring_arm_tension", "spring_relief", "volume_ratio_smallest"),
    *("node_tension", "node_steepness", "steep_rows", "steep_speed", "ground_rate", "moving", "finite_sum"),
)
LANE_ROWS = (
    *("contact_engaged", "contact_stretch", "contact_candidates", "contact_passed", "support_stretch", "motion"),
    *("ground_foundation", "ground_support", "ground_load"),
)
LANE_NUMBERS = ("lane_fault", "candidate_count", "contact_kept", "contact_count")
LANE_SHARED = ("squeezed_tets", "spring_lengths", "steep_springs", "steep_places", "contact_hold")

LaneState = namedtuple(
    "LaneState",
    (
        *(*LANE_COLUMNS, *LANE_ROWS, *LANE_NUMBERS, *LANE_SHARED),
        *("node_pairs", "contact_rows", "contact_places", "kept_force", "surface_count", "support_count"),
    ),
)
LaneState.__doc__ = """What changes while organs side by side move, SI units.

Fields are those of OrganState without its rows of four: LANE_COLUMNS (..., n_lane), LANE_ROWS (n_lane, ...),
LANE_NUMBERS (n_lane,), of which lane_fault is LANE_EMPTY where no organ is, LANE_SHARED; and
    node_pairs: scratch: as in OrganState                                        (2, n_node, n_lane), (2, 0, n_lane)
    contact_rows, contact_places: scratch: as in OrganState, of each lane if organs stiffen, else of one lane after
        the other                                                                (n_lane or 1, n_row, ROW_WIDTH), ...
    kept_force: scratch: node_force of the lanes that do not move [N]            (n_node, 3, n_lane)
    surface_count, support_count: how much of the memory belongs to a lane       (n_lane,)
"""


class ContactShapes(NamedTuple):
    """Rounded bodies rigidly carried by tools, SI units, world frame: all within a radius of a core.

    The core is a point (a ball), an axis (a capsule) or a rectangle (a rounded box), given by its long centre line and
    the half way across; `stepping.round_shapes` makes balls and capsules.

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
    """Motion of the tools under the force of the tissue within one haptic step, SI units; all 0: the twist stays.

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


class SpringLaw(NamedTuple):
    """How springs depart from linear ones in one substep: fields of model and state, and what the arms lose.

    Fields:
        measured: `stiffens` of the model: node_pairs and, of an organ alone, spring_lengths of the state are set
        stiffens: whether springs of any node have a factor other than 1
        steepens: whether any node has a steepness above STEEP_EXCESS
        pairs, lengths, steep: `node_pairs`, `spring_lengths`, `steep_springs` of the state
        steep_sum: least sum of the halves of a spring's two ends where it may be steep
        relaxes, gain, arm_modulus: `relaxes`, `spring_gain` and `spring_arm_modulus` of the model
        arm_tension, relief: `spring_arm_tension` and `spring_relief` of the state
        fades: whether the arms give way in this substep
        fade: share of its tension that each arm then loses
    """

    measured: bool
    stiffens: bool
    steepens: bool
    pairs: LaneArray
    lengths: FloatArray
    steep: NDArray[np.int32]
    steep_sum: float
    relaxes: bool
    gain: FloatArray
    arm_modulus: FloatArray
    arm_tension: LaneArray
    relief: LaneArray
    fades: bool
    fade: tuple[float, float, float]


class SurfaceView(NamedTuple):
    """What contact reads of one lane's model."""

    surface_triangles: NDArray[np.int32]
    surface_rest_area: FloatArray
    node_inverse_mass: LaneArray


class _Supports(NamedTuple):
    """What supports read of one lane's model."""

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


class _Ground(NamedTuple):
    """What elastic foundations and the ground's motion read of one lane's model."""

    support_position: FloatArray
    foundation_nodes: NDArray[np.int32]
    foundation_position: FloatArray
    foundation_stiffness: FloatArray
    motion_node_shift: LaneArray
    motion_anchored_nodes: NDArray[np.intp]
    motion_foundation_shift: FloatArray
    motion_support_shift: FloatArray


class TouchedView(NamedTuple):
    """What contact reads and writes of one lane's state."""

    node_position: LaneArray
    node_velocity: LaneArray
    node_force: LaneArray
    contact_engaged: NDArray[np.uint8]
    contact_stretch: FloatArray
    contact_candidates: NDArray[np.int32]
    contact_rows: FloatArray
    contact_places: NDArray[np.int32]
    contact_hold: FloatArray
    contact_passed: NDArray[np.int32]


def lanes_of(model: OrganModel | LaneModel) -> tuple[int, ...]:
    """As many zeros as there are organs side by side; none for an organ alone."""
    return model.lanes if isinstance(model, LaneModel) else ()


@overload(lanes_of, jit_options=JITABLE)
def _(model):
    return (lambda model: model.lanes) if model.instance_class is LaneModel else (lambda model: ())


# Whether `lanes` is empty, and how many indices an array has, is known when these are compiled: one way is left.


@njit(**INLINED)
def entry_of(values, lane):
    """One lane's number of an array (1, n_lane), or that of an organ alone in an array (1,)."""
    if values.ndim == 2:
        return values[0, lane]
    return values[lane]


@njit(**INLINED)
def set_entry(values, lane, value):
    """Write what `entry_of` reads."""
    if values.ndim == 2:
        values[0, lane] = value
    else:
        values[lane] = value


@njit(**INLINED_VIEW)
def column_of(values, lane):
    """One lane's numbers of an array (n, n_lane), or of all lanes' array (n,)."""
    if values.ndim == 2:
        return values[:, lane]
    return values


@njit(**INLINED_VIEW)
def part_of(lanes, values, lane):
    """One lane's part of an array whose first index is the lane; an organ alone has the whole array."""
    if len(lanes) == 0:
        return values
    return values[lane]


@njit(**INLINED_VIEW)
def _triangles_of(values, lane, count):
    if values.ndim == 3:
        return values[lane, :count]
    return values


@njit(**INLINED_VIEW)
def _numbers_of(values, lane, count):
    if values.ndim == 2:
        return values[lane, :count]
    return values


@njit(**INLINED)
def surface_of(lanes, model, lane):
    """One lane's surface, as contact reads it."""
    if len(lanes) == 0:
        return SurfaceView(model.surface_triangles, model.surface_rest_area, model.node_inverse_mass)
    count = model.surface_count[lane]
    return SurfaceView(
        _triangles_of(model.surface_triangles, lane, count), _numbers_of(model.surface_rest_area, lane, count),
        model.node_inverse_mass[:, lane],
    )  # fmt: skip


@njit(**INLINED)
def supports_of(lanes, model, lane):
    """One lane's supports; kernels that read them take an OrganModel as well."""
    if len(lanes) == 0:
        return _Supports(
            model.support_kind, model.support_position, model.support_rotation, model.support_size,
            model.support_friction, model.support_nodes, model.support_area,
            model.support_stiffness, model.support_damping, model.support_tangential_stiffness,
        )  # fmt: skip
    count = model.support_count[lane]
    return _Supports(
        model.support_kind, model.support_position, model.support_rotation, model.support_size, model.support_friction,
        _numbers_of(model.support_nodes, lane, count), _numbers_of(model.support_area, lane, count),
        model.support_stiffness, model.support_damping, model.support_tangential_stiffness,
    )  # fmt: skip


@njit(**INLINED_VIEW)
def _places_of(values, lane):
    if values.ndim == 3:
        return values[lane]
    return values


@njit(**INLINED_VIEW)
def _blocks_of(values, lane):
    if values.ndim == 4:
        return values[lane]
    return values


@njit(**INLINED_VIEW)
def _shifts_of(values, lane):
    if values.ndim == 4:
        return values[:, :, :, lane]
    return values


@njit(**INLINED)
def ground_of(lanes, model, lane):
    """One lane's foundations, and how the ground moves; kernels that read them take an OrganModel as well."""
    if len(lanes) == 0:
        return model
    return _Ground(
        model.support_position, model.foundation_nodes, _places_of(model.foundation_position, lane),
        _blocks_of(model.foundation_stiffness, lane), _shifts_of(model.motion_node_shift, lane),
        _numbers_of(model.motion_anchored_nodes, lane, model.anchor_count[lane]),
        _blocks_of(model.motion_foundation_shift, lane), model.motion_support_shift,
    )  # fmt: skip


@njit(**INLINED)
def touched_of(lanes, state, lane):
    """One lane's state, as contact reads and writes it."""
    if len(lanes) == 0:
        return TouchedView(
            state.node_position, state.node_velocity, state.node_force,
            state.contact_engaged, state.contact_stretch, state.contact_candidates,
            state.contact_rows, state.contact_places, state.contact_hold, state.contact_passed,
        )  # fmt: skip
    room = lane if state.contact_rows.shape[0] > 1 else 0
    return TouchedView(
        state.node_position[:, :, lane], state.node_velocity[:, :, lane], state.node_force[:, :, lane],
        state.contact_engaged[lane], state.contact_stretch[lane], state.contact_candidates[lane],
        state.contact_rows[room], state.contact_places[room], state.contact_hold, state.contact_passed[lane],
    )  # fmt: skip


@njit(**INLINED)
def shapes_of(lanes, shapes, lane):
    """One lane's contact shapes."""
    if len(lanes) == 0:
        return shapes
    return ContactShapes(
        shapes.shape_ends[lane], shapes.shape_radius[lane], shapes.shape_tool[lane], shapes.tool_centre[lane],
        shapes.tool_twist[lane], shapes.shape_span[lane], shapes.shape_friction[lane],
    )  # fmt: skip


@njit(**INLINED)
def response_of(lanes, response, lane):
    """The response of one lane's tools."""
    if len(lanes) == 0:
        return response
    return ToolResponse(
        response.tool_acceleration[lane], response.tool_mobility[lane], response.tool_wrench[lane],
        response.tool_lag[lane],
    )  # fmt: skip


@njit(**INLINED)
def in_rows(lanes, state):
    """The state whose node arrays the tissue's kernels work on: of an organ alone with rows of four in their place."""
    if len(lanes) > 0:
        return state
    return OrganState(
        state.row_position, state.row_velocity, state.row_force, state.node_tension,
        state.row_position, state.row_velocity, state.row_force, state.squeezed_tets,
        state.node_pairs, state.node_steepness, state.spring_lengths,
        state.steep_springs, state.steep_places, state.steep_rows, state.steep_speed,
        state.spring_arm_tension, state.spring_relief,
        state.contact_engaged, state.contact_stretch, state.contact_candidates,
        state.contact_rows, state.contact_places, state.contact_hold, state.contact_passed,
        state.support_stretch,
        state.motion, state.ground_foundation, state.ground_support, state.ground_load, state.ground_rate,
        state.volume_ratio_smallest, state.lane_fault, state.moving, state.finite_sum, state.candidate_count,
        state.contact_kept, state.contact_count,
    )  # fmt: skip
