"""A hand on a patient who breathes: it feels the breath, holds it by a button, and feels none while it is held."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from surgsim_apps.haptics.loop import HapticLoop
from surgsim_apps.haptics.settings import BREATH_BIT, HapticSettings
from surgsim_apps.haptics.trajectory import TrajectoryDevice
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import CyclicMotion
from tests.haptics.bench_hand import DT, START, held_device, run
from tests.haptics.simulated import Hand

# Towards the tip, so that a breath is a deeper press [m].
RISE = 0.002
BREATH = CyclicMotion("breathing", (0.0, 0.0, RISE), period=(1.2, 1.2), rise=0.4, fall=0.4, stops_in_apnoea=True)
BEAT = CyclicMotion("heartbeat", (0.0, 0.0, 0.0002), period=(0.4, 0.4), rise=0.3, fall=0.3)
# The tip's centre above the surface at rest, and how deep a hand presses [m].
AWAY, DEPTH = 0.0005, 0.003
# When the hand has come to rest on the surface [s].
SETTLED = 1.0


@pytest.fixture(scope="module")
def anatomy() -> Anatomy:
    return load_anatomy(replace(make_scene("phantom_small"), motions=(BREATH, BEAT)))


class Felt(NamedTuple):
    """Of each step from SETTLED on: force on the hand out of the organ [N], depth, tip and ground's shift [m]."""

    force: np.ndarray
    depth: np.ndarray
    tip: np.ndarray
    ground: np.ndarray


def felt(anatomy: Anatomy, seconds: float, *, held: bool = False, deeper: float = 0.0) -> Felt:
    """Records of a stiff hand that goes down to DEPTH, or deeper, and stays there."""
    simulation = Simulation(anatomy)
    simulation.hold_breath(held)
    simulation.reset(anatomy.organ(), START)
    down = np.array([0.0, 0.0, AWAY + DEPTH + deeper])
    device = held_device(
        hand=Hand(stiffness=3000.0, damping=5.0), path=lambda time: START - down * min(1.0, time / (0.6 * SETTLED))
    )
    rows = []
    for telemetry in run(HapticLoop(simulation, device), device, round((SETTLED + seconds) / DT)):
        assert not telemetry.fault
        tip = telemetry.tip
        rows.append((tip.force[2], tip.depth, tip.tip[2], simulation.ground_shift(tip.tip)[2]))
    assert simulation.holds_breath == held
    return Felt(*np.array(rows[round(SETTLED / DT) :]).T)


@pytest.fixture(scope="module")
def breathing(anatomy) -> Felt:
    return felt(anatomy, 2.5)


@pytest.fixture(scope="module")
def apnoea(anatomy) -> Felt:
    return felt(anatomy, 2.5, held=True)


def test_a_hand_that_is_held_still_feels_the_breath(anatomy, breathing):
    """At the top of a breath as much as a hand that is so much deeper in a patient who holds still."""
    still = load_anatomy(replace(anatomy.scene, motions=()))
    rest, risen = (felt(still, 0.3, deeper=deeper).force[-1] for deeper in (0.0, breathing.ground.max()))
    assert risen - rest > 0.1
    # The tissue's damping at up to 10 mm/s adds some hundredths.
    assert breathing.force.min() == pytest.approx(rest, abs=0.06 * (risen - rest))
    assert breathing.force.max() == pytest.approx(risen, abs=0.06 * (risen - rest))


def test_in_apnoea_the_force_is_steady_but_for_the_heart(breathing, apnoea):
    # A beat is a tenth of a breath, and quicker.
    assert 0.0 < np.ptp(apnoea.force) < 0.2 * np.ptp(breathing.force)
    assert np.ptp(apnoea.ground) == pytest.approx(BEAT.displacement[2], rel=1e-6)
    # The force of one beat is that of the next.
    beat = round(BEAT.period[0] / DT)
    np.testing.assert_allclose(apnoea.force[-beat:], apnoea.force[-2 * beat : -beat], rtol=2e-3)


def test_depth_is_below_the_resting_surface_as_the_ground_has_carried_it(breathing):
    """Of a ball below a plane: r - (z - z_surface)."""
    surface, radius = 0.020, 0.008
    assert np.ptp(breathing.ground) > RISE and breathing.depth.min() > 0.0
    np.testing.assert_allclose(breathing.depth, surface + breathing.ground + radius - breathing.tip, atol=1e-12)


def test_a_button_holds_the_breath_while_it_is_pressed(anatomy):
    """Only where the settings name one; a device that is lost asks for nothing."""
    simulation = Simulation(anatomy)
    pressed = [0, 1 << BREATH_BIT, 1 << BREATH_BIT, 1]
    place = np.tile(START, (len(pressed), 1))
    place[2] = np.nan
    for button in (BREATH_BIT, None):
        simulation.reset(anatomy.organ(), START)
        device = TrajectoryDevice(0.01 * np.arange(4), place, pressed)
        loop = HapticLoop(simulation, device, HapticSettings(breath_button=button))
        held = []
        for _ in range(40):
            assert not loop.step().fault
            held.append(simulation.holds_breath)
        assert held == [button is not None and 10 <= step < 30 for step in range(40)]
    # What a script holds stays held.
    simulation.hold_breath(True)
    loop.reset()
    loop.step()
    assert simulation.holds_breath
