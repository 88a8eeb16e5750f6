"""A simulated hand that presses a small phantom through a coupling: what several tests and the figure run."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_apps.haptics.coupling import VirtualCoupling
from surgsim_apps.haptics.loop import HapticLoop
from surgsim_apps.haptics.settings import HapticSettings
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import make_scene
from tests.haptics.simulated import Hand, SimulatedDevice

DT = 1e-3
# The tip half a millimetre above the middle of the phantom's top.
START = np.array([0.02, 0.02, 0.0285])
# So that neither clamp nor slew nor the gentle start hides an oscillation.
UNLIMITED = HapticSettings(force_largest=15.0, slew_largest=1e5, resume=DT, smoothing=0.0)


@cache
def phantom() -> tuple[Anatomy, OrganModel]:
    anatomy = load_anatomy(make_scene("phantom_small"))
    return anatomy, anatomy.organ(anatomy.demonstration_lesions())


def touching_simulation(place: FloatArray = START) -> Simulation:
    anatomy, organ = phantom()
    simulation = Simulation(anatomy)
    simulation.reset(organ, place)
    return simulation


def bare_settings(stiffness: float, damping: float = 0.0) -> HapticSettings:
    return replace(UNLIMITED, coupling=VirtualCoupling(stiffness, damping))


class UndeclaredDevice(SimulatedDevice):
    """Pushes and does not say so: then nothing refuses a coupling that is too stiff for it."""

    @property
    def dynamics(self) -> None:
        return None


def held_device(damping: float = 0.5, mass: float = 0.05, made=SimulatedDevice, **rest) -> SimulatedDevice:
    """By default a hand that pushes down with 0.3 N and has no damping of its own: the worst that can hold a device."""
    hand = rest.pop("hand", Hand(push=(0.0, 0.0, -0.3)))
    return made(mass=mass, damping=damping, haptic_step=DT, position=START, hand=hand, **rest)


def run(loop: HapticLoop, device: SimulatedDevice, count: int):
    """The loop's telemetry, step by step, the device moving along."""
    for _ in range(count):
        yield loop.step()
        device.advance()


def save_trajectory(path: Path, time: FloatArray, position: FloatArray) -> None:
    """A file of times [s], (n,), and places [m], (n, 3), with all digits."""
    np.savetxt(path, np.column_stack([time, position]), fmt="%.17g", delimiter=",", header="time,x,y,z", comments="")
