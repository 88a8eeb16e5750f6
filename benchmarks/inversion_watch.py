"""What watching every tet for inversion costs: the kernels as they are against a copy that does not look.

    python benchmarks/inversion_watch.py --scene phantom

Two copies of msdm_core/tissue_kernels.py are compiled in a temporary folder; their volume kernels and a whole substep
without contact run in turn in this process, on the scene's organ at rest. Prints `name value unit` lines; times are
medians of processor time.
"""

import argparse
import importlib.util
import statistics
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

WATCH = """        lowest = keep_lower(ratio, lowest, ratio, lowest)
"""


def compiled_copy(folder: Path, name: str, text: str) -> ModuleType:
    """A module of that text; numba compiles it at its first call."""
    path = folder / f"{name}.py"
    path.write_text(text, encoding="utf-8")
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def volume_arguments(model: Any) -> tuple:
    """Arguments of `add_tet_forces` for a scene's organ at rest."""
    from msdm_core.organ import rest_state

    state = rest_state(model)
    state.row_position[:, :3] = model.node_rest_position
    return (
        state.row_position, state.row_force, state.node_tension, model.tet_nodes, model.tet_inverse_volume,
        model.tet_bulk, model.tet_averaged_bulk, model.spring_stiffness, model.spring_rest_length,
        state.volume_ratio_smallest, state.squeezed_tets,
    )  # fmt: skip


def seconds(run, arguments: tuple, count: int) -> float:
    """Processor time of one call, over `count` of them [s]: what else runs on the machine disturbs it least."""
    begin = time.process_time()
    for _ in range(count):
        run(*arguments)
    return (time.process_time() - begin) / count


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="phantom")
    parser.add_argument("--rounds", type=int, default=201)
    arguments = parser.parse_args()

    from msdm_core import tissue_kernels
    from msdm_core.organ import rest_state
    from msdm_core.stepping import NO_CONTACT, NO_SHAPES, advance_organ
    from surgsim_env.anatomy import load_anatomy
    from surgsim_env.scenes import make_scene

    scene = make_scene(arguments.scene)
    model = load_anatomy(scene).organ()
    text = Path(tissue_kernels.__file__).read_text(encoding="utf-8")
    if text.count(WATCH) != 1:
        sys.exit("the lines that watch are no longer those that this script takes out: bring WATCH up to date")
    times: dict[str, list[float]] = {"watching": [], "blind": [], "substep": []}
    state, wrench = rest_state(model), np.zeros((0, 6))
    dt = 0.5 * model.stable_step
    with tempfile.TemporaryDirectory() as folder:
        runs = {
            name: (compiled_copy(Path(folder), f"{name}_kernels", source).add_tet_forces, volume_arguments(model))
            for name, source in (("watching", text), ("blind", text.replace(WATCH, "")))
        }
        runs["substep"] = (advance_organ, (model, state, NO_SHAPES, NO_CONTACT, dt, 1, wrench))
        for run, given in runs.values():
            seconds(run, given, 5)
        for _ in range(arguments.rounds):
            for name, (run, given) in runs.items():
                times[name].append(seconds(run, given, 40))
    median = {name: statistics.median(values) for name, values in times.items()}
    for name, value in median.items():
        print(f"{name} {value * 1e6:.1f} us")
    cost = median["watching"] - median["blind"]
    print(f"cost_of_volume_kernel {100.0 * cost / median['blind']:+.1f} %")
    print(f"cost_of_substep {100.0 * cost / (median['substep'] - cost):+.1f} %")


if __name__ == "__main__":
    main()
