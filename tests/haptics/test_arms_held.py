"""Arms in a hand: tips follow through inverse kinematics, the hand feels the tissue."""

import numpy as np

from surgsim_apps.haptics.loop import HapticLoop
from surgsim_apps.haptics.tip_drive import STEER_TIME
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene, with_instrument
from tests.haptics.simulated import Hand, SimulatedDevice

DT = 1e-3


def held_arms(scene: str, instrument: str, ways: list, hand: Hand) -> tuple[HapticLoop, list[SimulatedDevice]]:
    """Each tip in a hand that goes some way [m] from where the tip parks, within a third of a second."""
    simulation = Simulation(load_anatomy(with_instrument(make_scene(scene), instrument)))
    places = np.atleast_2d(simulation.instrument.parked)
    devices = [
        SimulatedDevice(
            mass=0.05,
            damping=0.5,
            haptic_step=DT,
            position=place,
            hand=hand,
            path=lambda time, place=place, way=way: place + np.asarray(way) * min(1.0, 3.0 * time),
        )
        for place, way in zip(places, ways, strict=True)
    ]
    return HapticLoop(simulation, devices), devices


def test_arm_follows_its_hand_and_feels_what_the_tissue_gives():
    loop, (device,) = held_arms("phantom_small", "psm_palpator", [[0.0, 0.0, -0.0125]], Hand(300.0, 2.0))
    for _ in range(1500):
        telemetry = loop.step()
        device.advance()
    tip = telemetry.tip
    assert not telemetry.fault
    assert tip.contact_force[2] > 0.05
    # At rest the point that the arm follows is pulled as hard by the coupling as it is pushed by the tissue.
    np.testing.assert_allclose(tip.force, tip.contact_force, atol=2e-3)
    # The arm gives way to that by its servos' compliance, some 0.1 mm.
    np.testing.assert_allclose(tip.tip, loop.held[0].drive.position, atol=2e-4)
    # The instrument of 150 g and 4 N s/m takes energy.
    assert tip.energy > 0.0


def test_arm_lags_by_its_steering_alone():
    loop, (device,) = held_arms("phantom_small", "psm_palpator", [[0.006, 0.0, 0.0]], Hand(2000.0, 20.0))
    for _ in range(250):
        telemetry = loop.step()
        device.advance()
    # 18 mm/s: behind by less than the time that it takes to catch up, and ten steps.
    behind = loop.held[0].drive.position - telemetry.tip.tip
    assert np.linalg.norm(behind) < 0.018 * (STEER_TIME + 10 * DT)


def test_two_hands_move_two_arms():
    loop, devices = held_arms("lobe", "psm_pair", [[0.0, 0.0, 0.006], [0.004, 0.0, 0.006]], Hand(1000.0, 10.0))
    start = [held.drive.tool.tip_position for held in loop.held]
    for _ in range(600):
        telemetry = loop.step()
        for device in devices:
            device.advance()
    assert not telemetry.fault and len(telemetry.tips) == 2
    moved = [tip.tip - place for tip, place in zip(telemetry.tips, start, strict=True)]
    np.testing.assert_allclose(moved, [[0.0, 0.0, 0.006], [0.004, 0.0, 0.006]], atol=1.5e-3)
