"""The live view takes as few substeps as a little mass buys, and nobody feels the difference."""

import numpy as np
import pytest

from surgsim_apps.haptics.device import DevicePose
from surgsim_apps.haptics.loop import HapticLoop
from surgsim_apps.haptics.settings import HapticSettings
from surgsim_apps.live.organ_choice import OrganChoice, chosen_organ, live_scene
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.anatomy import ADDED_MASS_SHARE, load_anatomy
from surgsim_env.scene.load import make_scene
from tests.live.protocol_client import press_path


class Follower:
    """A device that is where a path leads, a haptic step later each time."""

    dynamics = None

    def __init__(self, path) -> None:
        self.path, self.time = path, 0.0

    def read(self) -> DevicePose:
        return DevicePose(position=self.path(self.time), time=self.time)

    def write(self, force) -> None:
        self.time += 1e-3


@pytest.mark.slow
def test_fewer_substeps_feel_the_same():
    """A press into the kidney in fewer substeps than 7, all the way in and half the way out."""
    scene = make_scene("kidney_family")
    fewer = live_scene(scene)
    assert fewer.timing.substep_count < scene.timing.substep_count
    forces = []
    for variant in (scene, fewer):
        anatomy = load_anatomy(variant)
        organ = chosen_organ(anatomy, OrganChoice())
        assert organ.added_mass <= ADDED_MASS_SHARE * organ.node_mass.sum()
        simulation, path = Simulation(anatomy), press_path(anatomy)
        simulation.reset(organ, path(0.0))
        loop = HapticLoop(simulation, Follower(path), HapticSettings())
        forces.append([np.linalg.norm(loop.step().tips[0].contact_force) for _ in range(3000)])
    assert max(forces[0]) > 0.1
    np.testing.assert_allclose(forces[1], forces[0], atol=0.001 * max(forces[0]))


@pytest.mark.slow
def test_a_scene_that_needs_its_substeps_keeps_them():
    scene = make_scene("phantom_small")
    assert live_scene(scene).timing.substep_count == scene.timing.substep_count
