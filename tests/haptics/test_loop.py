"""The loop: broken links, poses that jump, organs that come to grief, limits that act; all is told, nothing raises."""

import math

import mujoco
import numpy as np
import pytest

from surgsim_apps.haptics.device import DeviceDynamics, DevicePose
from surgsim_apps.haptics.loop import HapticLoop, SlewLimit, Watchdog
from surgsim_apps.haptics.settings import HapticSettings
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from tests.haptics.bench_hand import DT, START, bare_settings, held_device, run, touching_simulation
from tests.haptics.simulated import Hand, SimulatedDevice

DOWN = np.array([0.0, 0.0, -1.0])


class Puppet:
    """A device that goes where a test says, and does not push."""

    dynamics: DeviceDynamics | None = None

    def __init__(self, place=START):
        self.place = np.array(place, dtype=np.float64)
        self.buttons = 0
        self.linked, self.broken = True, False
        self.force = np.zeros(3)
        self._time = 0.0

    def read(self):
        self._time += DT
        if self.broken:
            raise OSError("unplugged")
        return DevicePose(self.place.copy(), self._time, self.buttons) if self.linked else None

    def write(self, force):
        if self.broken:
            raise OSError("unplugged")
        self.force = force.copy()


def pressed(settings: HapticSettings | None = None) -> tuple[HapticLoop, SimulatedDevice]:
    """A hand at rest that presses the phantom 3 mm deep."""
    device = held_device(hand=Hand(300.0, 2.0), path=lambda time: START + DOWN * min(0.005, 0.02 * time))
    loop = HapticLoop(touching_simulation(), device, settings)
    for _ in run(loop, device, 1200):
        pass
    return loop, device


def test_cut_link_fades_and_comes_back_gently():
    """50 ms after the last pose the force goes to zero along a line of 100 ms; it comes back along one of 500 ms."""
    loop, device = pressed()
    before = float(np.linalg.norm(device.force))
    assert before > 0.15
    device.linked = False
    # The hand's simulation goes on; a hand that lets go would lift the tip, so the device is held where it is.
    forces = np.array([np.linalg.norm(loop.step().tip.force) for _ in range(160)])
    np.testing.assert_allclose(forces[:48], before, rtol=0.02)
    assert forces[48] == pytest.approx(before, rel=0.02)
    # Silent for 50 steps: the fiftieth is the first to fade, by a hundredth of it all.
    np.testing.assert_allclose(forces[49:148], before * (1.0 - np.arange(1, 100) / 100.0), rtol=0.03, atol=1e-9)
    np.testing.assert_allclose(forces[149:], 0.0, atol=1e-12)
    telemetry = loop.step()
    assert telemetry.tip.faded and telemetry.tip.approaching and not telemetry.tip.fresh and not telemetry.fault
    # The tip stays in the organ where the last pose held it.
    assert telemetry.tip.depth == pytest.approx(3.4e-3, abs=4e-4)
    device.linked = True
    back = np.array([np.linalg.norm(loop.step().tip.force) for _ in range(520)])
    assert np.diff(back, prepend=0.0).max() < 1.1 * before / 500.0
    assert back[-1] == pytest.approx(before, rel=0.02)


def test_device_that_comes_back_elsewhere_is_approached_slowly():
    device = Puppet()
    loop = HapticLoop(touching_simulation(), device, HapticSettings(approach_speed=0.05, smoothing=0.0))
    for _ in range(10):
        loop.step()
    device.linked = False
    for _ in range(60):
        loop.step()
    device.linked, device.place = True, START + np.array([0.004, 0.0, 0.010])
    way = np.array([loop.step().tip.target for _ in range(300)])
    speed = np.linalg.norm(np.diff(way, axis=0), axis=1) / DT
    assert speed.max() <= 0.05 + 1e-9
    np.testing.assert_allclose(way[-1], device.place, atol=1e-12)


def test_pose_that_jumps_does_not_throw_the_tip():
    """A hand's breadth in a millisecond: the tip follows at the largest speed, the force stays in its clamp."""
    device = Puppet()
    loop = HapticLoop(touching_simulation(), device, HapticSettings(speed_largest=0.5, smoothing=0.0))
    for _ in range(700):
        loop.step()
    device.place = START + DOWN * 0.1
    telemetry = [loop.step() for _ in range(40)]
    assert telemetry[0].tip.speed_limited and not telemetry[0].tip.approaching
    steps = np.linalg.norm(np.diff([record.tip.target for record in telemetry], axis=0), axis=1)
    assert steps.max() == pytest.approx(0.5 * DT)
    assert any(record.tip.clamped for record in telemetry)
    assert max(np.linalg.norm(record.tip.coupling_force) for record in telemetry) <= 3.0 + 1e-12
    change = np.diff([record.tip.force for record in telemetry], axis=0)
    assert np.linalg.norm(change, axis=1).max() <= 500.0 * DT + 1e-12


@pytest.mark.parametrize("place", [math.nan, math.inf, -math.inf, 1e9])
def test_pose_that_is_no_place_is_refused_and_counted(place):
    device = Puppet()
    loop = HapticLoop(touching_simulation(), device)
    good = [loop.step() for _ in range(5)][-1]
    device.place = np.array([START[0], place, START[2]])
    telemetry = [loop.step() for _ in range(120)]
    assert telemetry[-1].tip.refused_pose_count == 120
    # As good as none: the link counts as lost.
    assert telemetry[-1].tip.share == 0.0
    np.testing.assert_array_equal(telemetry[-1].tip.target, good.tip.target)
    assert np.isfinite(telemetry[-1].tip.tip).all() and not telemetry[-1].fault


def test_device_that_breaks_is_a_link_that_is_lost():
    device = Puppet()
    loop = HapticLoop(touching_simulation(), device)
    for _ in range(20):
        loop.step()
    device.broken = True
    telemetry = [loop.step() for _ in range(200)]
    assert all("unplugged" in record.tip.device_fault for record in telemetry)
    assert telemetry[-1].tip.share == 0.0 and not telemetry[-1].fault
    device.broken = False
    assert loop.step().tip.device_fault == ""


def test_organ_that_comes_to_grief_lets_go_and_can_be_reset():
    """A probe through the phantom: force zero in the same step, the clock stands, nothing raises; reset goes on."""
    device = Puppet()
    settings = HapticSettings(force_largest=19.0, slew_largest=1e5, resume=DT, approach_speed=1.0, smoothing=0.0)
    loop = HapticLoop(touching_simulation(), device, settings)
    loop.step()
    device.place = START + DOWN * 0.05
    for _ in range(400):
        telemetry = loop.step()
        if telemetry.fault:
            break
    assert "inside out" in telemetry.fault or "passed" in telemetry.fault or "beyond" in telemetry.fault
    np.testing.assert_array_equal(telemetry.tip.force, 0.0)
    np.testing.assert_array_equal(device.force, 0.0)
    stopped = telemetry.time
    later = [loop.step() for _ in range(20)][-1]
    assert later.time == stopped and later.fault == telemetry.fault
    np.testing.assert_array_equal(device.force, 0.0)
    assert later.tip.fresh
    device.place = START
    loop.reset(tip_position=START)
    assert loop.fault == ""
    telemetry = [loop.step() for _ in range(50)][-1]
    assert telemetry.time == pytest.approx(0.05) and not telemetry.fault and telemetry.tip.energy == 0.0


def test_a_warning_of_mujoco_lets_go():
    loop, device = pressed()
    assert np.linalg.norm(device.force) > 0.1
    loop.simulation.instrument.data.warning[mujoco.mjtWarning.mjWARN_BADQVEL].number += 1
    telemetry = loop.step()
    assert telemetry.fault == "MuJoCo warning mjWARN_BADQVEL"
    np.testing.assert_array_equal(telemetry.tip.force, 0.0)
    np.testing.assert_array_equal(device.force, 0.0)
    loop.reset(tip_position=START)
    assert not loop.step().fault


def test_slew_limit_says_when_it_acts():
    loop, device = pressed(HapticSettings(slew_largest=1.0))
    assert not loop.step().tip.slewed
    device.position = device.position + DOWN * 1e-3
    device._poses.append(device.position)
    before = loop.step().tip
    assert before.slewed
    after = loop.step().tip
    assert np.linalg.norm(after.force - before.force) == pytest.approx(1.0 * DT)


def test_slew_limit_keeps_the_direction():
    slew = SlewLimit(100.0, DT)
    force, held = slew.follow(np.array([3.0, 4.0, 0.0]))
    assert held
    np.testing.assert_allclose(force, [0.06, 0.08, 0.0])
    force, held = slew.follow(np.array([0.06, 0.08, 0.05]))
    assert not held
    np.testing.assert_array_equal(force, [0.06, 0.08, 0.05])


def test_watchdog_counts_whole_steps():
    watchdog = Watchdog(HapticSettings(timeout=0.05, fade=0.1, resume=0.001), DT)
    assert watchdog.expired and watchdog.step(False) == 0.0
    assert watchdog.step(True) == 1.0
    shares = [watchdog.step(False) for _ in range(150)]
    assert shares[:49] == [1.0] * 49
    np.testing.assert_allclose(shares[49:149], 1.0 - np.arange(1, 101) / 100.0, atol=1e-12)
    # A pose now and then is enough.
    watchdog.step(True)
    for _ in range(10):
        assert [watchdog.step(step == 48) for step in range(49)][-1] == 1.0


def test_relative_device_begins_at_the_tip():
    device = Puppet(np.array([0.3, -0.2, 0.7]))
    loop = HapticLoop(touching_simulation(), device, HapticSettings(relative=True, smoothing=0.0))
    np.testing.assert_allclose(loop.step().tip.target, START, atol=1e-15)
    device.place = device.place + np.array([0.001, 0.0, 0.002])
    for _ in range(100):
        telemetry = loop.step()
    np.testing.assert_allclose(telemetry.tip.target, START + np.array([0.001, 0.0, 0.002]), atol=1e-12)


def test_loop_repeats_to_the_bit():
    def forces() -> np.ndarray:
        device = held_device()
        loop = HapticLoop(touching_simulation(), device)
        return np.array([telemetry.tip.force for telemetry in run(loop, device, 300)])

    np.testing.assert_array_equal(forces(), forces())


def test_button_closes_the_jaw():
    simulation = Simulation(load_anatomy(make_scene("lobe")))
    device = Puppet(simulation.instrument.parked)
    loop = HapticLoop(simulation, device)
    loop.step()
    open_gap = simulation.instrument.jaw.opening
    device.buttons = 1
    for _ in range(300):
        assert not loop.step().fault
    assert simulation.instrument.jaw.opening < open_gap - 5e-3
    device.buttons = 0
    for _ in range(300):
        loop.step()
    assert simulation.instrument.jaw.opening == pytest.approx(open_gap, abs=1e-3)


@pytest.mark.parametrize(
    ("device", "settings", "named"),
    [
        (held_device(), bare_settings(900.0), "800 N/m"),
        (held_device(), HapticSettings(force_largest=25.0), "25 N"),
        ([held_device(), held_device()], None, "2 devices"),
    ],
)
def test_what_cannot_be_coupled_is_refused_at_construction(device, settings, named):
    simulation = touching_simulation()
    with pytest.raises(ValueError, match=named):
        HapticLoop(simulation, device, settings)
    HapticLoop(simulation, held_device(), bare_settings(700.0))


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: HapticSettings(slew_largest=math.nan), "slew_largest is nan"),
        (lambda: HapticSettings(timeout=-1.0), "timeout is -1"),
        (lambda: held_device(pose_delay=-1), "pose_delay -1"),
    ],
)
def test_bad_settings_are_refused(make, named):
    with pytest.raises(ValueError, match=named):
        make()
