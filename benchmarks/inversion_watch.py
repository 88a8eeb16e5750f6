"""Cost of the check of every tet for inversion: the kernels against a copy without the check.

    python benchmarks/inversion_watch.py --scene phantom

Two copies of msdm_core/kernels/group_kernels.py are compiled in a temporary folder; their volume kernels and a whole
substep without contact run alternately in this process, on the organ of the scene at rest. Prints `name value unit`
lines; times are medians of processor time.
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
    """A module with this text; numba compiles it at its first call."""
    path = folder / f"{name}.py"
    path.write_text(text, encoding="utf-8")
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def volume_arguments(model: Any) -> tuple:
    """Arguments of `add_tet_groups` for the organ of a scene at rest."""
    from msdm_core.organ.compile import rest_state

    state = rest_state(model)
    state.row_position[:, :3] = model.node_rest_position
    return (
        state.row_position, state.row_force, state.node_tension, model.tet_nodes, model.tet_inverse_volume,
        model.tet_bulk, model.tet_averaged_bulk, model.spring_stiffness, model.spring_rest_length,
        state.volume_ratio_smallest, state.squeezed_tets,
    )  # fmt: skip


def seconds(run, arguments: tuple, count: int) -> float:
    """Processor time of one call, the mean of `count` calls [s]; other processes on the machine disturb it least."""
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

    from msdm_core.kernels import group_kernels
    from msdm_core.organ.compile import rest_state
    from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance_organ
    from surgsim_env.scene.anatomy import load_anatomy
    from surgsim_env.scene.load import make_scene

    scene = make_scene(arguments.scene)
    model = load_anatomy(scene).organ()
    text = Path(group_kernels.__file__).read_text(encoding="utf-8")
    if text.count(WATCH) != 1:
        sys.exit("the lines of the check differ from WATCH, which this script removes: update WATCH")
    times: dict[str, list[float]] = {"watching": [], "blind": [], "substep": []}
    state, wrench = rest_state(model), np.zeros((0, 6))
    dt = 0.5 * model.stable_step
    with tempfile.TemporaryDirectory() as folder:
        runs = {
            name: (compiled_copy(Path(folder), f"{name}_kernels", source).add_tet_groups, volume_arguments(model))
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
