"""A whole session behind a page, for tests that meet it at the level of its protocol."""

import threading
import time
from pathlib import Path

import numpy as np
from websockets.asyncio.client import connect

from surgsim_apps.haptics.pacing import PaceSettings
from surgsim_apps.live.live_organ import live_organ
from surgsim_apps.live.organ_choice import OrganChoice, lesion_kinds
from surgsim_apps.live.page import Page, Tabs
from surgsim_apps.live.session import Session
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import Scene

# A physics at a quarter of real time leaves room on a machine where other tests run beside.
PACE = PaceSettings(period=0.004)
# How long anything may take before a test gives up [s]. Nothing that passes depends on it.
SECONDS = 600.0


def on_a_fast_machine(scene: Scene) -> Anatomy:
    """The live organ of a scene where a press takes a tenth of real time."""
    choice = OrganChoice(lesions=lesion_kinds(scene)[0])
    return live_organ(scene, choice, lambda anatomy, sites: (sites[:, 0], 0.1)).anatomy


class Clock:
    """Time that passes when a test says so [s]."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


class Served:
    """A page with its loop in a thread."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.hand_clock = Clock()
        self.session = Session(on_a_fast_machine(make_scene("phantom_small")), pace=PACE, clock=self.hand_clock)
        self.session.wait()
        self.page = Page(self.session, Tabs(0), out)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.page.run, args=(self._stop.is_set,))
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.page.server.stop()
        self.session.close()

    @property
    def address(self) -> str:
        return self.page.server.address

    @property
    def force(self) -> float:
        return float(np.linalg.norm(self.session.frame()["force"][0]))

    def hand_socket(self):
        return self.hand_socket_of(self.address)

    @staticmethod
    def hand_socket_of(server_address: str):
        origin, _, token = server_address.rpartition("/")
        address = f"{origin.replace('http', 'ws')}/{token}/hand"
        return connect(address, origin=origin, open_timeout=SECONDS, ping_interval=None)


def wait_until(condition, seconds=SECONDS):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come to pass"
        time.sleep(0.02)
