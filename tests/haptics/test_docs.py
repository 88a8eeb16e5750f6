"""docs/haptics.md: its Python runs as printed, its tables hold what the code has."""

import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from surgsim_env.haptics.coupling import TipDynamics, stiffness_limit
from surgsim_env.haptics.device import DeviceDynamics
from surgsim_env.haptics.loop import HapticLoop
from surgsim_env.haptics.settings import ForceLimits, HapticSettings, WatchdogTimes
from surgsim_env.haptics.udp import FORCE, POSE, UdpDevice
from tests.haptics.bench_hand import DT, touching_simulation

DOCS = (Path(__file__).resolve().parents[2] / "docs" / "haptics.md").read_text(encoding="utf-8")
PRESS, BRIDGE = re.findall(r"```python\n(.*?)```", DOCS, flags=re.S)


def test_the_example_presses(capsys):
    exec(compile(PRESS, "docs/haptics.md", "exec"), {})
    force, depth = re.fullmatch(r"(\S+) N at (\S+) mm\n", capsys.readouterr().out).groups()
    assert 0.1 < float(force) < 0.5
    assert 3.0 < float(depth) < 4.5


class Turns:
    """What the bridge takes for the module `time`: while it sleeps, the loop makes a step."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, span: float) -> None:
        assert span == pytest.approx(DT)
        self.now += span
        assert not self.step()


def test_the_bridge_feels_the_press():
    """The printed bridge and a loop, a step each in turn: it is answered, and pushes nothing at its end."""
    names: dict = {}
    exec(compile(BRIDGE, "docs/haptics.md", "exec"), names)
    names["time"] = turns = Turns()
    device = UdpDevice(clock=turns.monotonic)
    loop = HapticLoop(touching_simulation(), device, HapticSettings(relative=True, watchdog=WatchdogTimes(resume=0.01)))
    felt: list[tuple] = []
    way = iter(np.linspace(0.0, 0.006, 600))
    turns.step = lambda: loop.step().fault
    names["bridge"](lambda: (0.0, 0.0, -next(way, 0.006)), felt.append, device.address[1], 1.5)
    device.close()
    assert max(force[2] for force in felt) > 0.1
    assert felt[-1] == (0.0, 0.0, 0.0)
    assert device.counts.malformed == 0


def rows(first_cell: str) -> list[str]:
    (row,) = re.findall(rf"^\| {re.escape(first_cell)} \|(.*)\|$", DOCS, flags=re.M)
    return [cell.strip() for cell in row.split("|")]


def test_table_of_limits_is_computed():
    dampings = [float(cell) for cell in rows("device damping $b_d$")[:-1]]
    for name, delay in (("limit, no delay, $B = b_d / 4$", 0.0), ("1 ms of delay", 1e-3), ("3 ms of delay", 3e-3)):
        printed = [float(cell) for cell in rows(name)[:-1]]
        tip = TipDynamics(0.14, 2.0)
        computed = [stiffness_limit(DeviceDynamics(b, 0.05, delay), tip, b / 4.0, DT) for b in dampings]
        np.testing.assert_allclose(printed, computed, atol=0.5)


def test_printed_defaults_are_the_codes():
    settings, limits, times = HapticSettings(), ForceLimits(), WatchdogTimes()
    assert rows("force of the coupling, on tip and device")[0] == f"{limits.force_largest:g} N"
    assert rows("change of the device's force")[0] == f"{limits.slew_largest:g} N/s"
    fades = f"after {times.timeout * 1e3:g} ms, to zero in {times.fade * 1e3:g} ms"
    assert rows("no fresh pose: the force fades")[0] == fades
    assert rows("poses again: the force returns")[0] == f"within {times.resume * 1e3:g} ms"
    assert rows("speed of the tip following a device")[0] == f"{settings.speed_largest:g} m/s"
    assert f"{settings.approach_speed * 1e3:g} mm/s" in DOCS


def test_every_setting_is_named():
    for named in (ForceLimits(), WatchdogTimes()):
        for name in asdict(named):
            assert f".{name}`" in DOCS, name


def test_packets_are_as_long_as_printed():
    assert f"pose, {POSE.size} bytes" in DOCS and f"force, {FORCE.size} bytes" in DOCS
