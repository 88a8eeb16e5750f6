"""`surgsim view`: a scene live in a browser."""

import contextlib
import math
import signal
import threading
import time

from rich.console import Console

from surgsim_env.live.exchange_records import Phase
from surgsim_env.live.options import View
from surgsim_env.pacing import Timeliness, timeliness
from surgsim_env.scenes import make_scene, with_instrument

# The scene that has ports for two arms, and the two that work there.
BIMANUAL_SCENE, BIMANUAL_INSTRUMENT = "lobe", "psm_pair"
# What `measure` asks for: a share of the rate, lateness [s], updates at its client [1/s].
RATE_SHARE, LATENESS_MOST, UPDATES_LEAST = 0.995, 0.002, 20.0


def view(request: View, console: Console) -> int:
    """Serve until interrupted, or for some seconds; exit status 0, or 1 where `measure` found a target missed.

    Raises:
        ValueError: a scene, an instrument or an address that is not to be had; viser is not installed.
        LiveError: the physics died, or viser cannot be guarded.
    """
    try:
        import viser  # noqa: F401
    except ImportError:
        raise ValueError("surgsim view needs viser: pip install 'surgsim[live]'") from None
    from surgsim_env.live.page import Page
    from surgsim_env.live.recording import read_recording
    from surgsim_env.live.requests import Replay
    from surgsim_env.live.session import Session

    if request.seconds is not None and not (math.isfinite(request.seconds) and request.seconds > 0.0):
        raise ValueError(f"--seconds is {request.seconds}; it must be finite and above 0")
    if not 0 <= request.port <= 65535:
        raise ValueError(f"--port is {request.port}; it must be from 0 (any free one) to 65535")
    name = request.scene or (BIMANUAL_SCENE if request.bimanual else "liver")
    instrument = request.instrument or (BIMANUAL_INSTRUMENT if request.bimanual else None)
    scene = with_instrument(make_scene(name), instrument)
    console.print(f"{scene.name}: meshing, and compiling if that was not done before ...", highlight=False)
    session = Session(scene)
    page = None
    try:
        session.wait()
        page = Page(session, host=request.host, port=request.port, remote=request.allow_remote, out=request.out)
        if request.plain:
            page.show_plain(True)
        console.print(f"open {page.server.address}", highlight=False, soft_wrap=True)
        if request.allow_remote:
            console.print("other machines may connect; nothing on the way is encrypted", highlight=False)
        if request.replay is not None:
            steps = read_recording(request.replay, session.arm_count, session.scene.timing.haptic_step)
            session.exchange.recorded.fill(steps)
            session.ask(Replay(True, given=True))
        watching = Measurement(page) if request.measure else contextlib.nullcontext()
        with watching, _stopping() as stop:
            end = math.inf if request.seconds is None else time.monotonic() + request.seconds
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

    def __init__(self, page) -> None:
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
