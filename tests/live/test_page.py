"""A whole session behind a page, met at the protocol's level: hands, tabs that go, nonsense, slow ones, the end."""

import asyncio
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec.msgpack
import numpy as np
import pytest
import viser
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from surgsim_env.live.errors import LiveError
from surgsim_env.live.exchange_records import Phase
from surgsim_env.live.hand_messages import HandMotion, write_hand
from surgsim_env.live.organ_choice import HIDDEN, NONE, OrganChoice
from surgsim_env.live.page import Page
from surgsim_env.live.protocol_client import CAMERA, ProtocolClient, hand_message, press_path
from surgsim_env.live.requests import Change, Pause, Record, Reset
from surgsim_env.live.session import Session
from surgsim_env.pacing import PaceSettings
from surgsim_env.scenes import make_scene

REPOSITORY = Path(__file__).resolve().parents[2]
# A physics at a quarter of real time leaves room on a machine where other tests run beside.
PACE = PaceSettings(period=0.004)
SECONDS = 60.0


class Served:
    """A page with its loop in a thread."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.session = Session(make_scene("phantom_small"), pace=PACE)
        self.session.wait()
        self.page = Page(self.session, host="127.0.0.1", port=0, remote=False, out=out)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.page.run, args=(self._stop.is_set,))
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(timeout=20)
        self.page.server.stop()
        self.session.close()

    @property
    def address(self) -> str:
        return self.page.server.address

    @property
    def force(self) -> float:
        return float(np.linalg.norm(self.session.frame()["force"][0]))

    def socket(self, path="/"):
        gate = self.page.server.gate
        return connect(
            f"ws://127.0.0.1:{gate.port}{path}",
            origin=f"http://127.0.0.1:{gate.port}",
            additional_headers={"Cookie": f"{gate.cookie}={gate.token}"},
            subprotocols=[f"viser-v{viser.__version__}"] if path == "/" else None,
            max_size=None,
            compression=None,
        )


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    made = Served(tmp_path_factory.mktemp("live") / "out")
    yield made
    made.close()


@pytest.fixture(autouse=True)
def fresh(served):
    before = int(served.session.frame()["organ"])
    served.session.park()
    served.session.ask(Change(OrganChoice(lesions=NONE)))

    def renewed() -> bool:
        frame = served.session.frame()
        return int(frame["organ"]) > before and frame["phase"] == Phase.RUNNING

    wait_until(renewed)


def wait_until(condition, seconds=SECONDS):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come to pass"
        time.sleep(0.02)


def test_a_client_presses_and_is_sent_a_moving_organ(served):
    path = press_path(served.session.anatomy)
    rest = served.session.anatomy.mesh.points
    client = ProtocolClient(served.address, path, rate=30.0)
    client.start()
    try:
        wait_until(lambda: served.force > 0.08)
        moved = np.linalg.norm(served.session.frame()["node"] - rest, axis=1).max()
        assert moved > 0.0005
        wait_until(lambda: client.updates > 30 and client.bytes > 30 * 4000)
        assert (served.session.trace()["peak"] > 0.02).any()
        wait_until(lambda: served.page.felt.felt.any())
    finally:
        client.stop()
    assert not client.errors


def test_a_slow_client_is_not_waited_for(served):
    """It takes a message in two seconds: the other one's pictures and the physics go on as without it."""
    slow = ProtocolClient(served.address, pause=2.0)
    quick = ProtocolClient(served.address)

    def rates() -> np.ndarray:
        """Steps, pictures and the quick client's updates a second."""
        before = counts()
        time.sleep(4.0)
        made = counts() - before
        return made[:3] / made[3]

    def counts() -> np.ndarray:
        steps, now = served.session.timing()
        return np.array([steps["steps"], served.page.pictures, quick.updates, now])

    quick.start()
    try:
        wait_until(lambda: quick.updates >= 5)
        alone = rates()
        slow.start()
        wait_until(lambda: slow.updates >= 1)
        taken = slow.updates
        beside = rates()
        assert slow.updates - taken <= 4
    finally:
        quick.stop()
        slow.stop()
    # Messages that nobody takes cost something, and a busy machine is uneven.
    assert (beside > 0.6 * alone).all()
    assert not quick.errors


def test_keys_move_the_hand_and_let_go_with_the_tab(served):
    async def hold():
        async with served.socket("/hand") as socket:
            for _ in range(10):
                await socket.send(write_hand(HandMotion((0.0, 0.0, 1.0), 0)))
                await asyncio.sleep(0.05)

    before = served.session.targets[0].copy()
    asyncio.run(hold())
    wait_until(lambda: not served.session._motions)
    moved = served.session.targets[0] - before
    out = served.session.directions[2]
    assert 0.002 < moved @ out < 0.05 and np.linalg.norm(np.cross(moved, out)) < 1e-9
    still = served.session.targets[0]
    time.sleep(0.3)
    assert np.array_equal(served.session.targets[0], still)


def test_the_other_arm_of_one_is_the_same(served):
    """Keys go on moving the only tip after X was pressed, which a page of one arm does not know to leave alone."""
    before = served.session.targets
    served.session.push(HandMotion((0.0, 0.0, 1.0), 1))
    wait_until(lambda: not served.session._motions)
    assert (served.session.targets - before)[0] @ served.session.directions[2] > 0.002


NONSENSE = {
    "bytes": b"\xc1",
    "huge": bytes(100_000),
    "a place that is no number": hand_message(np.full(3, np.nan)),
    "a place beyond the world": hand_message(np.full(3, 1e6)),
    "another's message": msgspec.msgpack.encode({"type": "RunJavascriptMessage", "source": "alert(1)"}),
}


@pytest.mark.parametrize("path", ["/", "/hand"])
@pytest.mark.parametrize("kind", NONSENSE)
def test_nonsense_ends_its_tab_alone(served, kind, path):
    async def attempt():
        async with served.socket() as good, served.socket(path) as bad:
            await good.send(msgspec.msgpack.encode(CAMERA))
            await asyncio.wait_for(good.recv(), SECONDS)
            with pytest.raises(ConnectionClosed):
                await bad.send(NONSENSE[kind])
                while True:
                    await asyncio.wait_for(bad.recv(), SECONDS)
            for _ in range(5):
                assert await asyncio.wait_for(good.recv(), SECONDS)

    steps = served.session.timing()[0]["steps"]
    asyncio.run(attempt())
    assert np.isfinite(served.session.targets).all()
    wait_until(lambda: served.session.timing()[0]["steps"] > steps)


def test_hands_that_say_nonsense_are_dropped(served):
    async def attempt():
        for packet in (write_hand(HandMotion((float("nan"), 0.0, 0.0), 0)), b"0" * 16, b"", "text"):
            async with served.socket("/hand") as bad:
                await bad.send(packet)
                with pytest.raises(ConnectionClosed) as closed:
                    await asyncio.wait_for(bad.recv(), SECONDS)
                assert closed.value.rcvd.code == 1008

    before = served.session.targets
    asyncio.run(attempt())
    assert np.array_equal(served.session.targets, before)


def test_two_tabs_share_one_organ_and_one_may_go(served):
    path = press_path(served.session.anatomy)
    one, other = ProtocolClient(served.address, path), ProtocolClient(served.address)
    one.start()
    other.start()
    try:
        wait_until(lambda: one.updates > 10 and other.updates > 10)
        one.stop()
        updates = other.updates
        wait_until(lambda: other.updates > updates + 10)
        wait_until(lambda: len(served.page.server.viser.get_clients()) == 1)
    finally:
        one.stop()
        other.stop()
    assert not other.errors


def setting(handle, value):
    return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}})


async def send(served, *messages):
    async with served.socket() as socket:
        await socket.send(msgspec.msgpack.encode(CAMERA))
        await asyncio.wait_for(socket.recv(), SECONDS)
        for message in messages:
            await socket.send(message)
        await asyncio.sleep(0.5)


def test_panel_settings_reach_the_physics(served):
    """A slider's own message, as a browser sends it; one beyond its range changes nothing."""
    panel, session = served.page._panel, served.session

    organ = int(session.frame()["organ"])
    asyncio.run(send(served, setting(panel._modulus, 9.0)))
    wait_until(lambda: int(session.frame()["organ"]) > organ)
    assert session.choice.modulus_factor == pytest.approx(9.0 / (session.scene.material.youngs_modulus / 1e3))
    ignored = served.page._judge.ignored
    asyncio.run(send(served, setting(panel._modulus, 1e9), setting(panel._lesions, "all of them")))
    assert served.page._judge.ignored == ignored + 2 and panel._modulus.value == 9.0
    asyncio.run(send(served, setting(panel._pause, True)))
    wait_until(lambda: session.frame()["phase"] == Phase.PAUSED)
    session.ask(Pause(False))
    wait_until(lambda: session.frame()["phase"] == Phase.RUNNING)


def test_a_click_means_what_the_physics_is_doing(served, monkeypatch, tmp_path):
    """Whatever the button's name says: names are never renewed here."""
    panel, session = served.page._panel, served.session
    monkeypatch.setattr(served.page, "_out", tmp_path)
    monkeypatch.setattr(panel, "_name", lambda *_: None)
    for phase in (Phase.PAUSED, Phase.RUNNING):
        asyncio.run(send(served, setting(panel._pause, True)))
        wait_until(lambda phase=phase: session.frame()["phase"] == phase)
    for recording in (True, False):
        asyncio.run(send(served, setting(panel._record, True)))
        wait_until(lambda recording=recording: bool(session.frame()["recording"]) == recording)
    wait_until((tmp_path / "recording-1.csv").is_file)


def test_buttons_are_renamed_with_the_next_picture(served, monkeypatch):
    panel, session = served.page._panel, served.session
    # They do not wait for the words that are said twice a second.
    monkeypatch.setattr(served.page, "_say", lambda _: None)
    session.ask(Pause(True))
    wait_until(lambda: panel._pause.label == "Go on", 20.0)
    session.ask(Pause(False))
    wait_until(lambda: panel._pause.label == "Pause", 20.0)


def test_a_recording_is_written_to_its_folder_alone(served):
    session = served.session
    session.ask(Record(True))
    wait_until(lambda: session.frame()["recording"])
    wait_until(lambda: session.exchange.recorded.count > 100)
    session.ask(Record(False))
    wait_until(lambda: (served.out / "recording-1.csv").is_file())
    assert [path.name for path in served.out.iterdir()] == ["recording-1.csv"]
    session.ask(Reset())
    wait_until(lambda: session.frame()["time"] < 0.5)


def test_a_client_that_is_not_let_in_or_sends_no_more_says_so(served):
    stranger = ProtocolClient(served.address + "x")
    stranger.start()
    wait_until(lambda: stranger.errors)
    assert "401" in stranger.errors[0]

    def path(time):
        raise ValueError("no such place")

    lame = ProtocolClient(served.address, path)
    lame.start()
    try:
        wait_until(lambda: lame.errors)
    finally:
        lame.stop()
    assert "no such place" in lame.errors[0]


def test_a_place_that_is_not_finite_is_refused(served):
    with pytest.raises(ValueError, match="must be finite"):
        served.session.move_to(0, np.array([0.0, np.nan, 0.0]))
    served.session.move_to(0, np.full(3, 9.0))
    assert (served.session.targets[0] <= served.session.instrument.upper + 0.011).all()


CHILD = """
import sys, time
from surgsim_env.live.session import Session
from surgsim_env.pacing import PaceSettings
from surgsim_env.scenes import make_scene
if __name__ == "__main__":
    session = Session(make_scene("phantom_small"), pace=PaceSettings(period=0.01))
    session.wait()
    print(session._process.pid, flush=True)
    time.sleep(600)
"""


def test_the_physics_ends_with_a_page_that_was_killed(tmp_path):
    script = tmp_path / "page.py"
    script.write_text(CHILD)
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True, env=environment)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    assert _lives(child)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    wait_until(lambda: not _lives(child))


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_a_physics_that_dies_is_said(tmp_path):
    session = Session(make_scene("phantom_small"), pace=PACE)
    page = None
    try:
        session.wait()
        page = Page(session, host="127.0.0.1", port=0, remote=False, out=tmp_path)
        session._process.kill()
        with pytest.raises(LiveError, match="physics' process died"):
            page.run(lambda: False)
    finally:
        if page is not None:
            page.server.stop()
        session.close()


def test_why_the_physics_refused_is_said(monkeypatch):
    """What only the child finds out."""
    monkeypatch.setattr(
        "surgsim_env.live.session.OrganChoice", lambda lesions: OrganChoice(lesions=HIDDEN, lesion_ratio=1e6)
    )
    session = Session(make_scene("phantom_small"), pace=PACE)
    try:
        with pytest.raises(LiveError, match=r"physics' process died: .*step"):
            session.wait()
    finally:
        session.close()
