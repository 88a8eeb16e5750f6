"""The page in a real browser, drawn in software: opened, its probe dragged, organ and force trace seen to follow."""

import contextlib
import io
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from surgsim_env.haptics.pacing import PaceSettings
from surgsim_env.live.exchange_records import Pause, Phase, Reset
from surgsim_env.live.messages import HandMotion
from surgsim_env.live.page import Page
from surgsim_env.live.session import HAND_SPEED, Session
from surgsim_env.live.stage import page_camera
from surgsim_env.scene.load import make_scene, with_instrument
from surgsim_env.scene.model import Scene
from surgsim_env.scene.motions import with_motion
from tests.live.served import Clock, wait_until

WIDTH, HEIGHT = 900, 600
# Pictures are drawn by the processor that the physics runs on: it goes at a tenth of real time here.
PACE = PaceSettings(period=0.010)
CANVAS = "document.querySelector('canvas').getBoundingClientRect()"


@contextlib.contextmanager
def serving(scene: Scene, folder: Path, clock: Callable[[], float] = time.monotonic) -> Iterator[Page]:
    session = Session(scene, pace=PACE, clock=clock)
    page, stop = None, threading.Event()
    thread = None
    try:
        session.wait()
        page = Page(session, host="127.0.0.1", port=0, remote=False, out=folder / "out")
        thread = threading.Thread(target=page.run, args=(stop.is_set,))
        thread.start()
        yield page
    finally:
        stop.set()
        if thread is not None:
            thread.join()
        if page is not None:
            page.server.stop()
        session.close()


@pytest.fixture
def served(tmp_path) -> Iterator[Page]:
    with serving(make_scene("phantom_small"), tmp_path) as page:
        yield page


@pytest.fixture(scope="module")
def hand_clock() -> Clock:
    """Tells how long sticks were held."""
    return Clock()


@pytest.fixture(scope="module")
def two_arms(tmp_path_factory, hand_clock) -> Iterator[Page]:
    scene = with_instrument(make_scene("lobe"), "psm_pair")
    with serving(scene, tmp_path_factory.mktemp("two_arms"), hand_clock) as page:
        yield page


def opened(browser, page) -> None:
    """The page is there, its physics runs, and pictures come."""
    browser.open(page.server.address)
    browser.wait_for("!!document.body && document.body.innerText.includes('Force and depth')")
    browser.wait_for("document.body.innerText.includes('steps/s')")
    made = page.pictures
    browser.wait_until(lambda: page.pictures > made + 3)
    browser.run("document.querySelector('.mantine-Notification-closeButton')?.click()")


def picture(browser) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(browser.shot())).convert("RGB")).astype(int)


def seen_at(browser, page, place) -> tuple[float, float]:
    """Where a place of the scene [m] is on the page [pixels]."""
    box = browser.run(f"(() => {{ const r = {CANVAS}; return [r.x, r.y, r.width, r.height]; }})()")
    camera = page_camera(page.session.anatomy)
    at, _ = camera.project(np.array([place]), box[2], box[3])
    return box[0] + float(at[0, 0]), box[1] + float(at[0, 1])


def drag_into_the_organ(browser, page) -> None:
    """Drag the handle of the only tip down until the organ presses back."""
    session = page.session
    start = session.targets[0]
    grip = start + 0.02 * session.directions[2]
    down = grip - 0.030 * session.directions[2]
    there = seen_at(browser, page, grip), seen_at(browser, page, down)
    browser.drag(*there, lambda: np.linalg.norm(session.targets[0] - start) > 0.015)
    browser.wait_until(lambda: not page._held and not page._grabs)
    browser.wait_until(lambda: np.linalg.norm(session.frame()["force"][0]) > 0.05)


def test_the_page_opens_and_its_probe_is_dragged_into_the_organ(served, chromium):
    session = served.session
    with chromium.page(WIDTH, HEIGHT) as browser:
        opened(browser, served)
        assert browser.run("document.cookie") == ""
        # Who holds still has no breath to hold.
        assert "Close the jaw" not in browser.text() and "Hold the breath" not in browser.text()
        # It draws in software, and has said so.
        assert served._plain and served._panel._plain.value
        assert not browser.run(SMOOTH_EDGES)
        before = picture(browser)
        rest = session.frame()["node"].copy()
        plot_before = browser.run(PLOT)

        drag_into_the_organ(browser, served)
        # The tip is still on its way.
        browser.wait_until(lambda: np.linalg.norm(session.frame()["node"] - rest, axis=1).max() > 0.001)
        browser.wait_until(lambda: browser.run(PLOT) != plot_before)
        box = browser.run(f"(() => {{ const r = {CANVAS}; return [r.x, r.y, r.width, r.height]; }})()")
        middle = (slice(int(0.2 * box[3]), int(0.9 * box[3])), slice(int(0.25 * box[2]), int(0.6 * box[2])))

        def changed() -> float:
            """The share of the middle's pixels that have another colour than before the press."""
            return (np.abs(before[middle] - picture(browser)[middle]).max(axis=2) > 24).mean()

        browser.wait_until(lambda: changed() > 0.01)
        after = picture(browser)
        # The organ is there: reddish, and shaded, not one flat colour.
        red = after[is_red(after)]
        assert len(red) > 2000 and len(np.unique(red, axis=0)) > 50

        browser.click_on("Pause")
        browser.wait_until(lambda: served._panel._pause.label == "Continue")
        browser.wait_for("document.body.innerText.includes('Continue')")
        # viser's camera complains of its own way to hear the wheel.
        assert [one for one in browser.complaints() if "passive event listener" not in one] == []
    assert served._message_filter.dropped == 0 and served._message_filter.ignored == 0


# Lengths of the arrays that the page hands to OpenGL.
UPLOADS = """window.uploads = new Set();
for (const name of ["bufferData", "bufferSubData"]) {
  const real = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    for (const one of given) if (ArrayBuffer.isView(one)) window.uploads.add(one.length);
    return real.apply(this, given);
  };
}"""


def test_the_page_draws_a_fine_surface_and_paints_it(fine_scene, tmp_path, chromium):
    with serving(fine_scene, tmp_path) as served, chromium.page(WIDTH, HEIGHT) as browser:
        vertices, faces = served.session.anatomy.fine_surface
        shown = f"window.uploads.has({3 * len(vertices)}) && window.uploads.has({3 * len(faces)})"
        browser.before_pages(UPLOADS)
        opened(browser, served)
        # It draws in software and has said so: the boundary of the tets, until it is told otherwise. The lights stay
        # plain, which saves a minute.
        assert served._plain
        browser.run("window.uploads.clear()")
        browser.next_frame()
        assert not browser.run(shown)
        served._organ.plain = False
        browser.wait_for(shown)
        before = picture(browser)
        drag_into_the_organ(browser, served)
        browser.wait_until(lambda: served.felt.felt.any())
        served.session.park()

        def painted() -> int:
            """Number of pixels that were the organ's red and are the blue of the map's softest part."""
            after = picture(browser)
            return int((is_red(before) & (after[:, :, 2] > after[:, :, 0])).sum())

        browser.wait_until(lambda: painted() > 200)
        assert [one for one in browser.complaints() if "passive event listener" not in one] == []


def is_red(shot: np.ndarray) -> np.ndarray:
    """Which pixels of a picture are of the organ."""
    return (shot[:, :, 0] > 1.6 * shot[:, :, 2]) & (shot[:, :, 0] > 60)


def test_both_arms_are_dragged_and_both_forces_shown(two_arms, chromium):
    session = two_arms.session
    out = session.directions[2]
    rest(session)
    with chromium.page(WIDTH, HEIGHT) as browser:
        opened(browser, two_arms)
        assert not session.frame()["force"].any()
        assert forces_shown(browser) == [0.0, 0.0]
        # Down by the arrow of each handle: a pad of the open jaw is 4 mm above the lobe, the ball 15 mm.
        for arm, way in enumerate((0.008, 0.018)):
            tip, start = session.frame()["tip"].copy(), session.targets.copy()
            # In the arrow's cone, away from the jaw's upper pad, which can be dragged, too.
            grip = start[arm] + 0.088 * two_arms._handles[arm].scale * out
            browser.drag(
                seen_at(browser, two_arms, grip),
                seen_at(browser, two_arms, grip - way * out),
                lambda arm=arm, place=start[arm] - way * out, way=way: np.allclose(
                    session.targets[arm], place, rtol=0.0, atol=0.15 * way
                ),
                grabbed=lambda arm=arm: two_arms._held == {arm},
                state=lambda start=start: (start, session.targets, two_arms._held, two_arms._grabs),
            )
            browser.wait_until(lambda: not two_arms._held)
            np.testing.assert_allclose(session.targets[arm] - start[arm], -way * out, atol=0.15 * way)
            assert np.array_equal(session.targets[1 - arm], start[1 - arm])
            browser.wait_until(lambda arm=arm: np.linalg.norm(session.frame()["force"][arm]) > 0.02)
            went = session.frame()["tip"][arm] - tip[arm]
            assert -went @ out > 0.5 * way
        browser.wait_until(lambda: min(forces_shown(browser)) > 0.01)
        assert session.frame()["phase"] == Phase.RUNNING
        # Each is drawn in its colour, too.
        browser.wait_until(lambda: min(curve_heights(browser, 0)) > 1)
        assert [one for one in browser.complaints() if "passive event listener" not in one] == []
    assert two_arms._message_filter.dropped == 0 and two_arms._message_filter.ignored == 0


# The check box with some label, which is moved into view, and where it is.
CHECK_BOX = """(() => { const label = [...document.querySelectorAll('label')].find(one => one.innerText.includes(%r));
  if (!label) return null; const box = document.getElementById(label.htmlFor); box.scrollIntoView({block: 'nearest'});
  const r = box.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2, box.checked]; })()"""


def test_the_breath_is_held_by_a_switch(tmp_path, chromium):
    scene = with_motion(make_scene("phantom_small"), "calm")
    with serving(scene, tmp_path) as page, chromium.page(WIDTH, HEIGHT) as browser:
        session = page.session
        opened(browser, page)
        for held in (True, False):
            words = "held" if held else "goes on"
            x, y, before = browser.wait_for(CHECK_BOX % "Hold the breath")
            assert before != held
            browser.mouse("mousePressed", x, y, 1)
            browser.mouse("mouseReleased", x, y)
            browser.wait_until(lambda held=held: bool(session.frame()["breath_held"]) == held)
            browser.wait_for(f"{CHECK_BOX % 'Hold the breath'}[2] === {str(held).lower()}")
            browser.wait_for(f"/breath\\s+{words}/.test(document.body.innerText)")
        assert [one for one in browser.complaints() if "passive event listener" not in one] == []
    assert page._message_filter.dropped == 0 and page._message_filter.ignored == 0


# Of the plot with some number, in each arm's colour: the rows of pixels that its curve takes.
CURVES = """(() => { const one = document.querySelectorAll('.uplot canvas')[%d];
  const d = one.getContext('2d').getImageData(0, 0, one.width, one.height).data;
  const near = (at, colour) => colour.every((part, k) => Math.abs(d[at + k] - part) < 40) && d[at + 3] > 128;
  return [[232, 89, 12], [25, 113, 194]].map(colour => { const rows = new Set();
    for (let at = 0; at < d.length; at += 4) if (near(at, colour)) rows.add(Math.floor(at / 4 / one.width));
    return rows.size; }); })()"""


def curve_heights(browser, plot) -> list[int]:
    return browser.run(CURVES % plot)


def forces_shown(browser) -> list[float]:
    """The figures beside "force, left / right arm"."""
    found = re.search(r"force, left / right arm\s+([\d.]+) / ([\d.]+) N", browser.text())
    assert found, browser.text()
    return [float(one) for one in found.groups()]


def rest(session) -> None:
    """Start again with both tips parked, and stand still until that is seen."""
    session.park()
    for request in (Reset(), Pause(True)):
        session.ask(request)
    wait_until(lambda: session.frame()["phase"] == Phase.PAUSED)
    session.ask(Pause(False))


# A gamepad that counts how often it was looked at.
PAD = """window.pad = {connected: true, axes: [0, 0, 0, 0], buttons: Array.from({length: 17}, () => ({value: 0}))};
window.looks = 0;
navigator.getGamepads = () => { window.looks += 1; return [null, window.pad]; };"""


def test_a_gamepad_moves_either_tip_and_its_jaw(two_arms, hand_clock, chromium, monkeypatch):
    session, heard = two_arms.session, []
    rest(session)
    push = session.push
    monkeypatch.setattr(session, "push", lambda motion: (heard.append(motion), push(motion)))
    with chromium.page(WIDTH, HEIGHT) as browser:
        browser.before_pages(PAD)
        opened(browser, two_arms)

        def put(control: str, value: float) -> None:
            """Put a stick or a button somewhere, and wait until the page has seen it there."""
            looks = browser.run(f"(window.pad.{control} = {value}, window.looks)")
            browser.wait_for(f"window.looks > {looks}")

        def hold(control: str, value: float, arm: int, *axes: float) -> None:
            """A tenth of a second of a stick moves one hand and its tip, right, away and out of the view."""
            hands, tips = session.targets, session.frame()["tip"].copy()
            put(control, value)
            browser.wait_until(lambda: heard)
            assert heard[0] == HandMotion(axes, arm)
            hand_clock.now += 0.1
            browser.wait_until(lambda: not np.array_equal(session.targets, hands))
            put(control, 0.0)
            browser.wait_until(lambda: not session._motions)
            heard.clear()
            moved = session.targets - hands
            np.testing.assert_allclose(moved[arm], 0.1 * HAND_SPEED * (np.array(axes) @ session.directions), atol=1e-9)
            assert not moved[1 - arm].any()
            browser.wait_until(lambda: np.linalg.norm(session.frame()["tip"][arm] - tips[arm] - moved[arm]) < 0.001)

        # A worn stick that does not come back to its middle moves nothing.
        put("axes[0]", 0.1)
        put("axes[0]", 0.1)
        hold("axes[1]", 1.0, 0, 0.0, -1.0, 0.0)
        hold("axes[0]", 1.0, 0, 1.0, 0.0, 0.0)
        hold("buttons[6].value", 1.0, 0, 0.0, 0.0, 1.0)
        hold("axes[3]", -1.0, 0, 0.0, 0.0, 1.0)
        put("buttons[0].value", 1.0)
        browser.wait_until(lambda: session.jaw_closed)
        assert heard == [HandMotion((0.0, 0.0, 0.0), 0, turns_jaw=True)]
        heard.clear()
        put("buttons[0].value", 0.0)
        put("buttons[5].value", 1.0)
        put("buttons[5].value", 0.0)
        hold("axes[0]", -1.0, 1, -1.0, 0.0, 0.0)
        hold("buttons[7].value", 1.0, 1, 0.0, 0.0, -1.0)
    assert session.jaw_closed and two_arms._message_filter.dropped == 0
    session.close_jaw(False)


SMOOTH_EDGES = "document.querySelector('canvas[data-engine]').getContext('webgl2').getContextAttributes().antialias"
# The plots' own canvases, as one number.
PLOT = """[...document.querySelectorAll('.uplot canvas')].map(one => {
  const d = one.getContext('2d').getImageData(0, 0, one.width, one.height).data;
  let s = 0; for (let i = 0; i < d.length; i += 4) s = (31 * s + d[i] + 7 * d[i + 3]) % 1000003;
  return s; }).join(' ')"""


def test_without_the_token_a_browser_sees_nothing_of_it(served, chromium):
    with chromium.page(400, 300) as browser:
        browser.open(served.server.address.rpartition("/")[0])
        browser.wait_for("!!document.body && document.body.innerText.includes('surgsim view')")
        assert browser.run("document.querySelectorAll('canvas').length") == 0
        # A page of another origin, in the same browser, that has the address but is not this server's own.
        browser.open("data:text/html,<p>elsewhere</p>")
        browser.wait_for("!!document.body && document.body.innerText.includes('elsewhere')")
        address = served.server.address.replace("http://", "ws://")
        closed = f"new Promise(done => {{ const s = new WebSocket({address!r}); s.onopen = () => done('open');"
        assert browser.run(closed + " s.onerror = () => done('refused'); })") == "refused"
    assert not served.server.viser.get_clients()
