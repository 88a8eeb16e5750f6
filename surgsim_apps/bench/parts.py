"""Time of a haptic step under a press by its parts."""

from collections.abc import Callable
from copy import deepcopy
from functools import partial
from statistics import median

import numpy as np

from msdm_core.arithmetic import exp
from msdm_core.kernels import advance_substeps, repeat_parts
from surgsim_apps.bench.measurement import Effort, interleaved, seconds_per_call, spread
from surgsim_apps.bench.report import Figure, Section
from surgsim_env.coupling import Simulation
from surgsim_env.palpation import press
from surgsim_env.scene import load_anatomy, make_scene

METHOD = """Processor time of the parts of a haptic step with the tip at press depth, over the last demonstration lesion
or the middle of the face. Each part is the difference of two repeated substeps without motion, up to this part and up
to the part before; medians, all in turn in each round. "Rest" is what the whole substeps take beside the parts, the
broad phase among it, once a haptic step; "instrument" is what a haptic step takes beside the substeps."""
PARTS = (
    *("sums at nodes", "law at nodes", "springs", "tets", "contact", "guard", "steep springs", "implicit contact"),
    *("squeezed tets", "integration"),
)


def measure(effort: Effort) -> Section:
    """Parts of a haptic step of each scene under a press."""
    section = Section("parts", "Parts of a haptic step under a press", METHOD)
    for name in effort.scenes:
        section.figures.extend(_figures(name, effort.substep_rounds))
    return section


def _figures(name: str, rounds: int) -> list[Figure]:
    scene = make_scene(name)
    anatomy = load_anatomy(scene)
    lesions = anatomy.demonstration_lesions()
    organ, simulation = anatomy.organ(lesions), Simulation(anatomy)
    target = np.array(lesions[-1].centre) if lesions else anatomy.mesh.points.mean(axis=0)
    point, normal = anatomy.face.project(target)
    simulation.reset(organ, point + 0.05 * normal)
    pressed = press(simulation, point, normal)
    if pressed.end:
        raise ValueError(f"scene {name!r}: the press of the benchmark ended: {pressed.end}")
    tools, count = simulation.instrument, simulation.substep_count
    dt, law = simulation.substep_dt, simulation.contact
    decay, reference = float(exp(-organ.alpha * dt)), tools.shapes.tool_centre.copy()
    shapes = deepcopy(tools.shapes)
    shapes.tool_twist[:] = 0.0
    wrench = np.zeros((len(reference), 6))

    def part(last: int, fades: bool) -> float:
        state = deepcopy(simulation.organ_state)
        # Rows of four, candidates: those of a step.
        advance_substeps(organ, state, shapes, law, tools.response, dt, decay, 1, reference, wrench)

        def run(times: int) -> None:
            state.row_force[:] = 0.0
            repeat_parts(organ, state, shapes, law, tools.response, dt, decay, fades, last, reference, wrench, times)

        run(1)
        return seconds_per_call(run)

    def substeps() -> float:
        state = deepcopy(simulation.organ_state)
        still = deepcopy(shapes)

        def run(times: int) -> None:
            for _ in range(times):
                advance_substeps(organ, state, still, law, tools.response, dt, decay, count, reference, wrench)

        run(1)
        return seconds_per_call(run)

    def steps() -> float:
        tools.command_velocity(np.zeros(3))

        simulation.control_step(1)
        return seconds_per_call(simulation.control_step)

    runs: dict[str, Callable[[], float]] = {str(last): partial(part, last, False) for last in range(len(PARTS))}
    if organ.relaxes:
        runs["fading"] = partial(part, len(PARTS) - 1, True)
    times = interleaved({**runs, "substeps": substeps, "all": steps}, rounds)
    middle = {key: median(values) for key, values in times.items()}
    sums = [middle[str(last)] for last in range(len(PARTS))]
    shares = dict(zip(PARTS, (count * np.diff([0.0, *sums])).tolist(), strict=True))
    # The arms relax once a haptic step.
    shares["relaxation of arms"] = middle["fading"] - sums[-1] if organ.relaxes else 0.0
    shares["rest"] = middle["substeps"] - sum(shares.values())
    shares["instrument"] = middle["all"] - middle["substeps"]
    note = f"{count} substeps, {len(organ.node_mass)} nodes; all: {spread([1e6 * value for value in times['all']])}"
    figures = [Figure(f"{name}, {key}", "time", 1e6 * value, "us") for key, value in shares.items()]
    figures.append(Figure(f"{name}, all", "time", 1e6 * middle["all"], "us", note))
    return figures
