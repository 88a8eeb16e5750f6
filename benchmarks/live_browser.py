"""Pictures a second of a live scene in a software-rendered Chromium, and the speed of the physics meanwhile.

From the repository's root: PYTHONPATH=. python benchmarks/live_browser.py --out docs/images/live_view.png
Prints `name value unit` lines; with --out it presses the organ first and saves a picture of the page.
"""

import argparse
import tempfile
import threading
import time
from pathlib import Path

from agents.command_line import one_line_errors
from surgsim_env.haptics.pacing import timeliness
from surgsim_env.scene.load import make_scene
from tests.chromium import Browser, Chromium

with one_line_errors(__name__, "live"):
    from surgsim_env.cli.view import report_lines
    from surgsim_env.live.page import Page
    from surgsim_env.live.protocol_client import press_path
    from surgsim_env.live.session import Session

# Only frames that show something new count.
COUNTED = "[window.pictures, window.frames_drawn]"
# viser draws fewer pixels than the window has where a browser is slow.
CANVAS_SIZE = "(() => { const c = document.querySelector('canvas[data-engine]'); return [c.width, c.height]; })()"


def press_around(session: Session, stop: threading.Event) -> None:
    """Press in and out at one place; the hand moves 30 times a second."""
    path, start = press_path(session.anatomy), time.monotonic()
    while not stop.wait(1.0 / 30.0):
        session.move_to(0, path(time.monotonic() - start))


def press_raster(session: Session, spacing: float, depth: float) -> None:
    """Press at places around the middle of the palpable face; ends deep in the last one."""
    face, radius = session.anatomy.face, session.scene.instrument.tip_radius
    sites, normals = face.raster(spacing)
    middle = sites.mean(axis=0)
    near = ((sites - middle) ** 2).sum(axis=1).argsort()[:9]
    for number in near[::-1]:
        site, normal = sites[number], normals[number]
        for away in (0.006, -depth, 0.006 if number != near[0] else -depth):
            session.move_to(0, site + normal * (radius + away))
            _let_pass(session, 0.7)


def _let_pass(session: Session, span: float) -> None:
    """Wait until the simulation has advanced by a time [s], however slowly it runs."""
    start = float(session.frame()["time"])
    while float(session.frame()["time"]) - start < span and session.alive:
        time.sleep(0.02)


def main() -> None:
    """Serve the page, open it, measure, and save a picture if --out is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="liver")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--size", type=int, nargs=2, default=(400, 300))
    parser.add_argument("--shadows", action="store_true", help="shadows and reflections too")
    parser.add_argument("--warm-up", type=float, default=30.0, help="in which the browser compiles its shaders [s]")
    parser.add_argument("--out", type=Path, help="keep a picture of the page, with its map and an organ under a press")
    given = parser.parse_args()
    session = Session(make_scene(given.scene))
    page, stop, threads = None, threading.Event(), []
    try:
        session.wait()
        folder = Path(tempfile.mkdtemp())
        page = Page(session, host="127.0.0.1", port=0, remote=False, out=folder / "out")
        page.show_plain(not given.shadows)
        threads.append(threading.Thread(target=page.run, args=(stop.is_set,)))
        threads[0].start()
        with Chromium(folder) as chromium, chromium.page(*given.size) as browser:
            browser.count_pictures()
            browser.open(page.server.address)
            browser.wait_for("!!document.body && document.body.innerText.includes('steps/s')")
            browser.run("document.querySelector('.mantine-Notification-closeButton')?.click()")
            if given.out is not None:
                press_raster(session, session.scene.palpation.site_spacing, session.scene.palpation.press_depth)
                browser.wait_for("window.pictures > 8")
                given.out.write_bytes(browser.shot())
            if given.seconds > 0.0:
                threads.append(threading.Thread(target=press_around, args=(session, stop)))
                threads[-1].start()
                time.sleep(given.warm_up)
                measure(session, browser, given.seconds)
    finally:
        stop.set()
        for thread in threads:
            thread.join()
        if page is not None:
            page.server.stop()
        session.close()


def measure(session: Session, browser: Browser, seconds: float) -> None:
    """Print the rates over some seconds."""
    before, counted, start = session.timing(), browser.run(COUNTED), time.monotonic()
    time.sleep(seconds)
    after, wall = session.timing(), time.monotonic() - start
    pictures, frames = (now - then for now, then in zip(browser.run(COUNTED), counted, strict=True))
    print(f"browser_pictures {pictures / wall:.1f} 1/s")
    print(f"browser_frames {frames / wall:.1f} 1/s")
    width, height = browser.run(CANVAS_SIZE)
    print(f"canvas {width} x {height} pixels")
    print("\n".join(report_lines(timeliness(before[0], after[0], after[1] - before[1]), wall)))


if __name__ == "__main__":
    with one_line_errors(__name__, "live"):
        main()
