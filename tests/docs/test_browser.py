"""The site as a browser shows it: no error on its console, nothing from elsewhere, nothing cut off."""

import functools
import http.server
import threading
from collections.abc import Iterator

import pytest

from tests.chromium import GRAB_TIMEOUT

# What the browser made of a page, once that is whole: pictures that are not there, the widest part beside the window,
# what came from elsewhere, the height of the highest formula.
MADE = """({
  unseen: [...document.images].filter(one => !(one.complete && one.naturalWidth)).length,
  widest: document.documentElement.scrollWidth, window: innerWidth,
  elsewhere: performance.getEntriesByType("resource").filter(one => !one.name.startsWith(location.origin)).length,
  math: Math.max(0, ...[...document.querySelectorAll("math")].map(one => one.getBoundingClientRect().height)),
})"""
PAGES = ("index.html", "concepts.html", "environments/palpate.html", "reference/msdm_core.html", "benchmarks.html")


class Silent(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Says nothing."""


@pytest.fixture(scope="module")
def address(site_folder) -> Iterator[str]:
    """Where the site is served."""
    handler = functools.partial(Silent, directory=str(site_folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize(("page", "width"), [*((page, 1280) for page in PAGES), ("index.html", 500), (PAGES[-1], 500)])
def test_pages_are_whole(address, chromium, page, width):
    with chromium.page(width, 900) as browser:
        browser.open(f"{address}/{page}")
        browser.wait_for_page()
        made = browser.run(MADE)
        assert browser.complaints() == []
    assert made["unseen"] == 0 and made["elsewhere"] == 0, made
    assert made["widest"] <= made["window"] == width, made
    # Drawn as mathematics a fraction or a sum is higher than a line of text.
    assert page != "concepts.html" or made["math"] > 35, made


@pytest.mark.parametrize("page", ["index.html", "environments/palpate.html"])
@pytest.mark.parametrize("place", ["served", "disk"])
def test_a_word_that_is_typed_is_found(address, site_folder, chromium, place, page):
    """Material's search fetches its index and works in a worker: neither shows in pages that are only looked at."""
    with chromium.page(1280, 900) as browser:
        browser.open(f"{address if place == 'served' else site_folder.as_uri()}/{page}")
        browser.wait_for_page()
        browser.wait_for(f"!!{SEARCHED}")

        def answers() -> bool:
            """Whether the word is found soon after it was typed: the page may not listen yet."""
            browser.run(f"{SEARCHED}.focus(), {SEARCHED}.select()")
            browser.type("watchdog")
            return browser.becomes(lambda: browser.run(f"{FOUND}.length > 0"), GRAB_TIMEOUT)

        browser.wait_until(answers)
        found = browser.run(f"{FOUND}.map(one => [one.href, one.textContent])")
        assert any("haptics.html" in link and "watchdog" in text.lower() for link, text in found), found
        assert browser.complaints() == []


SEARCHED = "document.querySelector('input.md-search__input')"
FOUND = "[...document.querySelectorAll('a.md-search-result__link')]"
