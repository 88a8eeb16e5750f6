"""Cost of a substep of an organ alone, and side by side with others: 8 organs in float64, 16 in float32.

    python benchmarks/lanes.py --scene phantom

Balls press the organ of the scene, each at another place; every organ has another lesion. The three runs alternate in
this process. Prints `name value unit` lines: medians of processor time per organ and substep.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from msdm_core.kernels.structure_kernels import FAULT_NONE, ContactLaw, ContactShapes, OrganModel
from msdm_core.lanes.lanes import advance_lanes, rest_lanes, stack_organs, stack_shapes
from msdm_core.organ.compile import rest_state
from msdm_core.organ.stepping import advance_organ, round_shapes
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import make_scene

ROOM = 16  # largest number of lanes
PRESS_DEPTH = 4e-3  # [m]
PRESS_SPEED = 0.02  # [m/s]
HAPTIC_STEP = 1e-3  # [s]


def press_sites(anatomy: Anatomy, model: OrganModel) -> np.ndarray:
    """Places on top of the organ near its middle, another one for each lane, (ROOM, 3) [m]."""
    surface = model.surface_triangles
    corners = model.node_rest_position[surface]
    middle = corners.mean(axis=1)
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0.0
    far = np.linalg.norm(middle[:, :2] - middle[up, :2].mean(axis=0), axis=1) + np.where(up, 0.0, 1.0)
    return middle[np.argsort(far)[:ROOM]]


def ball(site: np.ndarray, radius: float) -> ContactShapes:
    """A ball that touches a site from above and moves down at PRESS_SPEED."""
    centre = site + np.array([0.0, 0.0, radius])
    return round_shapes([[centre, centre]], radius, twist=[0.0, 0.0, -PRESS_SPEED, 0.0, 0.0, 0.0])


class Group:
    """Organs that advance together by one haptic step a call, pressed by PRESS_DEPTH."""

    def __init__(
        self,
        advance: Callable[..., Any],
        model: Any,
        state: Any,
        shapes: ContactShapes,
        law: ContactLaw,
        substeps: int,
        organs: int,
    ) -> None:
        self.organs, self.substeps, self.shapes, self.state = organs, substeps, shapes, state
        self.wrench = np.zeros((*shapes.tool_centre.shape[:-1], 6))
        self.call = lambda: advance(model, state, shapes, law, HAPTIC_STEP / substeps, substeps, self.wrench)
        for _ in range(round(PRESS_DEPTH / PRESS_SPEED / HAPTIC_STEP)):
            fault = self.call()
        self.pressed = self.wrench.copy()
        if np.any(fault != FAULT_NONE):
            raise SystemExit(f"a press of {PRESS_DEPTH * 1e3:g} mm ended in fault {fault}")
        shapes.tool_twist[:] = 0.0

    def substep_seconds(self, calls: int) -> float:
        """Processor time per organ and substep [s]."""
        begin = time.process_time()
        for _ in range(calls):
            self.call()
        return (time.process_time() - begin) / (calls * self.substeps * self.organs)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="phantom")
    parser.add_argument("--rounds", type=int, default=41)
    arguments = parser.parse_args()

    scene = make_scene(arguments.scene)
    anatomy = load_anatomy(scene)
    random = np.random.default_rng(0)
    organs = [anatomy.organ([anatomy.random_lesion(random)]) for _ in range(ROOM)]
    sites, radius, law = press_sites(anatomy, organs[0]), scene.instrument.tip_radius, scene.contact.law
    substeps = scene.timing.substep_count
    alone = rest_state(organs[0], shape_count=1)
    groups = {"single_float64": Group(advance_organ, organs[0], alone, ball(sites[0], radius), law, substeps, 1)}
    for name, dtype, count in (("lanes_float64", np.float64, 8), ("lanes_float32", np.float32, 16)):
        shapes = stack_shapes([ball(site, radius) for site in sites[:count]], count)
        model = stack_organs(organs[:count], dtype=dtype)
        state = rest_lanes(organs[:count], shape_count=1, dtype=dtype)
        groups[name] = Group(advance_lanes, model, state, shapes, law, substeps, count)
    times: dict[str, list[float]] = {name: [] for name in groups}
    for _ in range(arguments.rounds):
        for name, group in groups.items():
            times[name].append(group.substep_seconds(max(1, 16 // group.organs)))
    median = {name: statistics.median(values) for name, values in times.items()}
    print(f"nodes {len(organs[0].node_mass)} -")
    for name, value in median.items():
        print(f"substep_{name} {value * 1e6:.2f} us")
    for name in ("lanes_float64", "lanes_float32"):
        print(f"ratio_{name} {median['single_float64'] / median[name]:.2f} -")
    exact, rounded = groups["lanes_float64"].pressed[:, 0, :3], groups["lanes_float32"].pressed[:8, 0, :3]
    error = np.linalg.norm(rounded - exact, axis=1) / np.linalg.norm(exact, axis=1)
    print(f"force_error_float32 {100.0 * error.max():.4f} %")
    print(f"force_difference_float64 {np.abs(exact[0] - groups['single_float64'].pressed[0, :3]).max():g} N")
    state = groups["lanes_float32"].state
    print(f"memory_lanes_float32 {sum(array.nbytes for array in state) / ROOM / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
