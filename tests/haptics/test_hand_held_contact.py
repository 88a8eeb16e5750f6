"""Hand-held contact takes energy and dies out up to the stiffness promised, and not much beyond it."""

from dataclasses import replace

import numpy as np
import pytest

from surgsim_apps.haptics.coupling import coupling_for, stiffness_limit
from surgsim_apps.haptics.device import DeviceDynamics
from surgsim_apps.haptics.loop import HapticLoop
from surgsim_apps.haptics.settings import HapticSettings
from surgsim_apps.haptics.tip_drive import tip_drives
from tests.haptics.bench_hand import (
    DT,
    START,
    UndeclaredDevice,
    bare_settings,
    held_device,
    run,
    touching_simulation,
)
from tests.haptics.simulated import Hand, SimulatedDevice

# What rounding may give back of some millijoules [J].
ROUNDING = 1e-12
# Once a hand has got so much more than it put in, contact has failed [J]: a press of 0.3 N to 3 mm takes a tenth of it.
GIVEN_FOR_GOOD = -1e-2
# What devices are, and how much of the coupling's damper: little and much damping, light and heavy, late by a sample.
DEVICES = {
    "usual": ({"damping": 0.5}, 0.125),
    "no damper": ({"damping": 0.5}, 0.0),
    "light": ({"damping": 0.1, "mass": 0.01}, 0.025),
    "heavy": ({"damping": 2.0, "mass": 0.3}, 0.5),
    "late pose": ({"damping": 0.5, "pose_delay": 1}, 0.125),
    "late force": ({"damping": 0.5, "force_delay": 1}, 0.125),
}


def limit(simulation, dynamics: DeviceDynamics, damping: float) -> float:
    (drive,) = tip_drives(simulation.instrument, DT)
    return stiffness_limit(dynamics, drive.dynamics, damping, DT)


def pushed(what: dict, damping: float, share: float, count: int) -> tuple[float, float]:
    """A hand pushes, the coupling a share of its limit: least energy held [J], speed in the last fifth [m/s]."""
    simulation = touching_simulation()
    stiffness = share * limit(simulation, held_device(**what).dynamics, damping)
    device = held_device(made=UndeclaredDevice, **what)
    loop = HapticLoop(simulation, device, bare_settings(stiffness, damping))
    least, late_speed = 0.0, 0.0
    for step, telemetry in enumerate(run(loop, device, count)):
        least = min(least, -device.work)
        if least < GIVEN_FOR_GOOD:
            return least, np.inf
        if step > 0.8 * count:
            late_speed = max(late_speed, float(np.abs(device.velocity).max()))
        if telemetry.fault:
            return least, np.inf
    return least, late_speed


@pytest.mark.parametrize("name", DEVICES)
def test_contact_at_the_limit_takes_energy_and_dies_out(name):
    """The loop never gives back more than the hand has put in, at the largest stiffness that is not refused."""
    what, damping = DEVICES[name]
    # Tip and device, 0.23 kg, without a damper halve their speed every 0.8 s.
    least, late_speed = pushed(what, damping, 1.0, 3600)
    assert least >= -ROUNDING
    # The press itself begins at some 90 mm/s.
    assert late_speed < 5e-3


@pytest.mark.parametrize("share", [0.02, 0.2, 0.6])
def test_softer_couplings_take_energy_and_die_out(share):
    """The range reaches down to where the spring is as soft as the tissue (50 N/m at 2 mm) and softer."""
    what, damping = DEVICES["usual"]
    least, late_speed = pushed(what, damping, share, 2000)
    assert least >= -ROUNDING
    assert late_speed < 2e-2


@pytest.mark.parametrize("name", [name for name in DEVICES if name != "heavy"])
def test_limit_is_not_far_from_what_fails(name):
    """Six times the limit gives energy to the hand without end: the limit is worth having.

    It does not know the device's mass, so that it holds for any hand; a heavy device alone bears more.
    """
    what, damping = DEVICES[name]
    least, _ = pushed(what, damping, 6.0, 1500)
    assert least < GIVEN_FOR_GOOD


def tapping(device_mass: float, seconds: float, encoder: float) -> None:
    """A hand taps the phantom once a second with a coupling at its limit; energy is never given, never grows."""
    simulation = touching_simulation()

    def path(time: float) -> np.ndarray:
        # 4.5 mm into the phantom and out again.
        return START - np.array([0.0, 0.0, 2.5e-3 * (1.0 - np.cos(2.0 * np.pi * time))])

    device = SimulatedDevice(
        mass=device_mass,
        damping=0.5,
        haptic_step=DT,
        position=START,
        hand=Hand(stiffness=300.0, damping=1.0),
        path=path,
        encoder=encoder,
    )
    (drive,) = tip_drives(simulation.instrument, DT)
    chosen = coupling_for(device.dynamics, drive.dynamics, DT)
    stiffest = limit(simulation, device.dynamics, chosen.damping)
    loop = HapticLoop(simulation, device, bare_settings(stiffest * (1.0 - 1e-9), chosen.damping))
    peaks, taken, largest = [], [], 0.0
    for step, telemetry in enumerate(run(loop, device, round(seconds / DT))):
        assert not telemetry.fault
        # Rounded to its encoder the device's place is off by half a count: that much work at the force that acts.
        slack = ROUNDING + encoder * float(np.abs(telemetry.tip.force).sum())
        assert -device.work >= -slack
        # What the loop tells is what the handle had, but for what an encoder hides from the loop.
        assert encoder or telemetry.tip.energy == pytest.approx(-device.work, abs=ROUNDING)
        largest = max(largest, device.energy())
        if (step + 1) % 1000 == 0:
            peaks.append(largest)
            taken.append(-device.work)
            largest = 0.0
    # After the first, gentle taps each is as the one before, and takes energy.
    assert max(peaks[2:]) < 1.01 * peaks[1]
    assert (np.diff(taken[1:]) > 0.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("encoder", [0.0, 2e-5])
def test_ten_seconds_of_tapping_give_no_energy(encoder):
    tapping(0.05, 10.0, encoder)


@pytest.mark.slow
def test_holding_dies_out():
    """A hand that pushes steadily, with no damping of its own: after ten seconds nothing moves any more."""
    simulation = touching_simulation()
    device = held_device()
    coupling = bare_settings((1.0 - 1e-9) * limit(simulation, device.dynamics, 0.125), 0.125)
    loop = HapticLoop(simulation, device, coupling)
    fastest = []
    for step, telemetry in enumerate(run(loop, device, 60_000)):
        assert not telemetry.fault
        assert -device.work >= -ROUNDING
        if step % 10_000 == 0:
            fastest.append(0.0)
        fastest[-1] = max(fastest[-1], float(np.abs(device.velocity).max()))
    assert max(fastest[1:]) < 1e-6


@pytest.mark.slow
def test_hand_feels_what_the_tissue_gives():
    """At rest the force on the device is the tissue's on the tip: the servo pushes as the coupling says."""
    simulation = touching_simulation()
    device = held_device()
    loop = HapticLoop(simulation, device, HapticSettings())
    *_, telemetry = run(loop, device, 6000)
    tip = telemetry.tip
    np.testing.assert_allclose(tip.force, tip.contact_force, atol=2e-6)
    np.testing.assert_allclose(tip.force, [0.0, 0.0, 0.3], atol=2e-6)
    # Both ends of the spring: the tip lags by F / K.
    lag = 0.3 / loop.held[0].coupling.stiffness
    assert tip.tip[2] - device.position[2] == pytest.approx(lag, abs=1e-7)
    # The ball of 8 mm stood 0.5 mm over the face.
    assert tip.depth == pytest.approx(START[2] - 5e-4 - tip.tip[2], abs=1e-9)


def test_clamped_coupling_takes_energy_too():
    """A hand of 2 N against a coupling held at 1 N: a spring that gives way gives no energy either."""
    simulation = touching_simulation()
    device = held_device(hand=Hand(stiffness=200.0, damping=2.0), path=lambda time: START - [0, 0, min(0.02, time)])
    settings = replace(bare_settings(400.0, 0.125), force_largest=1.0)
    loop = HapticLoop(simulation, device, settings)
    for telemetry in run(loop, device, 1500):
        assert np.linalg.norm(telemetry.tip.force) <= 1.0 + 1e-12
        assert -device.work >= -ROUNDING
    assert telemetry.tip.clamped
    assert np.linalg.norm(telemetry.tip.force) == pytest.approx(1.0)


def tapped_with_a_cut(settings: HapticSettings) -> tuple[np.ndarray, np.ndarray, float]:
    """A hand taps once a second, its link is cut for 0.2 s: energy held, energy of the hand, bound [J]."""
    device = held_device(
        hand=Hand(stiffness=300.0, damping=1.0),
        path=lambda time: START - np.array([0.0, 0.0, 2.5e-3 * (1.0 - np.cos(2.0 * np.pi * time))]),
    )
    loop = HapticLoop(touching_simulation(), device, settings)
    held, hand, force, acted = [], [], 0.0, set()
    for step, telemetry in enumerate(run(loop, device, 5000)):
        assert not telemetry.fault
        device.linked = not 1900 <= step < 2100
        held.append(-device.work)
        hand.append(device.energy())
        force = max(force, float(np.linalg.norm(telemetry.tip.coupling_force)))
        acted |= {name for name in ("faded", "approaching") if getattr(telemetry.tip, name)}
    assert acted == {"faded", "approaching"}
    return np.array(held), np.array(hand), force**2 / (2.0 * loop.held[0].coupling.stiffness)


@pytest.mark.slow
def test_contact_as_shipped_gives_at_most_what_the_spring_holds():
    """Coupling, slew limit, watchdog and slow approach as shipped: K e^2 / 2 = F^2 / 2 K each time that one acts."""
    held, hand, bound = tapped_with_a_cut(HapticSettings())
    # The start alone has acted, then the cut and the return too.
    assert held[:1900].min() >= -bound
    assert held.min() >= -3.0 * bound
    # Beyond them each tap takes energy, and none is harder than the one before the cut.
    peaks = hand.reshape(5, 1000).max(axis=1)
    assert peaks[3:].max() < 1.01 * peaks[1]
    assert held[4999] > held[3999] > held[2999]


@pytest.mark.slow
def test_a_slew_limit_that_always_acts_gives_more():
    """The bound of the test above can be missed."""
    held, _, bound = tapped_with_a_cut(HapticSettings(slew_largest=0.5))
    assert held.min() < -10.0 * bound
