"""Pages of large tables take the room of the table of contents as well; commands write them, so it is said here."""

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

WIDE = {"validation.md", "benchmarks.md", "leaderboard.md"}


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Hide the table of contents of these."""
    if page.file.src_uri in WIDE:
        page.meta["hide"] = [*page.meta.get("hide", []), "toc"]
    return markdown
