"""The press for comparing simulators, a ball on a bonded block: reference force and this project's press."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from msdm_core.kernels import OrganModel
from surgsim_apps.bench.measurement import Cells
from surgsim_apps.validation.finite_press import RIGID, PressedLayer, layer_mesh
from surgsim_apps.validation.punch import DISC, modulus_field
from surgsim_apps.validation.touch import FINE, NEAR
from surgsim_env.coupling import Simulation
from surgsim_env.palpation import press
from surgsim_env.scene import BlockMesh, MeshSource, load_anatomy, make_scene

SIZE = (0.06, 0.06, 0.03)  # [m] of the block, x and y around 0, bottom at z = 0
MODULUS, POISSON, DENSITY = 5000.0, 0.45, 1060.0
RADIUS, DEPTH = 0.008, 0.004  # [m] of the ball, of the press
SPEED, HOLD = 0.04, 0.1  # [m/s] on the way in, [s] at depth
# Places of the ball: over the block's middle, and half a cell of the simulator's own mesh to its side.
PLACES = (0.0, 0.5)


class DivergedError(Exception):
    """Divergence of a peer's simulation, with details in the message."""


@dataclass(frozen=True)
class Pressed:
    """One press: force at its end [N], time on the clock and of the processor [s], simulated time [s]."""

    force: float
    wall: float
    processor: float
    simulated: float


class Clock:
    """Wall clock and processor time since its construction."""

    def __init__(self) -> None:
        self._begin = time.perf_counter(), time.process_time()

    def read(self) -> tuple[float, float]:
        """Wall clock and processor time [s]."""
        return time.perf_counter() - self._begin[0], time.process_time() - self._begin[1]


@dataclass(frozen=True)
class Contender:
    """A simulator at one setting: its name, its settings and mesh in words, and its press.

    `press(offset)` takes the ball's place in cells of its own mesh, the same along x and y. `contact` is the contact
    stiffness of the reference for its force [N/m^3].
    """

    name: str
    setting: str
    mesh: str
    press: Callable[[float], Pressed]
    contact: float = RIGID


def ball_height(when: float) -> float:
    """Height of the ball's lowest point above the resting surface at a time of the press [m]."""
    return -min(SPEED * when, DEPTH)


def step_count(dt: float) -> int:
    """Number of steps of dt [s] in a press."""
    return round((DEPTH / SPEED + HOLD) / dt)


@lru_cache(maxsize=4)
def reference_force(contact: float) -> float:
    """Force of the press by axisymmetric neo-Hookean elements [N]; ImportError without scikit-fem."""
    body = PressedLayer(layer_mesh(DISC, SIZE[2], FINE, NEAR), modulus_field(MODULUS, None), POISSON)
    return body.forces(RADIUS, (DEPTH,), contact)[0]


def organ_press(cells: Cells) -> Contender:
    """This project: the scene `phantom` without its lesion, end to end with its instrument in MuJoCo."""
    scene = make_scene("phantom")
    scene = replace(scene, mesh=MeshSource(block=BlockMesh(SIZE, cells)))
    anatomy = load_anatomy(scene)
    organ = anatomy.organ()
    simulation = Simulation(anatomy)
    # Compiles the kernels, or loads them from the cache.
    _press_organ(simulation, organ, 0.0)
    timing = scene.timing
    return Contender(
        "surgsim",
        f"phantom, {timing.substep_count} explicit substeps in 1 ms, k_p {scene.contact.stiffness:g} N/m3, "
        "alpha 25 1/s, force read every 1 ms",
        f"{len(organ.node_mass)} nodes, {len(organ.tet_nodes)} tets",
        lambda offset: _press_organ(simulation, organ, offset * SIZE[0] / cells[0]),
        scene.contact.stiffness,
    )


def _press_organ(simulation: Simulation, organ: OrganModel, offset: float) -> Pressed:
    up = np.array([0.0, 0.0, 1.0])
    site = np.array([0.5 * SIZE[0] + offset, 0.5 * SIZE[1] + offset, SIZE[2]])
    simulation.reset(organ, site + 0.03 * up)
    clock = Clock()
    pressed = press(simulation, site, up)
    times = clock.read()
    if pressed.end:
        raise DivergedError(pressed.end)
    return Pressed(pressed.force, *times, pressed.duration)
