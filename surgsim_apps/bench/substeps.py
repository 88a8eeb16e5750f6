"""Time of one substep of an organ: against its number of nodes, and with stiffening and relaxing springs."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import median

import numpy as np

from msdm_core.arithmetic import exp
from msdm_core.kernels import FAULT_NONE, LaneState, OrganModel, OrganState, advance_substeps, lane_counts
from msdm_core.lanes import lane_responses, stack_organs, stack_shapes, stack_states
from msdm_core.material import Damping, Material, Relaxation, Stiffening
from msdm_core.meshing import box_mesh
from msdm_core.organ import NO_CONTACT, NO_SHAPES, OrganSpec, advance_organ, compile_organ, rest_state
from surgsim_apps.bench.measurement import Cells, Effort, exponent, interleaved, seconds_per_call, spread
from surgsim_apps.bench.report import Figure, Section

CELL = 0.005  # [m]
# Fewest nodes of a block for the exponent: in smaller ones calls and start-up dominate.
LEAST_NODES = 600
METHOD = """Blocks of cubic 5 mm cells, E 5 kPa, nu 0.45, springs and volume term, no contact, one thread, bottom held,
slightly sheared. Processor time per substep and organ; medians, all sizes in turn in each round. "Abreast" are organs
side by side in lanes (vectorized)."""

# The block for the laws, of phantom's size, with its shears and step: Maxwell arms relax once a millisecond, so that
# all laws need the same step.
LAW_CELLS = (12, 12, 6)
LAW_SHEARS, LAW_STEP = (0.03, 0.1), 0.00025
# A sheared block swings back: substeps until it is sheared anew.
SUBSTEPS_SHEARED = 16
TISSUE = Material(5000.0, 1060.0, 0.45)
STIFFENING = Stiffening(onset_strain=0.05, cap_strain=0.2, tangent_cap=20.0)
ARMS = Relaxation(relative_moduli=(0.3, 0.3, 0.3), times=(0.05, 0.5, 5.0))
LAWS = {
    "linear, elastic": TISSUE,
    "stiffening": replace(TISSUE, stiffening=STIFFENING),
    "relaxation": replace(TISSUE, relaxation=ARMS),
    "both": replace(TISSUE, stiffening=STIFFENING, relaxation=ARMS),
}
LAW_METHOD = """One block of 12 x 12 x 6 cells as above: stiffening from a strain of 0.05 to 0.2 up to 20 times the
tangent, three Maxwell arms. Sheared anew after every 16 substeps: by 0.03, with no steep spring, or by 0.1, with steep
springs at many nodes, which are integrated implicitly. The same step of 0.25 ms for all. Ratios are to linear, elastic
springs at the same shear."""

Substep = Callable[[], float]


def block(cells: Cells, material: Material = TISSUE) -> OrganModel:
    """A block of cubic cells, its bottom held."""
    mesh = box_mesh(np.array(cells) * CELL, cells)
    anchors = np.flatnonzero(mesh.points[:, 2] < 1e-9)
    return compile_organ(OrganSpec(mesh, material, anchors=anchors, damping=Damping(alpha=25.0)))


def single(model: OrganModel, *, shear: float = 0.01, dt: float | None = None) -> Substep:
    """Seconds of one substep of one organ, float64, sheared; dt [s] is by default half of the stable step."""
    state = rest_state(model)
    dt = 0.5 * model.stable_step if dt is None else dt
    wrench = np.zeros((0, 6))

    def advance(count: int) -> bool:
        return advance_organ(model, state, NO_SHAPES, NO_CONTACT, dt, count, wrench) == FAULT_NONE

    run = sheared(state, shear, advance)
    return lambda: seconds_per_call(run)


def abreast(model: OrganModel, dtype: type = np.float64, *, shear: float = 0.01, dt: float | None = None) -> Substep:
    """Seconds of one substep of each of many organs side by side in vector registers; otherwise as `single`."""
    lanes = lane_counts(dtype)[0]
    organs = stack_organs([model] * lanes, dtype=dtype)
    state = stack_states([rest_state(model)] * lanes, model, dtype=dtype)
    shapes, wrench = stack_shapes([NO_SHAPES] * lanes, lanes), np.zeros((lanes, 0, 6))
    dt = 0.5 * model.stable_step if dt is None else dt
    decay, response, reference = float(exp(-model.alpha * dt)), lane_responses(0, lanes), shapes.tool_centre

    def advance(count: int) -> bool:
        advance_substeps(organs, state, shapes, NO_CONTACT, response, dt, decay, count, reference, wrench)
        return bool((state.lane_fault == FAULT_NONE).all())

    run = sheared(state, shear, advance)
    return lambda: seconds_per_call(run) / lanes


def sheared(state: OrganState | LaneState, shear: float, advance: Callable[[int], bool]) -> Callable[[int], None]:
    """Runs of substeps of a state at rest, each sheared at first and again after every SUBSTEPS_SHEARED."""
    start = state.node_position.copy()
    start[:, 0] += shear * start[:, 2]

    def run(count: int) -> None:
        for first in range(0, count, SUBSTEPS_SHEARED):
            state.node_position[:] = start
            for array in (state.node_velocity, state.element_arm_tension, state.element_relief):
                array[:] = 0.0
            if not advance(min(SUBSTEPS_SHEARED, count - first)):
                raise ValueError("the timed block diverged: its times are not valid")

    run(3)
    return run


# Ways of stepping, one column each.
WAYS: dict[str, Callable[..., Substep]] = {
    "single": single,
    "8 abreast": abreast,
    "16 abreast, float32": partial(abreast, dtype=np.float32),
}


def measure(effort: Effort) -> Section:
    """The cost of a substep for every block and way, and its growth with the number of nodes."""
    section = Section("substep", "Substep cost against node count", METHOD)
    models = {f"{len(model.node_mass)} nodes": model for model in map(block, effort.blocks)}
    runs = {f"{way} {name}": make(model) for way, make in WAYS.items() for name, model in models.items()}
    times = interleaved(runs, effort.substep_rounds)
    for way in WAYS:
        for name, model in models.items():
            section.figures.append(_figure(way, name, model, times[f"{way} {name}"]))
        costs = {len(model.node_mass): median(times[f"{way} {name}"]) for name, model in models.items()}
        section.figures.extend(_growth(way, costs))
    return section


def measure_laws(effort: Effort) -> Section:
    """The cost of a substep with each of LAWS, for every way."""
    section = Section("tissue_law", "Substep cost with laws of tissue", LAW_METHOD)
    models = {name: block(LAW_CELLS, material) for name, material in LAWS.items()}
    runs = {
        f"{way} {name}, sheared by {shear:g}": make(model, shear=shear, dt=LAW_STEP)
        for way, make in WAYS.items()
        for shear in LAW_SHEARS
        for name, model in models.items()
    }
    times = interleaved(runs, effort.substep_rounds)
    for way in WAYS:
        for shear in LAW_SHEARS:
            linear = median(times[f"{way} {next(iter(LAWS))}, sheared by {shear:g}"])
            for name in LAWS:
                row = f"{name}, sheared by {shear:g}"
                values = times[f"{way} {row}"]
                note = f"{way}: {spread([1e6 * value for value in values])}"
                section.figures.append(Figure(row, way, 1e6 * median(values), "us", note))
                section.figures.append(Figure(row, f"ratio, {way}", median(values) / linear, "1"))
    return section


def _figure(way: str, name: str, model: OrganModel, times: list[float]) -> Figure:
    """Cost of one block."""
    note = f"{len(model.spring_stiffness)} springs, {len(model.tet_nodes)} tets; "
    note += f"{way}: {spread([1e6 * value for value in times])}"
    return Figure(name, way, 1e6 * median(times), "us", note)


def _growth(way: str, costs: dict[int, float]) -> list[Figure]:
    """The exponent of cost against nodes, if two blocks are large enough."""
    sizes = [nodes for nodes in costs if nodes >= LEAST_NODES]
    if len(sizes) < 2:
        return []
    note = f"p of cost ~ nodes^p, {min(sizes)} to {max(sizes)} nodes"
    return [Figure("exponent", f"exponent, {way}", exponent(sizes, [costs[nodes] for nodes in sizes]), "1", note)]
