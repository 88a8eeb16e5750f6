"""`surgsim view`: a scene live in a browser."""

import contextlib
import math
import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from surgsim_env.cli.values import MaybeText, missing_packages
from surgsim_env.haptics.pacing import Timeliness, timeliness
from surgsim_env.scene.load import make_scene, with_instrument
from surgsim_env.scene.motions import with_motion

if TYPE_CHECKING:
    from surgsim_env.live.page import Page

# The scene that has ports for two arms, and the two that work there.
BIMANUAL_SCENE, BIMANUAL_INSTRUMENT = "lobe", "psm_pair"
# What `measure` asks for: a share of the rate, lateness [s], updates at its client [1/s].
RATE_SHARE, LATENESS_MOST, UPDATES_LEAST = 0.995, 0.002, 20.0


@dataclass(frozen=True)
class View:
    """Serve a scene live to a browser: press the organ with mouse, keys or gamepad, a thousand steps a second.

    Prints the address to open on this machine; other machines use an SSH tunnel. See docs/live.md.
    """

    scene: str | None = None
    """A shipped scene (see `surgsim scenes`) or a scene file of your own (TOML); default: liver, lobe for two arms."""
    instrument: str | None = None
    """An arm or a TOML file (docs/arms.md); default: the scene's own."""
    bimanual: bool = False
    """Two arms: a jaw to lift, a ball to touch."""
    motion: MaybeText = None
    """How the patient breathes: calm, free, or none (holds still); default: as the scene has it."""
    port: int = 8080
    """Port of 127.0.0.1 to listen on, or the next free one; 0 for any free one."""
    replay: Path | None = None
    """A recording (CSV) to play first."""
    out: Path = Path("runs/live")
    """Folder for recordings."""
    plain: bool = False
    """No shadows and reflections from the start; a browser without a graphics card switches them off itself."""
    seconds: float | None = None
    """Stop after this time [s]."""
    measure: bool = False
    """Press with a client of the page's protocol, and print rate and lateness at the end (with --seconds)."""

    def run(self, console: Console) -> int:
        """Serve until interrupted, or for some seconds; exit status 0, or 1 where `measure` found a target missed.

        Raises:
            ValueError: a scene, an instrument or an option that is invalid; viser is not installed.
            LiveError: the physics died, or viser cannot be guarded.
        """
        with missing_packages("view", "live"):
            import viser  # noqa: F401
        from surgsim_env.live.exchange_records import Replay
        from surgsim_env.live.page import Page
        from surgsim_env.live.recording import read_recording
        from surgsim_env.live.session import Session

        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0.0):
            raise ValueError(f"--seconds is {self.seconds}; it must be finite and above 0")
        if not 0 <= self.port <= 65535:
            raise ValueError(f"--port is {self.port}; it must be from 0 (any free one) to 65535")
        name = self.scene or (BIMANUAL_SCENE if self.bimanual else "liver")
        instrument = self.instrument or (BIMANUAL_INSTRUMENT if self.bimanual else None)
        scene = with_motion(with_instrument(make_scene(name), instrument), self.motion)
        console.print(f"{scene.name}: meshing, and compiling if that was not done before ...", highlight=False)
        session = Session(scene)
        page = None
        try:
            session.wait()
            page = Page(session, port=self.port, out=self.out)
            if self.plain:
                page.show_plain(True)
            console.print(f"open {page.server.address}", highlight=False, soft_wrap=True)
            if self.replay is not None:
                steps = read_recording(self.replay, session.arm_count, session.scene.timing.haptic_step)
                session.exchange.recorded.fill(steps)
                session.ask(Replay(True, given=True))
            watching = Measurement(page) if self.measure else contextlib.nullcontext()
            with watching, _stopping() as stop:
                end = math.inf if self.seconds is None else time.monotonic() + self.seconds
                try:
                    page.run(lambda: stop.is_set() or time.monotonic() >= end)
                finally:
                    # However it ends: SIGTERM, Ctrl-C, or a physics that died.
                    if written := page.end_recording():
                        console.print(written, highlight=False, soft_wrap=True)
                if isinstance(watching, Measurement):
                    return watching.report(console)
        finally:
            if page is not None:
                page.server.stop()
            session.close()
        return 0


@contextlib.contextmanager
def _stopping():
    """An event that SIGTERM sets; Ctrl-C interrupts as ever."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = signal.signal(signal.SIGTERM, lambda *_: stop.set())
    try:
        yield stop
    finally:
        signal.signal(signal.SIGTERM, before)


class Measurement:
    """A client at the protocol's level beside the page, and how the physics keeps time meanwhile."""

    def __init__(self, page: "Page") -> None:
        """Of a page that is served; it begins with `with`."""
        from surgsim_env.live.protocol_client import ProtocolClient, press_path

        self._page = page
        self._client = ProtocolClient(page.server.address, press_path(page.session.anatomy))
        # What the first messages cost belongs to no sustained rate.
        self._beginning = threading.Timer(1.0, self._begin)

    def __enter__(self) -> "Measurement":
        self._client.start()
        self._begin()
        self._beginning.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._beginning.cancel()
        self._client.stop()

    def _begin(self) -> None:
        self._before, self._pictures, self._got = self._page.session.timing(), self._page.pictures, self._client.updates

    def report(self, console: Console) -> int:
        """Print `name value unit` lines and what is amiss; 1 where anything is, see `missed_targets`."""
        from surgsim_env.live.exchange_records import Phase

        session, after = self._page.session, self._page.session.timing()
        wall = after[1] - self._before[1]
        kept = timeliness(self._before[0], after[0], wall)
        updates = (self._client.updates - self._got) / wall
        force = float(session.trace()["peak"].max(initial=0.0))
        lines = [
            *report_lines(kept, wall),
            f"pictures_made {(self._page.pictures - self._pictures) / wall:.1f} 1/s",
            f"client_updates {updates:.1f} 1/s",
            f"force_largest {force:.3f} N",
        ]
        missed = missed_targets(kept, session.scene.timing.haptic_step, updates, force)
        missed += [f"the client failed: {error}" for error in self._client.errors]
        frame = session.frame()
        if frame["phase"] == Phase.FAULT:
            missed.append(f"the organ's fault: {bytes(frame['said']).decode()}")
        for line in (*lines, *(f"missed: {one}" for one in missed)):
            console.print(line, highlight=False, soft_wrap=True)
        return 1 if missed else 0


def missed_targets(kept: Timeliness, period: float, updates: float, force: float) -> list[str]:
    """What a measured stretch fell short of, in words.

    Args:
        kept: how its steps kept time.
        period: of the steps [s].
        updates: that came to its client [1/s].
        force: largest that was felt [N].
    """
    missed = []
    if not kept.rate * period > RATE_SHARE:
        missed.append(f"{kept.rate:.1f} steps/s of {1.0 / period:.0f}; the rule is above {RATE_SHARE:.1%}")
    if not kept.late_p99 < LATENESS_MOST:
        missed.append(f"99 % late by up to {kept.late_p99 * 1e3:.2f} ms; the rule is under {LATENESS_MOST * 1e3:g} ms")
    if not updates >= UPDATES_LEAST:
        missed.append(f"{updates:.1f} updates/s came to the client; the rule is {UPDATES_LEAST:g} or more")
    if not force > 0.0:
        missed.append("no force was felt: the client pressed nothing")
    return missed


def report_lines(kept: Timeliness, wall: float) -> list[str]:
    """How steps kept time, as `name value unit` lines."""
    return [
        f"measured {wall:.1f} s",
        f"physics_rate {kept.rate:.1f} 1/s",
        f"real_time_factor {kept.real_time:.4f}",
        f"lateness_p50 {kept.late_p50 * 1e3:.2f} ms",
        f"lateness_p99 {kept.late_p99 * 1e3:.2f} ms",
        f"lateness_largest {kept.late_most * 1e3:.2f} ms",
        f"step_p50 {kept.spent_p50 * 1e3:.2f} ms",
        f"step_p99 {kept.spent_p99 * 1e3:.2f} ms",
        f"steps_skipped {kept.skipped}",
    ]
