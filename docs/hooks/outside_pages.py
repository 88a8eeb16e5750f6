"""Pages of the repository that do not lie in docs/ have their place on the site too; their pictures come along."""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]

# Where each stands in the repository, and its place on the site.
OUTSIDE = {
    "agents/README.md": "agents.md",
    "agents/LEADERBOARD.md": "leaderboard.md",
    "scenes/README.md": "scenes.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add each page, its links turned towards the site."""
    for path, place in OUTSIDE.items():
        text = (ROOT / path).read_text(encoding="utf-8")
        for picture in sorted(set(re.findall(r"\]\(([^)\s]+\.(?:png|webp|svg))\)", text))):
            _add_picture(picture, path, files, config)
        files.append(File.generated(config, place, content=_turned(text, path)))
    return files


def _turned(text: str, path: str) -> str:
    """The page's text with its links as seen from the top of docs/."""

    def turn(link: re.Match[str]) -> str:
        target, _, anchor = link[1].partition("#")
        known = _in_repository(target, path)
        place = OUTSIDE.get(known) or known.removeprefix("docs/")
        return f"]({place}{'#' + anchor if anchor else ''})"

    return re.sub(r"\]\((?![a-z]+:|#)([^)\s]+)\)", turn, text)


def _add_picture(picture: str, path: str, files: Files, config: MkDocsConfig) -> None:
    place = _in_repository(picture, path)
    if not place.startswith("docs/"):
        files.append(File.generated(config, place, abs_src_path=str(ROOT / place)))


def _in_repository(target: str, path: str) -> str:
    """A link of the page at `path` as a path from the repository's root."""
    return (ROOT / path).parent.joinpath(target).resolve().relative_to(ROOT).as_posix()
