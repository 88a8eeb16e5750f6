"""The page in a real browser, drawn in software: opened, its probe dragged, organ and force trace seen to follow."""

import contextlib
import io
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from surgsim_apps.haptics.pacing import PaceSettings
from surgsim_apps.live.exchange_records import Pause, Phase, Reset
from surgsim_apps.live.messages import HandMotion
from surgsim_apps.live.page import Page, Tabs
from surgsim_apps.live.session import HAND_SPEED, Session
from surgsim_apps.live.stage import page_camera
from surgsim_env.scene.load import make_scene, with_instrument
from surgsim_env.scene.model import Scene
from tests.live.served import Clock, on_a_fast_machine, wait_until

WIDTH, HEIGHT = 900, 600
# Pictures are drawn by the processor that the physics runs on: it goes at a tenth of real time here.
PACE = PaceSettings(period=0.010)
CANVAS = "document.querySelector('canvas').getBoundingClientRect()"


@contextlib.contextmanager
def serving(scene: Scene, folder: Path, clock: Callable[[], float] = time.monotonic) -> Iterator[Page]:
    session = Session(on_a_fast_machine(scene), pace=PACE, clock=clock)
    page, stop = None, threading.Event()
    thread = None
    try:
        session.wait()
        page = Page(session, Tabs(0), folder / "out")
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
    browser.wait_for("document.querySelector('#surgsim .number')?.innerText.includes('N')")
    made = page.pictures
    browser.wait_until(lambda: page.pictures > made + 3)
    browser.run("document.querySelector('.mantine-Notification-closeButton')?.click()")


def picture(browser) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(browser.shot())).convert("RGB")).astype(int)


def seen_at(browser, page, place) -> tuple[float, float]:
    """Position on the page [pixels] of a scene's place [m]."""
    box = browser.run(f"(() => {{ const r = {CANVAS}; return [r.x, r.y, r.width, r.height]; }})()")
    camera = page_camera(page.session.anatomy, upright=box[2] < box[3])
    at, _ = camera.project(np.array([place]), box[2], box[3])
    return box[0] + float(at[0, 0]), box[1] + float(at[0, 1])


@contextlib.contextmanager
def pressing(browser, page, place) -> Iterator[None]:
    """The pointer is held on a place of the organ [m] until it presses back; let go at the end."""
    session, at = page.session, seen_at(browser, page, place)
    browser.mouse("mouseMoved", *at)
    browser.next_frame()
    browser.mouse("mousePressed", *at, 1)
    browser.wait_until(lambda: np.linalg.norm(session.frame()["force"][0]) > 0.05)
    yield
    browser.mouse("mouseReleased", *at)
    browser.wait_until(lambda: not session.frame()["force"][0].any())


def test_the_page_opens_and_a_pointer_presses_the_organ(served, chromium):
    session = served.session
    with chromium.page(WIDTH, HEIGHT) as browser:
        opened(browser, served)
        assert browser.run("document.cookie") == ""
        # Who holds still has no breath to hold.
        assert "Close the jaw" not in browser.text() and "Hold the breath" not in browser.text()
        # It draws in software, and has reported so.
        browser.wait_for(PLAIN_LIGHT)
        assert not browser.run(SMOOTH_EDGES)
        before = picture(browser)
        rest = session.frame()["node"].copy()
        plot_before = browser.run(PLOT)

        with pressing(browser, served, middle_of(session.anatomy)):
            browser.wait_until(lambda: np.linalg.norm(session.frame()["node"] - rest, axis=1).max() > 0.001)
            browser.wait_until(lambda: browser.run(PLOT) != plot_before)
            browser.wait_until(lambda: shown_force(browser) > 0.05)
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

        # A page that is loaded again has the curve of before.
        browser.open(served.server.address)
        opened(browser, served)
        browser.wait_until(lambda: browser.run(CURVE) > 50)
        browser.click_on("Pause")
        browser.wait_until(lambda: session.frame()["phase"] == Phase.PAUSED)
        browser.wait_for("document.body.innerText.includes('Continue')")
        # viser's camera complains of its own way to hear the wheel.
        assert [complaint for complaint in browser.complaints() if "passive event listener" not in complaint] == []


def middle_of(anatomy) -> np.ndarray:
    """Middle of the palpable face [m]."""
    return anatomy.face.project(anatomy.face.points[anatomy.face.triangles].mean(axis=(0, 1)))[0]


def shown_force(browser) -> float:
    """The number over the picture [N]."""
    return float(browser.run("document.querySelector('#surgsim .number').innerText").split()[0])


def test_a_hidden_lesion_is_found_with_the_pointer_alone(served, chromium):
    """From the page's load to the score: a newcomer presses the button, a row of places, and the stiffest again."""
    session, search = served.session, served.search
    with chromium.page(WIDTH, HEIGHT) as browser:
        opened(browser, served)
        organ = int(session.frame()["organ"])
        browser.click_on("Find the hidden lesion")
        browser.wait_until(lambda: int(session.frame()["organ"]) > organ)
        browser.wait_for("document.body.innerText.includes('0 presses')")
        middle, across, along = middle_of(session.anatomy), *session.directions[:2]
        places = [middle + 0.011 * (x * across + y * along) for x in (-1, 0, 1) for y in (-1, 0, 1)]
        forces = []
        for place in places:
            with pressing(browser, served, place):
                steps = session.timing()[0]["steps"]
                browser.wait_until(lambda steps=steps: session.timing()[0]["steps"] > steps + 300)
                forces.append(shown_force(browser))
        with pressing(browser, served, places[int(np.argmax(forces))]):
            pass
        browser.click_on("It is where I pressed last")
        browser.wait_for("document.body.innerText.includes('points of 100')")
        assert search.guess.presses == 10 and search.guess.error < 0.010
        assert f"{search.guess.points} points" in browser.text()
        browser.click_on("Watch a robot search")
        browser.wait_for("document.body.innerText.includes('1 of 12 presses')")
        browser.click_on("Find another")
        browser.wait_until(lambda: search.open and served.robot is None)


def test_an_upright_window_begins_with_the_organ_in_the_middle(served, chromium):
    with chromium.page(420, 800) as browser:
        opened(browser, served)
        # The panel is folded.
        browser.wait_for("document.elementFromPoint(300, 700)?.tagName == 'CANVAS'")
        with pressing(browser, served, middle_of(served.session.anatomy)):
            browser.wait_until(lambda: shown_force(browser) > 0.05)


def is_red(shot: np.ndarray) -> np.ndarray:
    """Mask of the organ's pixels in a picture."""
    return (shot[:, :, 0] > 1.6 * shot[:, :, 2]) & (shot[:, :, 0] > 60)


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
            browser.wait_until(lambda: not any(heard[-1].axes))
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
    assert session.jaw_closed
    session.close_jaw(False)


# Whether its check box is set.
PLAIN_LIGHT = """(() => {
  const label = [...document.querySelectorAll('label')].find(one => one.innerText == 'Plain light');
  return label && document.getElementById(label.htmlFor).checked; })()"""
SMOOTH_EDGES = "document.querySelector('canvas[data-engine]').getContext('webgl2').getContextAttributes().antialias"
# Columns of the first plot with a pixel of the curve's colour.
CURVE = """(() => {
  const one = document.querySelector('.uplot canvas');
  const d = one.getContext('2d').getImageData(0, 0, one.width, one.height).data, columns = new Set();
  for (let i = 0; i < d.length; i += 4)
    if (d[i] > 200 && d[i + 1] > 60 && d[i + 1] < 120 && d[i + 2] < 60) columns.add((i / 4) % one.width);
  return columns.size; })()"""
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
    assert not served.server.viser.get_clients()
