"""Simulations to draw, and the question whether this machine can draw."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from msdm_core.material.regions import Lesion
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.rendering import gl
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skip where nothing can be drawn, with the reason."""
    try:
        gl.context()
    except gl.NoGLError as error:
        pytest.skip(f"no pictures on this machine: {error}")


@dataclass(frozen=True)
class Press:
    """A simulation with the tip above a lesion; `press` moves it into the organ."""

    simulation: Simulation
    lesion: Lesion
    outward: np.ndarray

    def press(self, depth: float) -> None:
        """Go in at 20 mm/s until the tip is so deep below the undeformed surface [m]."""
        simulation = self.simulation
        simulation.instrument.command_velocity(-0.02 * self.outward)
        assert simulation.control_step(round(depth / 0.02 / simulation.haptic_dt)) < 10.0 and not simulation.fault
        assert simulation.end_control_step()


@pytest.fixture(scope="session")
def make_press() -> Callable[[str], Press]:
    """A function from a scene's name to a simulation of it with the tip 1 mm above its first lesion."""

    def make(scene: str) -> Press:
        anatomy = load_anatomy(make_scene(scene))
        lesion = anatomy.demonstration_lesions()[0]
        simulation = Simulation(anatomy)
        point, outward = anatomy.face.project(lesion.centre)
        start = point + outward * (anatomy.scene.instrument.tip_radius + 0.001)
        simulation.reset(anatomy.organ([lesion]), start)
        return Press(simulation, lesion, outward)

    return make


@pytest.fixture(params=["phantom", "liver"])
def press(request, make_press) -> Press:
    return make_press(request.param)


@pytest.fixture
def phantom(make_press) -> Press:
    return make_press("phantom")
