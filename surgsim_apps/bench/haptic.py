"""Wall-clock time of a haptic step during presses of a scene's organ."""

import time

import numpy as np

from surgsim_apps.bench.measurement import Effort
from surgsim_apps.bench.report import Figure, Section
from surgsim_env.coupling import Simulation
from surgsim_env.scene import load_anatomy, make_scene

SPEED = 0.04  # [m/s]
# Haptic steps held at depth after each press.
HOLD_COUNT = 100
METHOD = """Wall clock of each haptic step in contact, while the scene's tip presses the scene's organ with its lesions
at random places, to the scene's depth, and rests there. The worst step includes interruptions by other processes;
`processor` is processor time. Real time is the scene's haptic step of 1000 us."""


def measure(effort: Effort) -> Section:
    """Median, 99 % quantile and worst haptic step of each scene."""
    section = Section("haptic_step", "Haptic step while pressing", METHOD)
    for name in effort.scenes:
        walls, processors, note = press_times(name, effort.haptic_steps)
        for quantity, share in (("p50", 0.5), ("p99", 0.99), ("worst", 1.0)):
            section.figures.append(Figure(name, quantity, 1e6 * float(np.quantile(walls, share)), "us", note))
        for quantity, share in (("p50, processor", 0.5), ("p99, processor", 0.99)):
            section.figures.append(Figure(name, quantity, 1e6 * float(np.quantile(processors, share)), "us"))
    return section


def press_times(scene_name: str, count: int) -> tuple[list[float], list[float], str]:
    """Wall-clock and processor times of at least `count` haptic steps in contact [s], and a note on the organ."""
    scene = make_scene(scene_name)
    anatomy = load_anatomy(scene)
    simulation = Simulation(anatomy)
    organ = anatomy.organ(anatomy.demonstration_lesions())
    rng = np.random.default_rng(0)
    depth, radius = scene.palpation.press_depth, scene.instrument.tip_radius
    go_in = round(depth / (SPEED * simulation.haptic_dt))
    walls: list[float] = []
    processors: list[float] = []
    warm = False
    simulation.reset(organ, simulation.instrument.upper)
    while len(walls) < count:
        point, normal = anatomy.face.random_point(rng, scene.palpation.face_margin)
        simulation.restart(point + normal * radius)
        for step in range(go_in + HOLD_COUNT):
            simulation.instrument.command_velocity(-SPEED * normal if step < go_in else np.zeros(3))
            begin, processor_begin = time.perf_counter(), time.thread_time()
            well = simulation.haptic_step()
            processor, wall = time.thread_time() - processor_begin, time.perf_counter() - begin
            if not well:
                raise ValueError(f"scene {scene_name!r}: a press of the benchmark ended: {simulation.fault}")
            # The first press compiles and fills caches.
            if warm and simulation.contact_force.any():
                walls.append(wall)
                processors.append(processor)
        warm = True
    nodes, tets = len(organ.node_mass), len(organ.tet_nodes)
    return walls, processors, f"{nodes} nodes, {tets} tets, {simulation.substep_count} substeps; {len(walls)} steps"
