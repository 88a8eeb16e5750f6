"""The site as a browser shows it: no error on its console, nothing from elsewhere, nothing cut off."""

import functools
import http.server
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from tests.live.chromium import Browser

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium (.ci/run does)")
# Puts into the page's title what the browser made of it, in a copy beside the page.
PROBE = """<script>addEventListener("load", () => {
const wide = [...document.images].filter(one => !(one.complete && one.naturalWidth)).length;
const entries = performance.getEntriesByType("resource").map(one => one.name);
const heights = [...document.querySelectorAll("math")].map(one => Math.round(one.getBoundingClientRect().height));
document.title = `unseen ${wide} widest ${document.documentElement.scrollWidth} of ${innerWidth} `
  + `elsewhere ${entries.filter(one => !one.startsWith(location.origin)).length} math ${Math.max(0, ...heights)}`;
});</script>"""
PAGES = ("index.html", "concepts.html", "environments/palpate.html", "reference/msdm_core.html", "benchmarks.html")


class Silent(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Says nothing."""


@pytest.fixture(scope="module")
def address(site_folder) -> Iterator[str]:
    """Where the site is served: Material's search works there, and not from the disk."""
    handler = functools.partial(Silent, directory=str(site_folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def browse(url: str, folder: Path, *options: str) -> subprocess.CompletedProcess:
    assert CHROMIUM is not None
    return subprocess.run(
        [
            *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"),
            *("--disable-background-networking", "--no-first-run", f"--user-data-dir={folder / 'profile'}"),
            *("--enable-logging=stderr", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", *options, url),
        ],
        capture_output=True,
        text=True,
        timeout=180,
    )


@pytest.mark.parametrize(("page", "width"), [*((page, 1280) for page in PAGES), ("index.html", 500), (PAGES[-1], 500)])
def test_pages_are_whole(site_folder, address, tmp_path, page, width):
    path = site_folder / page
    copy = path.with_name(f"probed_{width}_{path.name}")
    copy.write_text(path.read_text(encoding="utf-8").replace("</head>", PROBE + "</head>", 1), encoding="utf-8")
    try:
        url = f"{address}/{copy.relative_to(site_folder).as_posix()}"
        done = browse(url, tmp_path, "--dump-dom", "--virtual-time-budget=5000", f"--window-size={width},900")
    finally:
        copy.unlink()
    assert [line for line in done.stderr.splitlines() if "CONSOLE" in line and "error" in line.lower()] == []
    (title,) = re.findall(r"<title>(.*?)</title>", done.stdout)[:1]
    found = re.fullmatch(r"unseen (\d+) widest (\d+) of (\d+) elsewhere (\d+) math (\d+)", title)
    assert found, title
    unseen, widest, window, elsewhere, math = map(int, found.groups())
    assert unseen == 0 and elsewhere == 0, title
    assert widest <= window, title
    # Drawn as mathematics a fraction or a sum is higher than a line of text.
    assert page != "concepts.html" or math > 35, title


def test_the_home_page_is_painted(address, tmp_path):
    picture = tmp_path / "shot.png"
    done = browse(f"{address}/index.html", tmp_path, f"--screenshot={picture}", "--window-size=1280,1400")
    assert done.returncode == 0, done.stderr
    image = imread(picture)[:, :, :3]
    assert image.shape == (1400, 1280, 3)
    # Our style sheet came along: its dark green bar lies on top.
    np.testing.assert_allclose(image[5, 640], np.array([0x12, 0x34, 0x3B]) / 255, atol=0.02)
    for part in np.split(image, 4):
        assert len(np.unique((part * 255).astype(np.uint8).reshape(-1, 3), axis=0)) > 60


def test_a_word_that_is_typed_is_found(address, tmp_path):
    """Material's search fetches its index and works in a worker: neither shows in pages that are only looked at."""
    with Browser(tmp_path, 1280, 900) as browser:
        browser.open(f"{address}/index.html")
        browser.wait_for("document.readyState === 'complete' && !!document.querySelector('input.md-search__input')")
        browser.run("document.querySelector('input.md-search__input').focus()")
        browser.do("Input.insertText", text="watchdog")
        browser.wait_for(f"{FOUND}.length > 0")
        found = browser.run(f"{FOUND}.map(one => [one.href, one.textContent])")
        assert any("haptics.html" in link and "watchdog" in text.lower() for link, text in found), found
        assert browser.complaints() == []


FOUND = "[...document.querySelectorAll('a.md-search-result__link')]"
