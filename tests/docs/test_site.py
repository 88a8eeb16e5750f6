"""The site that `make docs` has just built asks nothing of the network, and its links lead somewhere."""

import html.parser
import os
import re
from pathlib import Path
from urllib.parse import unquote

import pytest

SITE = Path(__file__).resolve().parents[2] / "site"
# `make docs` runs these.
pytestmark = pytest.mark.slow

# What a browser fetches by itself; links are fetched when somebody follows them.
FETCHED = {"img": "src", "script": "src", "link": "href", "source": "src", "iframe": "src", "video": "src"}


class Html(html.parser.HTMLParser):
    """Ids and links of a page, and what it makes a browser fetch."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.ids.update(given[name] for name in ("id", "name") if name in given)
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag in FETCHED and FETCHED[tag] in given and given.get("rel") != "canonical":
            self.fetched.append(given[FETCHED[tag]])


@pytest.fixture(scope="module")
def site_folder() -> Path:
    if not (SITE / "index.html").is_file():
        pytest.skip(f"no site in {SITE}: `make docs` builds it and runs these tests")
    return SITE


@pytest.fixture(scope="module")
def site(site_folder) -> dict[str, Html]:
    """Every page of the built site, by its path."""
    paths = site_folder.rglob("*.html")
    return {path.relative_to(site_folder).as_posix(): Html(path.read_text(encoding="utf-8")) for path in paths}


def pages(site: dict[str, Html]) -> dict[str, Html]:
    return {path: page for path, page in site.items() if path != "404.html"}


def test_links_lead_somewhere(site, site_folder):
    """mkdocs looks at links of Markdown; this one also at those of generated and of HTML parts."""
    lost = []
    for path, page in pages(site).items():
        for link in page.links + page.fetched:
            if re.match(r"[a-z]+:", link):
                continue
            target, _, anchor = unquote(link).partition("#")
            place = os.path.normpath(os.path.join(os.path.dirname(path), target)) if target else path
            if not (site_folder / place).is_file():
                lost.append(f"{path}: {link}")
            elif anchor and place in site and anchor not in site[place].ids:
                lost.append(f"{path}: {link}")
    assert lost == []


def test_nothing_is_fetched_from_elsewhere(site, site_folder):
    fetched = {link for page in pages(site).values() for link in page.fetched}
    assert fetched, "no page fetches its own style sheet?"
    assert [link for link in fetched if re.match(r"(?:[a-z]+:)?//", link)] == []
    styles = [path.read_text(encoding="utf-8") for path in site_folder.rglob("*.css")]
    assert styles and not any(re.search(r"(?:url\(|@import\s+)[\"']?(?:https?:)?//", style) for style in styles)


def test_equations_became_mathml(site_folder):
    for path in site_folder.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        assert "arithmatex" not in text, path
        for drawn in re.findall(r"<math.*?</math>", text, flags=re.DOTALL):
            assert "\\" not in drawn and "merror" not in drawn, (path, drawn)
    assert (site_folder / "concepts.html").read_text(encoding="utf-8").count("equation-number") >= 6
