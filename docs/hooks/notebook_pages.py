"""Notebooks become pages: docs/notebooks/NAME.ipynb is notebooks/NAME.html with its stored outputs, and a file to save.

Nothing runs here; docs/make_notebooks.py runs them. On the page of all notebooks, links to them lead to their pages,
and `<!-- notebook pictures -->` becomes one picture of each.
"""

import base64
import json
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

FOLDER = "notebooks"
PICTURES = "<!-- notebook pictures -->"
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
TO_NOTEBOOK = re.compile(r"\]\((\w+)\.ipynb\)")
PNG = "image/png"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add each notebook's page, and its pictures."""
    for path in _notebooks(config):
        text, pictures = page_of(json.loads(path.read_text(encoding="utf-8")), path.stem)
        files.append(File.generated(config, f"{FOLDER}/{path.stem}.md", content=text))
        for place, content in pictures.items():
            files.append(File.generated(config, f"{FOLDER}/{place}", content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill in the page of all notebooks."""
    if page.file.src_uri != f"{FOLDER}/index.md":
        return markdown
    shown = []
    for path in _notebooks(config):
        _, pictures = page_of(json.loads(path.read_text(encoding="utf-8")), path.stem)
        if not pictures:
            raise PluginError(f"{path.name} holds no picture: run it with docs/make_notebooks.py")
        title = title_of(path)
        # The largest file is the one of an organ; curves are smaller.
        place = max(pictures, key=lambda place: len(pictures[place]))
        shown.append(f"## {title}\n\n[![{title}]({place})]({path.stem}.md)")
    return TO_NOTEBOOK.sub(r"](\1.md)", markdown).replace(PICTURES, "\n\n".join(shown))


def page_of(notebook: dict[str, Any], name: str) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and its pictures by their places beside the page.

    Raises:
        PluginError: an output that is neither text nor a picture, such as an error.
    """
    parts, pictures, heading = [], {}, name
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            heading = (HEADING.findall(source) or [heading])[-1]
            parts.append(TO_NOTEBOOK.sub(r"](\1.md)", source))
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if PNG in data:
                place = f"{name}/{len(pictures)}.png"
                pictures[place] = base64.b64decode("".join(data[PNG]))
                parts.append(f"![{heading}]({place})")
            elif output["output_type"] == "stream" or "text/plain" in data:
                text = "".join(output.get("text", data.get("text/plain", "")))
                parts.append(f'```text title="prints"\n{text.rstrip()}\n```')
            else:
                raise PluginError(f"{name}.ipynb: an output of the kind {output['output_type']!r} cannot be shown")
    parts.insert(1, f"[Save this notebook]({name}.ipynb){{ download={name}.ipynb }}")
    return "\n\n".join(parts) + "\n", pictures


def title_of(path: Path) -> str:
    """The first heading of a notebook."""
    first = json.loads(path.read_text(encoding="utf-8"))["cells"][0]
    match = HEADING.search("".join(first["source"]))
    if match is None:
        raise PluginError(f"{path.name}: its first cell has no heading")
    return match[1]


def _notebooks(config: MkDocsConfig) -> list[Path]:
    return sorted((Path(config.docs_dir) / FOLDER).glob("*.ipynb"))
