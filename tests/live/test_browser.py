"""The page in a real browser, drawn in software: opened, its probe dragged, organ and force trace seen to follow."""

import io
import threading

import numpy as np
import pytest
from PIL import Image

from surgsim_env.live.page import Page
from surgsim_env.live.session import Session
from surgsim_env.live.stage import page_camera
from surgsim_env.pacing import PaceSettings
from surgsim_env.scenes import make_scene
from tests.live.chromium import CHROMIUM, Browser

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium (.ci/run does)")
WIDTH, HEIGHT = 900, 600
# Pictures are drawn by the processor that the physics runs on: it goes at a tenth of real time here.
PACE = PaceSettings(period=0.010)
CANVAS = "document.querySelector('canvas').getBoundingClientRect()"


@pytest.fixture
def served(tmp_path):
    session = Session(make_scene("phantom_small"), pace=PACE)
    page, stop = None, threading.Event()
    thread = None
    try:
        session.wait()
        page = Page(session, host="127.0.0.1", port=0, remote=False, out=tmp_path / "out")
        page.show_plain(True)
        thread = threading.Thread(target=page.run, args=(stop.is_set,))
        thread.start()
        yield page
    finally:
        stop.set()
        if thread is not None:
            thread.join(timeout=20)
        if page is not None:
            page.server.stop()
        session.close()


def picture(browser, tmp_path) -> np.ndarray:
    browser.shot(tmp_path / "shot.png")
    return np.asarray(Image.open(io.BytesIO((tmp_path / "shot.png").read_bytes())).convert("RGB")).astype(int)


def seen_at(browser, page, place) -> tuple[float, float]:
    """Where a place of the scene [m] is on the page [pixels]."""
    box = browser.run(f"(() => {{ const r = {CANVAS}; return [r.x, r.y, r.width, r.height]; }})()")
    camera = page_camera(page.session.anatomy)
    at, _ = camera.project(np.array([place]), box[2], box[3])
    return box[0] + float(at[0, 0]), box[1] + float(at[0, 1])


def wait_until(browser, condition, seconds=120.0):
    """Until something is so on the server's side, while the browser goes on."""
    browser.wait_for("new Promise(done => setTimeout(() => done(true), 50))")
    for _ in range(int(seconds / 0.2)):
        if condition():
            return
        browser.run("new Promise(done => setTimeout(() => done(true), 200))")
    raise AssertionError("it did not come to pass")


def test_the_page_opens_and_its_probe_is_dragged_into_the_organ(served, tmp_path):
    session = served.session
    with Browser(tmp_path, WIDTH, HEIGHT) as browser:
        browser.open(served.server.address)
        browser.wait_for("!!document.body && document.body.innerText.includes('Force and depth')", 120)
        browser.wait_for("document.body.innerText.includes('steps/s')", 120)
        assert browser.run("location.search") == ""
        wait_until(browser, lambda: served.pictures > 10)
        before = picture(browser, tmp_path)
        rest = session.frame()["node"].copy()
        plot_before = browser.run(PLOT)

        start = session.targets[0]
        grip = start + 0.02 * session.directions[2]
        down = start - 0.030 * session.directions[2]
        browser.run("document.querySelector('.mantine-Notification-closeButton')?.click()")
        x, y = seen_at(browser, served, grip)
        to_x, to_y = seen_at(browser, served, down + 0.02 * session.directions[2])
        browser.drag((x, y), (to_x, to_y))
        wait_until(browser, lambda: np.linalg.norm(session.targets[0] - start) > 0.015)
        wait_until(browser, lambda: np.linalg.norm(session.frame()["force"][0]) > 0.05)
        assert np.linalg.norm(session.frame()["node"] - rest, axis=1).max() > 0.001
        wait_until(browser, lambda: browser.run(PLOT) != plot_before)
        after = picture(browser, tmp_path)

        box = browser.run(f"(() => {{ const r = {CANVAS}; return [r.x, r.y, r.width, r.height]; }})()")
        middle = (slice(int(0.2 * box[3]), int(0.9 * box[3])), slice(int(0.25 * box[2]), int(0.6 * box[2])))
        changed = np.abs(before[middle] - after[middle]).max(axis=2) > 24
        assert changed.mean() > 0.01
        # The organ is there: reddish, and shaded, not one flat colour.
        red = after[(after[:, :, 0] > 1.6 * after[:, :, 2]) & (after[:, :, 0] > 60)]
        assert len(red) > 2000 and len(np.unique(red, axis=0)) > 50

        browser.click_on("Pause")
        wait_until(browser, lambda: served._panel._pause.label == "Go on")
        browser.wait_for("document.body.innerText.includes('Go on')")
        # viser's camera complains of its own way to hear the wheel.
        assert [one for one in browser.complaints() if "passive event listener" not in one] == []
    assert served._judge.dropped == 0 and served._judge.ignored == 0


# The plots' own canvases, as one number.
PLOT = """[...document.querySelectorAll('.uplot canvas')].map(one => {
  const d = one.getContext('2d').getImageData(0, 0, one.width, one.height).data;
  let s = 0; for (let i = 0; i < d.length; i += 4) s = (31 * s + d[i] + 7 * d[i + 3]) % 1000003;
  return s; }).join(' ')"""


def test_without_the_token_a_browser_sees_nothing_of_it(served, tmp_path):
    with Browser(tmp_path, 400, 300) as browser:
        browser.open(served.server.address.split("?")[0])
        browser.wait_for("!!document.body && document.body.innerText.includes('surgsim view')", 120)
        assert browser.run("document.querySelectorAll('canvas').length") == 0
        # A page of another origin, in the same browser, that has the address but is not this server's own.
        browser.open("data:text/html,<p>elsewhere</p>")
        browser.wait_for("!!document.body && document.body.innerText.includes('elsewhere')")
        address = served.server.address.replace("http://", "ws://")
        closed = f"new Promise(done => {{ const s = new WebSocket({address!r}); s.onopen = () => done('open');"
        assert browser.run(closed + " s.onerror = () => done('refused'); })") == "refused"
    assert not served.server.viser.get_clients()
