"""What watching every tet for inversion costs: the kernels as they are against a copy that does not look.

    python benchmarks/inversion_watch.py --scene phantom

Both copies are compiled from the text of msdm_core/kernels.py in a temporary folder and run in turn in this process, on
the scene's organ with a ball pressed into it. Prints `name value unit` lines; times are medians, the cost their ratio.
"""

import argparse
import importlib.util
import statistics
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType

WATCH = """        if not ratio >= smallest:
            smallest = ratio
            smallest_tet = tet
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


def pressed_scene(scene_name: str, kernels: ModuleType) -> tuple:
    """Arguments of `advance_substeps` for one haptic step, in that copy's own structures, a ball 2 mm deep."""
    import numpy as np

    from msdm_core.organ import rest_state
    from msdm_core.stepping import unyielding
    from surgsim_env.anatomy import load_anatomy
    from surgsim_env.scenes import make_scene

    scene = make_scene(scene_name)
    anatomy = load_anatomy(scene)
    model = anatomy.organ()
    point, normal = anatomy.face.random_point(np.random.default_rng(0), scene.palpation.face_margin)
    centre = point + normal * (scene.instrument.tip_radius - 0.002)
    shapes = kernels.ContactShapes(
        np.tile(centre, (1, 2, 1)),
        np.array([scene.instrument.tip_radius]),
        np.zeros(1, np.int32),
        centre[None].copy(),
        np.zeros((1, 6)),
    )
    dt = scene.timing.haptic_step / scene.timing.substep_count
    return (
        kernels.OrganModel(*model),
        kernels.OrganState(*rest_state(model, shape_count=1)),
        shapes,
        kernels.ContactLaw(*scene.contact.law),
        kernels.ToolResponse(*unyielding(1)),
        dt,
        1.0 - scene.damping.alpha * dt,
        scene.timing.substep_count,
        centre[None].copy(),
        np.zeros((1, 6)),
    )


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

    import msdm_core.kernels

    text = Path(msdm_core.kernels.__file__).read_text(encoding="utf-8")
    if text.count(WATCH) != 1:
        sys.exit("the lines that watch are no longer those that this script takes out: bring WATCH up to date")
    steps, volumes = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        for name, source in (("watching", text), ("blind", text.replace(WATCH, ""))):
            kernels = compiled_copy(Path(folder), f"kernels_{name}", source)
            given = pressed_scene(arguments.scene, kernels)
            steps[name] = (kernels.advance_substeps, given, [])
            volumes[name] = (kernels._add_volume_forces, given[:2], [])
        for kind, count in ((steps, 20), (volumes, 80)):
            for run, given, _ in kind.values():
                seconds(run, given, 5)
            for _ in range(arguments.rounds):
                for run, given, times in kind.values():
                    times.append(seconds(run, given, count))
    for label, kind in (("haptic_step", steps), ("volume_kernel", volumes)):
        watching, blind = (statistics.median(kind[name][2]) for name in ("watching", "blind"))
        print(f"{label}_watching {watching * 1e6:.1f} us")
        print(f"{label}_blind {blind * 1e6:.1f} us")
        print(f"{label}_cost {100.0 * (watching / blind - 1.0):+.1f} %")


if __name__ == "__main__":
    main()
