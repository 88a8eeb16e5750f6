"""The site's pages and their links to each other.

Pages of the repository that do not lie in docs/ have their place on the site too; their pictures come along. Where a
page names another one by its path, as `docs/arms.md`, the site has a link with that page's title.
"""

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
# Where each stands in the repository, and its place on the site.
OUTSIDE = {
    "agents/README.md": "agents.md",
    "scenes/README.md": "scenes.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
# Pages of large tables, which commands write.
WIDE = {"validation_rows.md", "benchmarks.md"}

NAMED = re.compile(r"(?:docs|agents|scenes)/[\w/]+\.md|CONTRIBUTING\.md|CHANGELOG\.md")
# A span of code, which is a link where it is such a path and nothing else; or a path in plain text, outside of links.
PLACED = re.compile(rf"`([^`\n]+)`|(?<![\w/.\[-])(?<!\]\()({NAMED.pattern})(?![\w\]])")
# Code, where a path is a path: fenced, indented below a list or not.
FENCED = re.compile(r"(^[ ]*(```+)[\s\S]*?^[ ]*\2[ ]*$)", re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add each page, its links turned towards the site."""
    for path, shown_at in OUTSIDE.items():
        text = (ROOT / path).read_text(encoding="utf-8")
        for picture in sorted(set(re.findall(r"\]\(([^)\s]+\.(?:png|webp|svg))\)", text))):
            place = _in_repository(picture, path)
            if not place.startswith("docs/"):
                files.append(File.generated(config, place, abs_src_path=str(ROOT / place)))
        files.append(File.generated(config, shown_at, content=_turned(text, path)))
    return files


def _turned(text: str, path: str) -> str:
    """The page's text with its links as seen from the top of docs/."""

    def turn(link: re.Match[str]) -> str:
        target, _, anchor = link[1].partition("#")
        known = _in_repository(target, path)
        place = OUTSIDE.get(known) or known.removeprefix("docs/")
        return f"]({place}{'#' + anchor if anchor else ''})"

    return re.sub(r"\]\((?![a-z]+:|#)([^)\s]+)\)", turn, text)


def _in_repository(target: str, path: str) -> str:
    """A link of the page at `path` as a path from the repository's root."""
    return (ROOT / path).parent.joinpath(target).resolve().relative_to(ROOT).as_posix()


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn the names into links, outside of code; give tables of commands the room of the table of contents."""
    if page.file.src_uri in WIDE:
        page.meta["hide"] = [*page.meta.get("hide", []), "toc"]
    here = posixpath.dirname(page.file.src_uri)

    def link(match: re.Match[str]) -> str:
        name = match[1] or match[2]
        place = OUTSIDE.get(name) or name.removeprefix("docs/")
        target = files.get_file_from_path(place) if NAMED.fullmatch(name) else None
        if target is None or target is page.file or not target.inclusion.is_included():
            return match[0]
        heading = re.search(r"^# (.+)$", target.content_string, re.MULTILINE)
        return f"[{heading[1].strip() if heading else name}]({posixpath.relpath(place, here or '.')})"

    parts = FENCED.split(markdown)
    # `split` gives text, the fenced block, its fence, text, ...
    texts = [PLACED.sub(link, part) if number % 3 == 0 else part for number, part in enumerate(parts)]
    return "".join(part for number, part in enumerate(texts) if number % 3 != 2)
