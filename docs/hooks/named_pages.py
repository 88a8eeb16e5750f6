"""Where a page names another one by its path, as `docs/arms.md`, the site has a link with that page's title."""

import posixpath
import re

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page
from outside_pages import OUTSIDE

NAMED = re.compile(r"(?:docs|agents|scenes)/[\w/]+\.md|CONTRIBUTING\.md|CHANGELOG\.md")
# A span of code, which is a link where it is such a path and nothing else; or a path in plain text, outside of links.
PLACED = re.compile(rf"`([^`\n]+)`|(?<![\w/.\[-])(?<!\]\()({NAMED.pattern})(?![\w\]])")
# Code, where a path is a path: fenced, indented below a list or not.
FENCED = re.compile(r"(^[ ]*(```+)[\s\S]*?^[ ]*\2[ ]*$)", re.MULTILINE)


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn the names into links, outside of code."""
    here = posixpath.dirname(page.file.src_uri)

    def link(found: re.Match[str]) -> str:
        name = found[1] or found[2]
        place = OUTSIDE.get(name) or name.removeprefix("docs/")
        target = files.get_file_from_path(place) if NAMED.fullmatch(name) else None
        if target is None or target is page.file or not target.inclusion.is_included():
            return found[0]
        return f"[{_title(target.content_string, name)}]({posixpath.relpath(place, here or '.')})"

    parts = FENCED.split(markdown)
    # `split` gives text, the fenced block, its fence, text, ...
    texts = [PLACED.sub(link, part) if number % 3 == 0 else part for number, part in enumerate(parts)]
    return "".join(part for number, part in enumerate(texts) if number % 3 != 2)


def _title(text: str, path: str) -> str:
    heading = re.search(r"^# (.+)$", text, re.MULTILINE)
    return heading[1].strip() if heading else path
