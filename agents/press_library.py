"""Make a library of presses: organs drawn as SurgSim/PalpateSites-v0 draws them, each pressed at every site of a grid.

    python -m agents.press_library --scene phantom --level standard --organs 400 --out runs/phantom_standard.npz

Hours of simulation, done once; training then looks presses up (`agents/training/press_library.py`). A stopped run
continues where it ended, and a library can be used while it grows. Scores are computed on the environment itself, never
on the library.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from agents.training.press_library import KEPT, PressLibrary, load_library
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.lane_group import LaneGroup
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.palpation.healthy_map import charted_face, healthy_map
from surgsim_env.palpation.press import SitePress, press_in_lanes, press_phases
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.levels import DrawnOrgan, find_level
from surgsim_env.scene.load import make_scene

# Organ k of a library is drawn from this seed plus k; the benchmark's evaluation seeds begin at 1 000 000.
FIRST_SEED = 3_000_000
# Organs that are pressed side by side.
LANES = 16


def press_organs(anatomy: Anatomy, drawn: list[DrawnOrgan], group: LaneGroup) -> FloatArray:
    """Press organs side by side at every site; shape (n_organ, n, n, 5). No more organs than the group has lanes.

    Raises:
        RuntimeError: a press ended in a fault (says where).
    """
    charted, phases = charted_face(anatomy), press_phases(anatomy.scene)
    side = charted.chart.side_count
    simulations = group.simulations[: len(drawn)]
    kept = np.zeros((len(drawn), side * side, len(KEPT)))
    for simulation, organ in zip(simulations, drawn, strict=True):
        simulation.reset(organ.compiled(anatomy), simulation.instrument.parked)
    for number, place in enumerate(charted.chart.sites):
        site = charted.site(place)
        presses = [SitePress(simulation, site.point, site.normal) for simulation in simulations]
        press_in_lanes(group, [*presses, *[None] * (len(group.simulations) - len(presses))], phases)
        for index, press in enumerate(presses):
            result = press.result()
            if result.fault:
                raise RuntimeError(f"organ {drawn[index].to_json()}, site {number}: {result.fault}")
            force = float(result.force @ site.normal)
            kept[index, number] = force, result.depth, result.force_peak, result.stopped, result.duration
    return kept.reshape(len(drawn), side, side, len(KEPT))


def make_library(
    path: Path, scene: str, level: str, organ_count: int, *, dtype: type = np.float32, lanes: int = LANES
) -> PressLibrary:
    """Press organs in batches until a library has `organ_count`; each batch is saved when it is complete.

    In float32 forces are within 0.5 % of the environment's, a tenth of the sensor's noise; a batch has `lanes` organs.

    Raises:
        ValueError: the file at `path` is of another scene or level.
    """
    chosen, plain = find_level(level), make_scene(scene)
    healthy_map(plain)
    anatomy = load_anatomy(chosen.scene(plain))
    side = charted_face(anatomy).chart.side_count
    library = PressLibrary(scene, level, (), np.zeros((0, side, side, len(KEPT))))
    if path.exists():
        library = load_library(path)
        if (library.scene, library.level) != (scene, level):
            raise ValueError(
                f"{path} holds presses of scene {library.scene!r}, level {library.level!r}, not of {scene!r}, "
                f"{level!r}: give another --out"
            )
    group = LaneGroup([Simulation(anatomy) for _ in range(lanes)], dtype, lanes)
    start, before = time.monotonic(), len(library.organs)
    while (done := len(library.organs)) < organ_count:
        numbers = range(done, min(done + lanes, organ_count))
        drawn = [chosen.draw(anatomy, np.random.default_rng(FIRST_SEED + number)) for number in numbers]
        presses = np.concatenate([library.presses, press_organs(anatomy, drawn, group)])
        library = PressLibrary(scene, level, (*library.organs, *[organ.to_json() for organ in drawn]), presses)
        library.save(path)
        spent, made = time.monotonic() - start, len(library.organs) - before
        left = spent / made * (organ_count - len(library.organs))
        print(f"{len(library.organs)} of {organ_count} organs, {spent:.0f} s, {left:.0f} s to go", flush=True)
    return library


def main() -> None:
    """Make a library, or continue one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="phantom")
    parser.add_argument("--level", default="standard")
    parser.add_argument("--organs", type=int, default=400)
    parser.add_argument("--out", type=Path, default=Path("runs/library.npz"))
    arguments = parser.parse_args()
    make_library(arguments.out, arguments.scene, arguments.level, arguments.organs)


if __name__ == "__main__":
    main()
