"""Organs on a CUDA device: forces against the processor's, and times, in one short run.

    python benchmarks/cuda_organs.py [--out FOLDER]

Each row is a press by tips on their way into the organ at 6 cm/s, one a lane. Not run on a card yet.
"""

import argparse
import json
import time
import traceback
from pathlib import Path
from typing import Any

import numpy as np
from numba import cuda

from msdm_core.cuda import DeviceOrgans
from msdm_core.kernels import ContactShapes, ToolResponse
from msdm_core.lanes import stack_shapes
from msdm_core.organ import advance_organ, rest_state, round_shapes, unyielding
from surgsim_env.scene import Anatomy, load_anatomy, make_scene

# Scene, lanes, options of `DeviceOrgans`, haptic steps in a launch, the most important first.
ROWS: list[tuple[str, int, dict[str, Any], int]] = [
    ("phantom_small", 64, {"dtype": np.float64, "threads": 256}, 1),
    ("phantom", 4096, {}, 10),
    ("spleen_family", 1, {"threads": 256, "block_count": 64}, 1),
    ("phantom", 4096, {"threads": 1024}, 10),
    ("phantom_small", 4096, {"threads": 256, "registers": 64}, 10),
    ("spleen_family", 1, {"threads": 512, "block_count": 132}, 1),
]
PRESS_STEPS, SPEED, TIMES = 60, 0.06, 5
PATHS = 64


def probe(anatomy: Anatomy, path: int) -> ContactShapes:
    """Ball and shaft above a random point of the palpable face, on their way in."""
    radius, random = anatomy.scene.instrument.tip_radius, np.random.default_rng(path)
    place, normal = anatomy.face.random_point(random, anatomy.scene.palpation.face_margin)
    tip = place + normal * (radius + 1e-4)
    ends = np.array([[tip, tip], [tip + 1.5 * radius * normal, tip + (1.5 * radius + 0.1) * normal]])
    tool = np.zeros(2, dtype=np.int64)
    shapes = round_shapes(ends, np.array([radius, 0.5 * radius]), friction=np.ones(2), tool=tool, centre=tip[None])
    shapes.tool_twist[0, :3] = -SPEED * normal
    return shapes


def alone(anatomy: Anatomy, organ: Any, path: int, dt: float, count: int) -> np.ndarray:
    """Force of the same press on the processor in float64 [N], (3,)."""
    state, shapes, wrench = rest_state(organ, shape_count=2), probe(anatomy, path), np.zeros((1, 6))
    for _ in range(PRESS_STEPS):
        advance_organ(organ, state, shapes, anatomy.scene.contact.law, dt, count, wrench, unyielding(1))
    return wrench[0, :3]


def measure(name: str, lanes: int, options: dict[str, Any], steps: int) -> dict[str, Any]:
    """Press, compare four lanes, then time launches with the tips at rest in the tissue."""
    anatomy = load_anatomy(make_scene(name))
    timing, random = anatomy.scene.timing, np.random.default_rng(0)
    organs = [anatomy.organ(), *(anatomy.organ([anatomy.random_lesion(random)]) for _ in range(3))]
    dt = timing.haptic_step / timing.substep_count
    shapes = [probe(anatomy, path) for path in range(min(lanes, PATHS))]
    device = DeviceOrgans(organs[0], lanes, shapes[0], anatomy.scene.contact.law, dt, timing.substep_count, **options)
    device.put(organs, [rest_state(organ, shape_count=2) for organ in organs])
    still = ToolResponse(*(np.stack([array] * lanes) for array in unyielding(1)))
    device.put_tools(stack_shapes([shapes[lane % PATHS] for lane in range(lanes)], lanes), still)
    begin = time.perf_counter()
    device.advance(1)
    cuda.synchronize()
    compiled = time.perf_counter() - begin
    device.advance(PRESS_STEPS - 1)
    forces = device.tools.mean.copy_to_host()[:, 0, :3]
    errors = []
    for lane in range(min(4, lanes)):
        force = alone(anatomy, organs[lane % len(organs)], lane % PATHS, dt, timing.substep_count)
        errors.append(float(np.linalg.norm(forces[lane] - force) / np.linalg.norm(force)))
    device.tools.twist.copy_to_device(np.zeros(device.tools.twist.shape, device.dtype))
    device.advance(2)
    cuda.synchronize()
    times = []
    for _ in range(TIMES if steps > 1 else 1000):
        begin = time.perf_counter()
        device.advance(steps)
        cuda.synchronize()
        times.append((time.perf_counter() - begin) / steps)
    step = float(np.median(times))
    return {
        "scene": name,
        "lanes": lanes,
        "options": {key: getattr(value, "__name__", value) for key, value in options.items()},
        "shared_bytes": device.shared_bytes,
        "blocks": device.block_count,
        "compile_s": compiled,
        "faults": int(np.count_nonzero(device.state.fault.copy_to_host())),
        "force_n": float(np.linalg.norm(forces[0])),
        "force_error_worst": max(errors),
        "lanes_repeat": bool(lanes <= PATHS or all((forces[lane] == forces[lane + PATHS]).all() for lane in range(8))),
        "haptic_step_ms": 1e3 * step,
        "haptic_step_p99_ms": 1e3 * float(np.percentile(times, 99)),
        "control_steps_per_s": lanes / step / timing.haptic_steps_per_control,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/cuda"))
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    device = cuda.get_current_device()
    rows: list[dict[str, Any]] = [{"device": str(device.name), "compute_capability": list(device.compute_capability)}]
    for row in ROWS:
        try:
            rows.append(measure(*row))
        except Exception:
            rows.append({"scene": row[0], "lanes": row[1], "options": str(row[2]), "error": traceback.format_exc()})
        print(json.dumps(rows[-1]), flush=True)
        (out / "organs.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
