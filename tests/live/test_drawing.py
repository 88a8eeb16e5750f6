"""Effect of `drawing.js` on a browser that draws in software, on a plain page."""

from importlib.resources import files

import pytest

# The page's clock and its frames are moved by the test, a frame in 20 ms; `frames` counts those that a page is given.
STEPPED = """(() => {
  let now = 1000, number = 0;
  const waiting = new Map();
  performance.now = () => now;
  window.requestAnimationFrame = callback => { waiting.set(++number, callback); return number; };
  window.cancelAnimationFrame = key => { waiting.delete(key); };
  window.step = () => {
    now += 20;
    const due = [...waiting];
    for (const [key, callback] of due) if (waiting.delete(key)) callback(now);
  };
  window.frames = 0;
})()"""
# Fifty frames, a second of that clock, with something before each; how many of them the page was given.
SECOND = """(async () => { const before = window.frames;
  for (let count = 0; count < 50; count += 1) { await (%s); window.step(); }
  return window.frames - before; })()"""
NOTHING = "null"
MESSAGE = "new Promise(done => { window.worker.onmessage = done; window.worker.postMessage(0); })"
MOVE = "count % 5 || window.dispatchEvent(new PointerEvent('pointerdown'))"


@pytest.fixture(scope="module")
def browser(chromium):
    with chromium.page(200, 100) as made:
        made.before_pages(STEPPED)
        made.before_pages(files("surgsim_apps.live").joinpath("drawing.js").read_text(encoding="utf-8"))
        made.open("data:text/html,<p>nothing</p>")
        made.wait_for("document.readyState === 'complete' && document.body.innerText.includes('nothing')")
        yield made


def test_software_is_known_and_draws_without_smoothed_edges(browser):
    assert browser.run("window.surgsim.software") is True
    attributes = "document.createElement('canvas').getContext('webgl2', {antialias: true, alpha: false})"
    context = browser.run(attributes + ".getContextAttributes()")
    assert not context["antialias"] and not context["preserveDrawingBuffer"] and not context["alpha"]
    # A canvas of another kind is none of its business.
    assert (
        browser.run("document.createElement('canvas').getContext('2d', {alpha: false}).getContextAttributes().alpha")
        is False
    )


def test_frames_wait_for_something_new(browser):
    browser.run("void (function tick() { window.frames += 1; requestAnimationFrame(tick); })()")
    browser.run(
        "void (window.worker = new Worker(URL.createObjectURL(new Blob(['onmessage = () => postMessage(0)']))))"
    )
    assert browser.run(SECOND % NOTHING) == 10
    assert browser.run(SECOND % MESSAGE) == 50
    assert browser.run(SECOND % NOTHING) == 10
    # Whoever moves the view sees it move.
    assert browser.run(SECOND % MOVE) == 50


def test_a_frame_may_be_called_off_and_a_failing_one_stops_no_other(browser):
    browser.run(
        """window.ran = []; window.addEventListener('error', event => { event.preventDefault(); });
        const off = requestAnimationFrame(() => ran.push('off'));
        requestAnimationFrame(() => { ran.push('one'); throw Error(); });
        requestAnimationFrame(() => ran.push('other')); cancelAnimationFrame(off); undefined"""
    )
    browser.run(SECOND % NOTHING)
    assert browser.run("window.ran.join()") == "one,other"
