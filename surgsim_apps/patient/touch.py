"""Tip, press and cells of a patient's organ."""

import math
from dataclasses import dataclass

from msdm_core.arithmetic import cbrt, power
from msdm_core.material import Material
from surgsim_apps.palpate.scene_options import SceneOptions, require_length
from surgsim_env.scene import Vector, contact_radius

# Radius of a tip [m] for organs up to these volumes [m^3]: a ball of 10 to 12 mm passes a trocar of 12 mm.
TIPS = ((0.0005, 0.005), (math.inf, 0.006))
# Press depth over tip radius, as in the scene liver.
DEPTH_PER_TIP = 7.0 / 12.0
# Edge of the lattice's cells over the contact radius sqrt(tip radius x press depth); at the palpable faces of a kidney,
# a liver and a stomach edges are then 0.84 to 0.86 of it.
CELL_PER_CONTACT_RADIUS = 0.9
# Tip for given cells: cells of one size are 0.85 of its contact radius.
TIP_STEP, TIP_RANGE, CELL_PER_TIP_CONTACT = 5e-4, (0.002, 0.015), 0.85
DEPTH_STEP, CELL_STEP = 1e-4, 1e-5
# Depth of fine cells under the pressed face, in contact radii. On a kidney, presses then differ from those on cells of
# one size by 1 to 2 %, without it by 2 to 14 %.
FINE_DEPTH = 1.0
# Largest cells elsewhere over the fine ones; at least CELLS_ACROSS of them fit along a cube of the organ's volume.
COARSENINGS, CELLS_ACROSS = (4, 2, 1), 5.0
# Nodes of a body-centred cubic lattice per cell; and those of the fine face, in FACE_NODES fine cells on a face of
# FACE_SHARE V^(2/3): 4 to 8 % too few on the same organs, 27 % too many on a ball.
NODES_PER_CELL, FACE_NODES, FACE_SHARE, TETS_PER_NODE = 2.0, 11.5, 1.35, 4.9
# Processor time of one tet in one substep [s] (docs/benchmarks.md: 9.0 ns on `phantom`, 8.8 ns on `liver`).
TIME_PER_TET = 9e-9
# Substeps of an organ with a lesion 8 times as stiff in a haptic step of 1 ms, times cell over sqrt(E / density) [s].
SUBSTEP_CELLS, HAPTIC_STEP = 10.0, 1e-3
# Least length over the edge of a cube of the organ's volume.
LENGTH_LEAST = 1e-3
# Tip radius of the coarser choice on offer, over that of the plan.
COARSER = 1.5


@dataclass(frozen=True)
class TouchPlan:
    """Tip, press and cells of an organ to be made.

    Fields:
        tip_radius, press_depth: [m]
        cell_size: of the lattice, of its fine cells where it is graded [m]
        coarsening: edge of the largest cells over that of the fine ones; 1 for cells of one size
        volume: of the organ [m^3]
        is_given: true for a cell size of the user
        known_node_count: of the tets of a file
    """

    tip_radius: float
    press_depth: float
    cell_size: float
    coarsening: int
    volume: float
    is_given: bool
    known_node_count: int | None = None

    @property
    def fine_depth(self) -> float:
        """Depth of fine cells under the pressed face [m]."""
        return FINE_DEPTH * contact_radius(self.tip_radius, self.press_depth)

    @property
    def node_count(self) -> int:
        """Number of nodes; before meshing an estimate, to two digits."""
        if self.known_node_count is not None:
            return self.known_node_count
        cell = self.coarsening * self.cell_size
        count = NODES_PER_CELL * self.volume / (cell * cell * cell)
        if self.coarsening > 1:
            count += FACE_NODES * FACE_SHARE * float(power(self.volume, 2.0 / 3.0)) / (self.cell_size * self.cell_size)
        # A broken surface may enclose nothing; its mesher refuses it.
        return max(int(float(f"{count:.2g}")), 1)

    def real_time_factor(self, material: Material) -> float:
        """Estimate of simulated time over the processor time of one core, by the modulus and density of a tissue."""
        stiffest = 1.0 if material.relaxation is None else material.relaxation.instantaneous
        speed = math.sqrt(stiffest * material.youngs_modulus / material.density)
        substeps = math.ceil(SUBSTEP_CELLS * HAPTIC_STEP * speed / self.cell_size)
        return HAPTIC_STEP / (TIME_PER_TET * TETS_PER_NODE * self.node_count * substeps)


def plan_touch(volume: float, options: SceneOptions, *, cell_size: float | None, graded: bool) -> TouchPlan:
    """Touch and cells of an organ.

    Without a cell size the tip passes a trocar and cells follow from it; with a cell size the tip follows from it.

    Args:
        volume: of the organ [m^3].
        options: tip radius and press depth, if given.
        cell_size: of all cells [m], or None.
        graded: true for a mesher of cells that are coarser elsewhere.
    """
    if cell_size is not None:
        tip = options.tip_radius or tip_for_cells(cell_size)
        return TouchPlan(tip, options.press_depth or depth_for_tip(tip), cell_size, 1, volume, is_given=True)
    tip = options.tip_radius or next(radius for largest, radius in TIPS if volume <= largest)
    depth = options.press_depth or depth_for_tip(tip)
    cell = round(math.floor(CELL_PER_CONTACT_RADIUS * contact_radius(tip, depth) / CELL_STEP) * CELL_STEP, 7)
    across = float(cbrt(max(volume, 0.0))) / CELLS_ACROSS
    coarsening = next((factor for factor in COARSENINGS if factor * cell <= across), 1) if graded else 1
    return TouchPlan(tip, depth, cell, coarsening, volume, is_given=False)


def check_touch(volume: float, options: SceneOptions, cell_size: float | None) -> None:
    """Refuse lengths that are not above 0, below a thousandth of the edge of a cube of the organ's volume, or above it.

    Raises:
        ValueError: names the option and its value.
    """
    # A broken surface may enclose nothing; its mesher refuses it.
    most = float(cbrt(volume)) if volume > 0.0 else math.inf
    least = max(LENGTH_LEAST * most, DEPTH_STEP) if volume > 0.0 else 0.0
    lengths = {"cell-size": cell_size, "tip-radius": options.tip_radius, "press-depth": options.press_depth}
    for option, length in lengths.items():
        require_length(f"--{option}", length, most, "the edge of a cube of the organ's volume", least)


def tip_for_cells(cell_size: float) -> float:
    """Radius of the smallest tip that does not feel cells of a size, within TIP_RANGE [m]."""
    wanted = math.ceil(cell_size / (CELL_PER_TIP_CONTACT * math.sqrt(DEPTH_PER_TIP)) / TIP_STEP) * TIP_STEP
    return min(max(round(wanted, 7), TIP_RANGE[0]), TIP_RANGE[1])


def depth_for_tip(tip_radius: float) -> float:
    """Press depth of a tip [m]."""
    return round(round(DEPTH_PER_TIP * tip_radius / DEPTH_STEP) * DEPTH_STEP, 7)


def plan_text(plan: TouchPlan, material: Material, approach: Vector) -> str:
    """The plan in words, with its cost and a coarser choice."""
    x, y, z = approach
    elsewhere = f" under the face towards {x:.2g}, {y:.2g}, {z:.2g}, {plan.coarsening} times as long elsewhere"
    text = (
        f"tip {plan.tip_radius * 1e3:g} mm, pressed {plan.press_depth * 1e3:g} mm; cells of "
        f"{plan.cell_size * 1e3:.3g} mm{elsewhere if plan.coarsening > 1 else ''}: about {plan.node_count} nodes, "
        f"{plan.real_time_factor(material):.2g} times real time on one core"
    )
    if plan.is_given:
        return text
    options = SceneOptions(tip_radius=round(COARSER * plan.tip_radius, 4))
    coarser = plan_touch(plan.volume, options, cell_size=None, graded=plan.coarsening > 1)
    return (
        f"{text}; coarser: --tip-radius {coarser.tip_radius:g}, about {coarser.node_count} nodes, "
        f"{coarser.real_time_factor(material):.2g} times"
    )
