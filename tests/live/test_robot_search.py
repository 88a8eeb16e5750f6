"""The robot's search on the live page: it finds a lesion by touches, whatever the tissue around."""

from types import SimpleNamespace

import numpy as np
import pytest

from surgsim_apps.live.organ_choice import HIDDEN, OrganChoice, chosen_lesions, chosen_organ
from surgsim_apps.live.robot_search import PRESSES, RobotSearch
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.palpation.site_press import press
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene


class PressedSession:
    """A session whose touches are presses of its organ, done at once."""

    def __init__(self, anatomy, choice: OrganChoice) -> None:
        self.anatomy, self.places = anatomy, []
        self._simulation, radius = Simulation(anatomy), anatomy.scene.instrument.tip_radius
        self._simulation.reset(chosen_organ(anatomy, choice), anatomy.face.project(np.zeros(3))[0] + radius)
        self.felt = None

    def touch(self, arm, place, outward, depth) -> None:
        self.places.append(place)
        self.felt = press(self._simulation, place, outward)

    def lift(self, arm) -> None:
        self.felt = None

    def touches(self, arm) -> bool:
        return self.felt is not None


@pytest.mark.parametrize(("seed", "modulus_factor"), [(1, 1.0), (2, 1.0), (3, 1.5)])
def test_the_robot_finds_a_hidden_lesion(seed, modulus_factor):
    anatomy = load_anatomy(make_scene("phantom_small"))
    choice = OrganChoice(modulus_factor=modulus_factor, lesions=HIDDEN, seed=seed)
    session = PressedSession(anatomy, choice)
    robot = RobotSearch(session)  # type: ignore[arg-type]
    moment, force_peak = 0.0, 0.0
    while robot.go_on():
        moment += 0.05
        if session.felt is not None:
            robot.feel(moment, session.felt.depth, session.felt.force)
            force_peak = max(force_peak, session.felt.force)
    assert len(session.places) == robot.presses == PRESSES and robot.force_peak == force_peak
    assert len(np.unique(np.round(session.places, 6), axis=0)) == PRESSES
    centre = chosen_lesions(anatomy, choice)[0].centre
    assert centre is not None
    truth, _ = anatomy.face.project(centre)
    assert robot.place is not None and np.linalg.norm(robot.place - truth) < 0.005


def test_a_press_without_depth_ends():
    anatomy = load_anatomy(make_scene("phantom_small"))
    session = SimpleNamespace(anatomy=anatomy, touch=lambda *_: None, lift=lambda _: None, touches=lambda _: False)
    robot = RobotSearch(session)  # type: ignore[arg-type]
    moment = 0.0
    while robot.go_on():
        moment += 0.1
        robot.feel(moment, 0.0, 0.0)
    assert robot.presses == PRESSES and robot.place is not None and np.isfinite(robot.place).all()
