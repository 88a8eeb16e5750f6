"""Model, state, contact shapes, tools and contact law of organs: the structures of the compiled code.

An organ alone has `OrganModel` and `OrganState`; vectorised organs of the same tets, each in a lane, have `LaneModel`
and `LaneState`. MODEL_FIELDS and STATE_FIELDS are the sheet of their fields: lanes, saved states, blank states and the
documentation follow from it. Arrays of models are read-only, which numba enforces at compile time.
"""

from collections import namedtuple
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
# float64 or float32, eight or sixteen lanes.
LaneArray = NDArray[Any]

FAULT_NONE = 0
FAULT_INVERTED_TET = 1
FAULT_NOT_FINITE = 2
FAULT_CONTACT_LOST = 3
# In place of a fault: the lane has no organ, or its organ must not move.
LANE_EMPTY = -1

# Layouts of a field in organs side by side.
LAYOUTS = {
    "shared": "as in an organ alone; of a state scratch for the lanes in turn",
    "own": "(..., n_lane) in the lanes' floating-point type, (n_lane,) of a scalar",
    "rest": "as `own` if lanes have rest shapes of their own, else shared",
    "rows": "(n_lane, ...), with the lane's own number of rows in use; of a model as `rest`",
    "first": "shared, that of lane 0 if lanes have rest shapes of their own",
    "turns": "(n_lane, ...) if organs stiffen, else (1, ...) for the lanes in turn",
    "halves": "(2, ..., n_lane)",
    "alone": "only in an organ alone",
}


class Field(NamedTuple):
    """Field of an organ's model or state.

    Fields:
        name: in `OrganModel` or `OrganState`
        unit: SI, "" for pure numbers, flags and indices
        shape: lengths in an organ alone, by number or by name; () for a scalar
        lanes: one of LAYOUTS
        meaning: for the documentation
        dtype: in an organ alone
    """

    name: str
    unit: str
    shape: tuple[int | str, ...]
    lanes: str
    meaning: str
    dtype: str

    def lengths(self, sizes: Mapping[int | str, int]) -> tuple[Any, ...]:
        """Shape in an organ alone, from lengths by name."""
        return tuple([sizes.get(length, length) for length in self.shape])


def _field(name: str, unit: str, shape: str, lanes: str, meaning: str, dtype: str = "float64") -> Field:
    """Field with lengths written as "n_node 3"."""
    lengths = tuple(int(length) if length.isdigit() else length for length in shape.split())
    return Field(name, unit, lengths, lanes, meaning, dtype)


# Lengths: n_soft is n_node, n_steep n_spring and n_relaxing n_spring + n_tet + n_node (springs, tets, averaged volumes:
# the elements that relax), or 0 if no tissue stiffens or relaxes; n_arm is 3 n_relaxing, n_around the most nodes around
# a triangle, n_point 4 n_surface, n_row n_shape n_point. See also `organ.state.state_sizes`.
MODEL_FIELDS = (
    _field("node_rest_position", "m", "n_node 3", "first", "undeformed position"),
    _field("node_mass", "kg", "n_node", "own", "lumped mass"),
    _field("node_inverse_mass", "1/kg", "n_node", "own", "1 / mass, 0 at anchored nodes"),
    _field("spring_nodes", "", "n_spring 2", "shared", "both ends; spring t is tet t's first edge", "int32"),
    _field("spring_stiffness", "N/m", "n_spring", "own", "k"),
    _field("spring_rest_length", "m", "n_spring", "rest", "l0"),
    _field("stiffens", "", "", "shared", "True if any spring stiffens with strain", "bool"),
    _field("node_softness", "1/J", "n_soft", "own", "1 / (2 E_a V_a) of its `Stiffening`"),
    _field("node_onset", "", "n_soft", "shared", "e0 of its `Stiffening`"),
    _field("node_growth", "", "n_soft", "shared", "1 / (e1 - e0)"),
    _field("node_excess", "", "n_soft", "shared", "(c - 1) (e1 - e0)"),
    _field("spring_hold", "N/m", "n_steep", "own", "implicit stiffness of a spring over its steepness"),
    _field("steep_rise", "", "", "shared", "least rise of a spring with a steepness of STEEP_EXCESS"),
    _field("steep_sweeps", "", "", "shared", "most sweeps of `hold_steep`", "int64"),
    _field("relaxes", "", "", "shared", "True if any element has Maxwell arms", "bool"),
    _field("element_gain", "", "n_relaxing", "shared", "immediate tension over that at equilibrium, 1 + sum g_i"),
    _field("element_arm_modulus", "", "n_arm", "shared", "g_i, arm by arm"),
    _field("arm_time", "s", "3", "shared", "tau_i of all elements, inf for an unused arm"),
    _field("tet_nodes", "", "n_tet 4", "shared", "corners of each tet", "int32"),
    _field("tet_rest_volume", "m^3", "n_tet", "rest", "V0"),
    _field("tet_inverse_volume", "1/m^3", "n_tet", "rest", "1 / V0"),
    _field("tet_bulk", "Pa", "n_tet", "own", "modulus of the volume term of each tet"),
    _field("tet_barrier_bulk", "Pa", "n_tet", "own", "whole volume modulus of a tet, of its barrier when squeezed"),
    _field("node_rest_volume", "m^3", "n_node", "rest", "volume averaged at a node, a quarter of its tets"),
    _field("node_inverse_volume", "1/m^3", "n_node", "rest", "1 / that"),
    _field("node_bulk", "Pa", "n_node", "own", "modulus of the volume term averaged at nodes"),
    _field("averages_volume", "", "", "own", "True if any node_bulk is above 0", "bool"),
    _field("surface_triangles", "", "n_surface 3", "rows", "triangles open to contact, outward", "int32"),
    _field("surface_rest_area", "m^2", "n_surface", "rows", ""),
    _field("surface_around", "", "n_surface n_around", "rows", "nodes around each triangle, see EdgeRise", "int32"),
    _field("surface_rise", "", "n_surface n_around 3", "rows", "their weights in the rise of its edges"),
    _field("support_kind", "", "n_support", "shared", "solids below it, PLANE, SPHERE, ...", "int32"),
    _field("support_position", "m", "n_support 3", "shared", "middle of each, or a plane's point"),
    _field("support_rotation", "", "n_support 3 3", "shared", "its axes in the world as columns"),
    _field("support_size", "m", "n_support 3", "shared", "radius, half length, half sizes"),
    _field("support_friction", "", "n_support", "shared", "Coulomb coefficient"),
    _field("support_nodes", "", "n_support_node", "rows", "free surface nodes", "int32"),
    _field("support_area", "m^2", "n_support_node", "rows", "surface area of each of them"),
    _field("support_stiffness", "N/m^3", "", "shared", "pressure per penetration"),
    _field("support_damping", "N s/m^3", "", "shared", "pressure per closing speed"),
    _field("support_tangential_stiffness", "N/m^3", "", "shared", "traction per stretch in static friction"),
    _field("foundation_nodes", "", "n_held", "shared", "nodes on elastic foundations", "int32"),
    _field("foundation_position", "m", "n_held 3", "rows", "places of those nodes without force"),
    _field("foundation_stiffness", "N/m", "n_held 3 3", "rows", "force per displacement, sum of all foundations"),
    _field("motion_node_shift", "m", "n_motion n_node 4", "rest", "shift of the ground per unit of a signal, and 0"),
    _field("motion_anchored_nodes", "", "n_anchored", "rows", "anchored nodes of an organ on moving ground", "int64"),
    _field("motion_foundation_shift", "m", "n_motion n_held 3", "rows", "likewise at the nodes of foundations"),
    _field("motion_support_shift", "m", "n_motion n_support 3", "shared", "likewise of supports"),
    _field("gravity", "m/s^2", "3", "shared", ""),
    _field("alpha", "1/s", "", "shared", "mass-proportional damping rate"),
    _field("beta", "s", "", "shared", "stiffness-proportional damping time"),
    _field("stable_step", "s", "", "own", "largest stable step without contact of instruments"),
    _field("added_mass", "kg", "", "alone", "part of node_mass from `stability.scale_mass`"),
)

# Saved and restored.
KEPT_FIELDS = (
    _field("node_position", "m", "n_node 3", "own", ""),
    _field("node_velocity", "m/s", "n_node 3", "own", ""),
    _field("node_force", "N", "n_node 3", "own", "force of the last substep, without anchors' reactions"),
    _field("element_arm_tension", "N/m, Pa", "n_arm", "own", "relaxed tension of each arm, of springs over l0"),
    _field("element_relief", "N/m, Pa", "n_relaxing", "own", "sum_i g_i times that"),
    _field("contact_engaged", "", "n_shape n_point", "rows", "1 for a point in contact with a shape", "uint8"),
    _field("contact_stretch", "m", "n_shape n_point 3", "rows", "tangential stretch of static friction"),
    _field("contact_passed", "", "2", "rows", "shape and triangle passed through, after such a fault", "int32"),
    _field("support_stretch", "m", "n_support_node n_support 3", "rows", "tangential stretch of static friction"),
    _field("motion", "1, 1/s, 1/s, J", "n_motion 4", "rows", "signal, rate, rate before, work of the ground"),
    _field("volume_ratio_smallest", "", "1", "own", "smallest V / V0 since its last reset to 1"),
)

# Written again in every call, never saved.
SCRATCH_FIELDS = (
    _field("node_tension", "Pa", "n_node", "own", "tension of the averaged volume term"),
    _field("row_position", "m", "n_node 4", "alone", "position in rows of four, each a register"),
    _field("row_velocity", "m/s", "n_node 4", "alone", "likewise"),
    _field("row_force", "N", "n_node 4", "alone", "likewise"),
    _field("squeezed_tets", "", "n_tet", "shared", "groups of tets with any below SQUEEZED_RATIO", "int32"),
    _field("node_pairs", "m^3, J; Pa, 1", "n_soft 2", "halves", "sums of volumes and energies, then see set_node_laws"),
    _field("node_steepness", "", "n_soft", "own", "excess of the springs' tangent over 1"),
    _field("spring_lengths", "m", "n_steep", "shared", "lengths of all springs"),
    _field("steep_springs", "", "n_steep", "shared", "groups of springs with any steep", "int32"),
    _field("steep_places", "", "n_steep", "shared", "steep springs, see squeeze_kernels", "int32"),
    _field("steep_rows", "", "n_steep steep_width", "own", "likewise"),
    _field("steep_speed", "m/s", "n_soft 3", "own", "change of speed of their nodes, see there"),
    _field("contact_candidates", "", "n_shape n_surface", "rows", "triangles in reach, shape by shape", "int32"),
    _field("contact_rows", "", "n_row row_width", "turns", "a row for each point in contact"),
    _field("contact_places", "", "n_row place_width", "turns", "shape, point and nodes of each row", "int32"),
    _field("contact_hold", "kg", "n_node", "shared", "hold of contact on a node, times dt^2"),
    _field("ground_foundation", "m", "n_held 3", "rows", "present places of foundations"),
    _field("ground_support", "m, m/s", "n_support 2 3", "rows", "present position and velocity of supports"),
    _field("ground_load", "N", "n_support 3", "rows", "force of each support on the organ"),
    _field("ground_rate", "1/s", "n_motion", "own", "rates of the motions' signals"),
    _field("lane_fault", "", "1", "rows", "FAULT_ code of the last call", "int32"),
    _field("moving", "", "1", "own", "1 until a fault stops the organ, then 0"),
    _field("finite_sum", "", "1", "own", "finite if positions and velocities are"),
    _field("candidate_count", "", "1", "rows", "candidates of the busiest shape", "int32"),
    _field("contact_kept", "", "1", "rows", "0 after an axis passed through the surface", "uint8"),
    _field("contact_count", "", "1", "rows", "rows of contact_rows and contact_places in use", "int32"),
)

STATE_FIELDS = KEPT_FIELDS + SCRATCH_FIELDS
KEPT_NAMES = tuple(field.name for field in KEPT_FIELDS)


class OrganModel(NamedTuple):
    """Constants of an organ: read-only arrays, SI units, with the fields of MODEL_FIELDS."""

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
    spring_hold: FloatArray
    steep_rise: float
    steep_sweeps: int
    relaxes: bool
    element_gain: FloatArray
    element_arm_modulus: FloatArray
    arm_time: FloatArray
    tet_nodes: NDArray[np.int32]
    tet_rest_volume: FloatArray
    tet_inverse_volume: FloatArray
    tet_bulk: FloatArray
    tet_barrier_bulk: FloatArray
    node_rest_volume: FloatArray
    node_inverse_volume: FloatArray
    node_bulk: FloatArray
    averages_volume: bool
    surface_triangles: NDArray[np.int32]
    surface_rest_area: FloatArray
    surface_around: NDArray[np.int32]
    surface_rise: FloatArray
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

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled arrays come back writable."""
        return _read_only_model, tuple(self)

    def __deepcopy__(self, memo: dict) -> "OrganModel":
        """The model itself: it is read-only, and numba would compile everything again for writable copies."""
        return self


def _read_only_model(*fields: Any) -> OrganModel:
    for field in fields:
        if isinstance(field, np.ndarray):
            field.setflags(write=False)
    return OrganModel(*fields)


class OrganState(NamedTuple):
    """State of an organ, SI units, with the fields of STATE_FIELDS."""

    node_position: FloatArray
    node_velocity: FloatArray
    node_force: FloatArray
    element_arm_tension: FloatArray
    element_relief: FloatArray
    contact_engaged: NDArray[np.uint8]
    contact_stretch: FloatArray
    contact_passed: NDArray[np.int32]
    support_stretch: FloatArray
    motion: FloatArray
    volume_ratio_smallest: FloatArray
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
    contact_candidates: NDArray[np.int32]
    contact_rows: FloatArray
    contact_places: NDArray[np.int32]
    contact_hold: FloatArray
    ground_foundation: FloatArray
    ground_support: FloatArray
    ground_load: FloatArray
    ground_rate: FloatArray
    lane_fault: NDArray[np.int32]
    moving: FloatArray
    finite_sum: FloatArray
    candidate_count: NDArray[np.int32]
    contact_kept: NDArray[np.uint8]
    contact_count: NDArray[np.int32]


def _in_lanes(fields: tuple[Field, ...]) -> list[str]:
    """Names of the fields of organs side by side."""
    return [field.name for field in fields if field.lanes != "alone"]


LaneModel = namedtuple(
    "LaneModel", ("lanes", *_in_lanes(MODEL_FIELDS), "surface_count", "support_count", "anchor_count")
)
LaneModel.__doc__ = """Constants of vectorised organs: read-only arrays, SI units, in the layouts of MODEL_FIELDS.

`lanes` has a zero for each lane, so that their number is part of the compiled type. surface_count, support_count and
anchor_count are the numbers of rows of surface, supports and anchored nodes in use by each lane (n_lane,).
"""

LaneState = namedtuple("LaneState", (*_in_lanes(STATE_FIELDS), "kept_force", "surface_count", "support_count"))
LaneState.__doc__ = """State of vectorised organs, SI units, in the layouts of STATE_FIELDS.

lane_fault is LANE_EMPTY for a lane without organ; `kept_force` is scratch: node_force of the stopped lanes [N]
(n_node, 3, n_lane); surface_count and support_count are the numbers of rows in use by each lane (n_lane,).
"""


class ContactShapes(NamedTuple):
    """Rounded bodies rigidly attached to tools, all points within a radius of a core, SI units, world frame.

    The core is a point (a ball), an axis (a capsule) or a rectangle (a rounded box), given by its long centre line and
    half its width, see `stepping.round_shapes`.

    Fields:
        shape_ends: the two end points of the axis [m]                           (n_shape, 2, 3)
        shape_radius: [m]                                                        (n_shape,)
        shape_tool: its tool                                                     (n_shape,)
        tool_centre: centre of mass, moved along the twist by each substep [m]   (n_tool, 3)
        tool_twist: linear [m/s] at the centre of mass, angular [rad/s]          (n_tool, 6)
        shape_span: from the axis to the rectangle's border, normal to it [m]    (n_shape, 3)
        shape_friction: Coulomb coefficient over the contact law's               (n_shape,)
        patch_layout: of a patch of taxels: its shape, rows, columns, first taxel (n_patch, 4)
        patch_frame: from the first end of the shape's axis to the patch's middle [m]; unit vectors along a row and
            along a column, over the pitch [1/m]; turned by each haptic step     (n_patch, 3, 3)
        taxel_force: mean force of the tissue on each taxel in the last call [N] (n_taxel, 3)
    """

    shape_ends: FloatArray
    shape_radius: FloatArray
    shape_tool: NDArray[np.int32]
    tool_centre: FloatArray
    tool_twist: FloatArray
    shape_span: FloatArray
    shape_friction: FloatArray
    patch_layout: NDArray[np.int32]
    patch_frame: FloatArray
    taxel_force: FloatArray


class ToolResponse(NamedTuple):
    """Motion of the tools under the force of the tissue within one haptic step, SI units; all 0: the twist stays.

    Fields:
        tool_acceleration: rate of the twist without the tissue [m/s^2, rad/s^2]  (n_tool, 6)
        tool_mobility: rate of a tool's twist per wrench on each tool [1/kg, ...]  (n_tool, n_tool, 6, 6)
        tool_wrench: scratch: sum of the wrenches before the substep [N, N m]    (n_tool, 6)
        tool_lag: scratch: lag of the tool behind twist times step [m, rad]      (n_tool, 6)
    """

    tool_acceleration: FloatArray
    tool_mobility: FloatArray
    tool_wrench: FloatArray
    tool_lag: FloatArray


class ContactLaw(NamedTuple):
    """Contact law of tissue and instrument, per unit of surface area.

    Fields:
        stiffness: pressure per penetration, k_p [N/m^3]
        damping: pressure per closing speed [N s/m^3]
        friction: Coulomb coefficient mu
        tangential_stiffness: traction per stretch in static friction [N/m^3]
    """

    stiffness: float
    damping: float
    friction: float
    tangential_stiffness: float
