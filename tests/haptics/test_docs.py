"""The Python of docs/haptics.md runs as printed."""

import re
from pathlib import Path

import numpy as np
import pytest

from surgsim_apps.haptics.loop import HapticLoop
from surgsim_apps.haptics.settings import HapticSettings
from surgsim_apps.haptics.udp import UdpDevice
from tests.haptics.bench_hand import DT, touching_simulation

DOCS = (Path(__file__).resolve().parents[2] / "docs" / "haptics.md").read_text(encoding="utf-8")
PRESS, BRIDGE = re.findall(r"```python\n(.*?)```", DOCS, flags=re.S)


def test_the_example_presses(capsys):
    exec(compile(PRESS, "docs/haptics.md", "exec"), {})
    force, depth = re.fullmatch(r"(\S+) N at (\S+) mm\n", capsys.readouterr().out).groups()
    assert 0.1 < float(force) < 0.5
    assert 3.0 < float(depth) < 4.5


class Turns:
    """Stand-in for the bridge's module `time`: while it sleeps, the loop makes a step."""

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
    loop = HapticLoop(touching_simulation(), device, HapticSettings(relative=True, resume=0.01))
    felt: list[tuple] = []
    way = iter(np.linspace(0.0, 0.006, 600))
    turns.step = lambda: loop.step().fault
    names["bridge"](lambda: (0.0, 0.0, -next(way, 0.006)), felt.append, device.address[1], 1.5)
    device.close()
    assert max(force[2] for force in felt) > 0.1
    assert felt[-1] == (0.0, 0.0, 0.0)
    assert device.counts.malformed == 0
