"""What `drawing.js` makes of a browser that draws in software, on a page of nothing."""

from importlib.resources import files

import pytest

from tests.live.chromium import CHROMIUM, Browser

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium (.ci/run does)")
# Frames that are run within a second [1/s].
FRAMES = """new Promise(done => { let frames = 0, over = false;
  const tick = () => { if (over) return; frames += 1; requestAnimationFrame(tick); };
  requestAnimationFrame(tick); setTimeout(() => { over = true; done(frames); }, 1000); })"""
WORKER = """window.worker = new Worker(URL.createObjectURL(new Blob(['setInterval(() => postMessage(0), 25)'])))"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("drawing"), 200, 100) as made:
        made.before_pages(files("surgsim_env.live").joinpath("drawing.js").read_text(encoding="utf-8"))
        made.open("data:text/html,<p>nothing</p>")
        made.wait_for("document.readyState === 'complete' && document.body.innerText.includes('nothing')")
        yield made


def test_software_is_known_and_draws_without_smoothed_edges(browser):
    assert browser.run("window.surgsim.software") is True
    attributes = "document.createElement('canvas').getContext('webgl2', {antialias: true, alpha: false})"
    found = browser.run(attributes + ".getContextAttributes()")
    assert not found["antialias"] and not found["preserveDrawingBuffer"] and not found["alpha"]
    # A canvas of another kind is none of its business.
    assert (
        browser.run("document.createElement('canvas').getContext('2d', {alpha: false}).getContextAttributes().alpha")
        is False
    )


def test_frames_wait_for_something_new(browser):
    assert 3 <= browser.run(FRAMES) <= 11
    browser.run(f"void ({WORKER})")
    browser.wait_for(FRAMES + ".then(frames => frames > 14)")
    browser.run("window.worker.terminate()")
    assert browser.run(FRAMES) <= 12
    # Whoever moves the view sees it move.
    browser.run("void setInterval(() => window.dispatchEvent(new PointerEvent('pointerdown')), 100)")
    browser.wait_for(FRAMES + ".then(frames => frames > 14)")


def test_a_frame_may_be_called_off_and_a_failing_one_stops_no_other(browser):
    browser.run(
        """window.ran = []; window.addEventListener('error', event => { event.preventDefault(); });
        const off = requestAnimationFrame(() => ran.push('off'));
        requestAnimationFrame(() => { ran.push('one'); throw Error(); });
        requestAnimationFrame(() => ran.push('other')); cancelAnimationFrame(off); undefined"""
    )
    assert browser.wait_for("window.ran.length > 1 && window.ran.join()") == "one,other"
