"""The page: frames of the physics for the browser, requests of the panel for the session, thirty times a second."""

import asyncio
import contextlib
import io
import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from websockets.asyncio.server import ServerConnection, broadcast
from websockets.exceptions import ConnectionClosed

from msdm_core.mesh import FloatArray
from surgsim_apps.haptics.pacing import timeliness
from surgsim_apps.live.exchange_records import Change, LiveError, Pause, Phase, Record, Reset
from surgsim_apps.live.guarded_server import GuardedServer
from surgsim_apps.live.lesion_search import Guess, LesionSearch
from surgsim_apps.live.messages import MARK, SEARCH, SOFTWARE, WATCH, read_hand
from surgsim_apps.live.organ_choice import HIDDEN, chosen_lesions, lesion_kinds
from surgsim_apps.live.painted_tissue import PaintedTissue
from surgsim_apps.live.panel import Opened, Panel, status_rows
from surgsim_apps.live.recording import write_recording
from surgsim_apps.live.robot_search import PRESSES, RobotSearch
from surgsim_apps.live.session import Session
from surgsim_apps.live.stage import (
    SCALE,
    STIFFNESS_MAP,
    Aim,
    FeltMap,
    ForceArrow,
    InstrumentView,
    OrganView,
    Surroundings,
    add_handle,
    page_camera,
    place,
)
from surgsim_env.rendering import scene_cameras
from surgsim_env.scene import Scene, make_scene, with_instrument

# Between updates of the plots, of the stiffness map and of the status text [s].
PLOT_PERIOD, MAP_PERIOD, STATUS_PERIOD = 0.1, 0.3, 0.5
# Longest wait for the physics to end a recording [s].
END_TIMEOUT = 2.0
# Time between pictures [s].
PICTURE_PERIOD = 1.0 / 30.0
# Depth of a press with shift over the chosen depth.
DEEPER = 1.6
STEERING = "Press and hold on the organ, drag to slide, shift to press deeper. Drag beside it to turn the view."


class Tabs:
    """The browser's side: a guarded server, and a socket of `hand.js` for each tab. Pages follow one another on it.

    Fields:
        server: for pages
        software: True once a tab without a graphics card was opened
    """

    def __init__(self, port: int) -> None:
        """Serve an empty page.

        Raises:
            LiveError: see `GuardedServer`.
        """
        self._page: Page | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._connections: set[ServerConnection] = set()
        self.software = False
        self.server = GuardedServer(port, self.serve)
        self.server.viser.on_client_connect(lambda client: self._page and self._page.place(client))

    def show(self, page: "Page") -> None:
        """Let the tabs steer and show a page."""
        self._page = page
        for client in self.server.viser.get_clients().values():
            page.place(client)

    async def serve(self, connection: ServerConnection) -> None:
        """Serve one tab until it is closed."""
        self._loop = asyncio.get_running_loop()
        self._connections.add(connection)
        try:
            with contextlib.suppress(ConnectionClosed, asyncio.CancelledError):
                while True:
                    message = await connection.recv(decode=False)
                    if message == SOFTWARE:
                        self.software = True
                    elif self._page is not None:
                        self._page.hear(message)
        finally:
            self._connections.discard(connection)

    def send(self, state: dict[str, Any]) -> None:
        """Send a state to all tabs; one that does not keep up loses it."""
        if self._loop is not None and self._connections:
            self._loop.call_soon_threadsafe(broadcast, self._connections.copy(), json.dumps(state))


class Page:
    """A session on a guarded viser server.

    Fields:
        session, server: the physics' side and the browsers' side
        wanted: scene chosen in the panel, with its names; None for none
        felt: stiffness map of this organ from the touches so far
        search: for a hidden lesion
        robot, robot_guess: a search for it by the machine, and its result; None for none
        pictures: number of pictures sent
    """

    def __init__(
        self,
        session: Session,
        tabs: Tabs,
        out: Path,
        opened: Opened = ("", None),
        load: Callable[[str, str | None], Scene] = lambda scene, instrument: with_instrument(
            make_scene(scene), instrument
        ),
    ) -> None:
        """Serve.

        Args:
            session: a running one.
            tabs: the browsers' side, empty.
            out: folder for recordings.
            opened: scene and instrument of the session, as the panel's menu names them.
            load: makes a scene of two names of the menu, or raises a ValueError.
        """
        self.session, self._tabs, self._out = session, tabs, out
        self.server = tabs.server
        self.wanted: tuple[Opened, Scene] | None = None
        self._opened, self._load = opened, load
        self.search = LesionSearch(session.anatomy)
        self.robot: RobotSearch | None = None
        self.robot_guess: Guess | None = None
        self.felt = FeltMap(session.anatomy)
        self._tissue, self._chosen_paint = PaintedTissue(session), STIFFNESS_MAP
        self._painter = ThreadPoolExecutor(1, "surgsim paint")
        self._shares = self._painter.submit(self._tissue.shares)
        self.pictures, self._map_due = 0, 0.0
        self._organ_number, self._traced = 1, 0
        self._dragged_arm = 0
        self._held: set[int] = set()
        self._shows_lesions = False
        # Number of recordings written; the physics counts those begun.
        self._recordings_written = 0
        self._doing: tuple[int, bool] | None = None
        self._message = ""
        # None: neither a browser nor the user has chosen yet.
        self._plain: bool | None = None
        viser = self.server.viser
        with viser.atomic():
            self._surroundings = Surroundings(viser, session.anatomy)
            session.directions = self._surroundings.directions
            self._organ = OrganView(viser.scene, session.anatomy)
            self._organ.on_drag(self._pressed)
            self._add_instrument()
            self._panel = Panel(
                viser.gui,
                session.scene,
                session.arm_count,
                session.instrument.jaw is not None,
                self._calls(),
                opened,
            )
        tabs.show(self)

    def place(self, client: Any) -> None:
        """Give a tab's view to the page's camera."""
        place(client, page_camera(self.session.anatomy, upright=client.camera.aspect < 1.0))

    def hear(self, message: bytes) -> None:
        """Take a packet of a tab's scripts."""
        if message == SEARCH:
            self._begin_search()
        elif message == MARK:
            self._mark()
        elif message == WATCH:
            self._watch()
        else:
            self.session.push(read_hand(message))

    def clear(self) -> None:
        """Leave the tabs empty, for another page."""
        self._painter.shutdown()
        self._tabs.send(self._overlay(self.session.frame()) | {"text": "loading ...", "buttons": {}})
        with self.server.viser.atomic():
            self.server.viser.scene.reset()
            self.server.viser.gui.reset()

    def _add_instrument(self) -> None:
        """The instrument, a handle at each hand, an arrow of force at each tip."""
        session, scene = self.session, self.server.viser.scene
        self._instrument = InstrumentView(scene, session.instrument.model, session.geoms, session.arm_count)
        self._instrument.on_drag(self._touched)
        size = float(np.ptp(session.anatomy.mesh.points, axis=0).max())
        self._handles = [
            add_handle(scene, arm, place, size, session.directions, self._pulled)
            for arm, place in enumerate(session.parked)
        ]
        self._arrows = [ForceArrow(scene, arm, size) for arm in range(session.arm_count)]
        self._aims = [Aim(scene, arm, session.scene.instrument.tip_radius) for arm in range(session.arm_count)]

    def _calls(self) -> dict[str, Callable[..., None]]:
        """Callbacks of the panel; a click toggles the current state, even if a button's label lags behind."""
        session = self.session
        return {
            "pause": lambda: session.ask(Pause(session.frame()["phase"] != Phase.PAUSED)),
            "reset": self._reset,
            "record": lambda: session.ask(Record(not session.frame()["recording"])),
            "show_lesions": self._show_lesions,
            "paint": self._choose_paint,
            "clear_map": self.felt.clear,
            "close_jaw": session.close_jaw,
            "hold_breath": session.hold_breath,
            "plain": self.show_plain,
            "view": self._look_through,
            "picture": _send_picture,
            "open": self._open,
        }

    def _open(self, scene: str, instrument: str | None) -> None:
        if (scene, instrument) == self._opened:
            return
        try:
            self.wanted = (scene, instrument), self._load(scene, instrument)
        except ValueError as error:
            self._message = str(error)

    def _look_through(self, client: Any, name: str) -> None:
        place(client, scene_cameras(self.session.anatomy, aspect=client.camera.aspect)[name])

    def _choose_paint(self, kind: str) -> None:
        self._chosen_paint = kind

    def show_plain(self, on: bool) -> None:
        """Turn shadows and reflections off or on, in every tab."""
        self._plain = on
        self._surroundings.show_plain(on)
        self._panel.show_plain(on)

    def run(self, until: Callable[[], bool]) -> None:
        """Send pictures until `until()` holds.

        Raises:
            LiveError: the physics died.
        """
        due = time.monotonic()
        self._before, self._pictures_before = self.session.timing(), 0
        plot_due = status_due = due
        while not until() and self.wanted is None:
            self.session.require_alive()
            now = time.monotonic()
            frame = self.session.frame()
            self._attend(frame)
            if self.server.viser.get_clients():
                with self.server.viser.atomic():
                    self._show(frame)
                    if now >= plot_due:
                        plot_due = now + PLOT_PERIOD
                        self._tabs.send(self._overlay(frame))
                        self._panel.plot(self.session.trace())
                        if frame["taxel"].size:
                            self._panel.show_taxels(frame["taxel"])
                self.pictures += 1
            if now >= status_due:
                status_due = now + STATUS_PERIOD
                self._say(frame)
            due = max(due + PICTURE_PERIOD, time.monotonic() - PICTURE_PERIOD)
            time.sleep(max(0.0, due - time.monotonic()))

    def end_recording(self) -> str:
        """Write the current recording to a file; returns the result in a sentence, or "".

        Call it after `run` has ended, also by an error: the recorded steps lie in shared memory and outlive the
        physics' process.
        """
        session = self.session
        begun = int(session.exchange.frame.peek["recordings"])
        if begun == self._recordings_written:
            return ""
        session.ask(Record(False))
        with contextlib.suppress(LiveError):
            deadline = time.monotonic() + END_TIMEOUT
            while session.alive and session.frame()["recording"] and time.monotonic() < deadline:
                time.sleep(0.005)
        self._recordings_written = begun
        return f"{self._out}: {write_recording(session.exchange.recorded.steps.copy(), self._out)}"

    def _pulled(self, arm: int, phase: str, place: FloatArray) -> None:
        """The handle of a hand is dragged to a position [m], (3,)."""
        if phase == "start":
            self._held.add(arm)
        self.session.move_to(arm, place)
        if phase == "end":
            self._held.discard(arm)

    def _pressed(self, phase: str, eye: FloatArray, pointer: FloatArray, deeper: bool) -> None:
        """The organ is pressed, by the nearest tip."""
        if phase == "start":
            tips = self.session.frame()["tip"]
            self._dragged_arm = int(np.argmin(np.linalg.norm(tips - pointer, axis=1)))
        self._touched(self._dragged_arm, phase, eye, pointer, deeper)

    def _touched(self, arm: int, phase: str, eye: FloatArray, pointer: FloatArray, deeper: bool) -> None:
        """A pointer drags an arm over the organ; beside the organ it stays where it pressed last."""
        if phase == "end":
            self.session.lift(arm)
        elif (hit := self._organ.hit(eye, pointer)) is not None:
            self.session.touch(arm, *hit, self._panel.press_depth * (DEEPER if deeper else 1.0))

    def _begin_search(self) -> None:
        self.robot = self.robot_guess = None
        self.search.begin()
        self._panel.hide(self.search.seed)
        self._panel.show_lesions(False)

    def _mark(self) -> None:
        self.search.mark(chosen_lesions(self.session.anatomy, self.session.choice))
        self._panel.show_lesions(not self.search.open)

    def _watch(self) -> None:
        """Let the machine search for the same lesion."""
        if self.search.guess is not None and self.robot is None:
            self._panel.show_lesions(False)
            self.felt.clear()
            self.robot = RobotSearch(self.session)

    def _move_robot(self) -> None:
        robot = self.robot
        if robot is None or robot.go_on():
            return
        assert robot.place is not None
        self.robot = None
        lesions = chosen_lesions(self.session.anatomy, self.session.choice)
        self.robot_guess = self.search.rated(robot.place, robot.presses, robot.force_peak, lesions)
        self._panel.show_lesions(True)

    def _overlay(self, frame: np.ndarray) -> dict[str, Any]:
        """What `overlay.js` shows: force and limits [N], texts, buttons with their packets, the tone."""
        search, robot, limits = self.search, self.robot, self.session.scene.limits
        texts, buttons = [], {"Find the hidden lesion": SEARCH}
        if search.open:
            texts.append(f"{search.presses} presses: where is it stiffest?")
            buttons = {"It is where I pressed last": MARK}
        elif search.guess is not None:
            texts.append(f"You: {search.guess.text}")
            buttons = {"Find another": SEARCH}
            if robot is not None:
                texts.append(f"Robot: {robot.presses} of {PRESSES} presses")
            elif self.robot_guess is not None:
                texts.append(f"Robot: {self.robot_guess.text}")
            else:
                buttons["Watch a robot search"] = WATCH
        if HIDDEN not in lesion_kinds(self.session.scene):
            buttons = {}
        return {
            "force": np.linalg.norm(frame["force"], axis=1).tolist(),
            "soft": limits.soft_force,
            "hard": limits.hard_force,
            "text": "\n".join(texts),
            "buttons": {label: packet.decode() for label, packet in buttons.items()},
            "steer": STEERING,
            "tone": self._panel.tone,
        }

    def _reset(self) -> None:
        self.robot = None
        self.session.park()
        self.session.ask(Reset())

    def _show_lesions(self, on: bool) -> None:
        self._shows_lesions = on
        with self.server.viser.atomic():
            self._organ.show_lesions(chosen_lesions(self.session.anatomy, self.session.choice) if on else [])

    def _attend(self, frame: np.ndarray) -> None:
        """Work regardless of open tabs: update the stiffness map, apply the sliders, write recordings."""
        session = self.session
        if self._plain is None and self._tabs.software:
            self.show_plain(True)
        choice = self._panel.settled_choice()
        if choice is not None and choice != session.choice:
            session.park()
            session.ask(Change(choice))
        if int(frame["organ"]) != self._organ_number:
            self._organ_number = int(frame["organ"])
            self.robot = None
            self.felt.clear()
            if self._shows_lesions:
                self._show_lesions(True)
        self._feel()
        self._move_robot()
        recording, begun = bool(frame["recording"]), int(frame["recordings"])
        if begun > self._recordings_written and not recording:
            self._recordings_written = begun
            self._message = write_recording(session.exchange.recorded.steps.copy(), self._out)
        doing = (int(frame["phase"]), recording)
        if doing != self._doing:
            self._doing = doing
            self._show_phase(frame)

    def _feel(self) -> None:
        """Add the new rows of the trace to the stiffness map."""
        trace = self.session.exchange.trace.read()
        count = int(trace["count"])
        self._traced = min(self._traced, count)
        rows = trace["row"]
        for index in range(max(self._traced, count - len(rows)), count):
            row = rows[index % len(rows)]
            for arm in range(self.session.arm_count):
                force = float(np.linalg.norm(row["force"][arm]))
                self.felt.feel(row["tip"][arm], float(row["depth"][arm]), force)
                if self.search.open:
                    self.search.feel(row["tip"][arm].copy(), force)
            if self.robot is not None:
                force = float(np.linalg.norm(row["force"][0]))
                self.robot.feel(float(row["time"]), float(row["depth"][0]), force)
        self._traced = count

    def _show(self, frame: np.ndarray) -> None:
        """Update the picture."""
        self._paint()
        self._organ.follow(frame["node"].astype(np.float64))
        self._instrument.follow(frame["geom"], frame["turn"])
        face = self.session.anatomy.face
        for arrow, aim, tip, force in zip(self._arrows, self._aims, frame["tip"], frame["force"], strict=True):
            arrow.follow(tip, force)
            aim.follow(tip, *face.project(tip))
        targets = self.session.targets
        for arm, handle in enumerate(self._handles):
            if arm not in self._held and np.abs(handle.position / SCALE - targets[arm]).max() > 1e-6:
                handle.position = targets[arm] * SCALE

    def _paint(self) -> None:
        """Update the paint; here, since calls of the panel come from other threads."""
        kind, tissue = self._chosen_paint, self._tissue
        if time.monotonic() >= self._map_due:
            self._map_due = time.monotonic() + MAP_PERIOD
            self._organ.paint(self.felt)
        if not self._shares.done():
            return
        shares = self._shares.result()
        if shares is not None:
            self._organ.paint_field(shares)
        if kind != self._organ.paints:
            self._organ.show_paint(kind)
            tissue.choose(kind)
        self._panel.show_legend(kind, tissue.end)
        # Compiling another organ takes a second or more, in which pictures go on.
        self._shares = self._painter.submit(tissue.shares)

    def _say(self, frame: np.ndarray) -> None:
        """Update the status text."""
        now, pictures = self.session.timing(), self.pictures
        wall = now[1] - self._before[1]
        kept = timeliness(self._before[0], now[0], wall)
        fps = (pictures - self._pictures_before) / wall
        self._before, self._pictures_before = now, pictures
        rows = status_rows(
            frame,
            kept,
            skipped=int(now[0]["skipped"]),
            fps=fps,
            message=self._message,
            has_breath=self.session.scene.has_breath,
        )
        self._panel.show_status(frame, rows)
        self._show_phase(frame)

    def _show_phase(self, frame: np.ndarray) -> None:
        recorded = self.session.exchange.recorded.count * self.session.scene.timing.haptic_step
        self._panel.show_phase(
            frame, recorded, jaw_closed=self.session.jaw_closed, breath_held=self.session.breath_held
        )


def _send_picture(client: Any) -> None:
    """Save a tab's view as a file of its browser."""
    from PIL import Image

    pixels, file = client.get_render(client.camera.image_height, client.camera.image_width), io.BytesIO()
    Image.fromarray(pixels).save(file, "png")
    client.send_file_download("surgsim.png", file.getvalue())
