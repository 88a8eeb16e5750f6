"""Reports as single HTML files: pictures and a scene that turns embedded, nothing loaded; for any browser.

A report is a template in `templates/` that extends `base.html.j2`. It sets `title`, `verdict` (the first paragraph) and
`sections`, a list of (id, heading, content); sections without content are left out. `parts.html.j2` has the macros for
tables and pictures. All values are escaped.
"""

import base64
import io
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from surgsim_apps.reports.turning_scene import TurningScene

# The browser refuses to load anything.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
# The scene's script reads its meshes from an address with the data in it.
SCENE_POLICY = "; script-src 'unsafe-inline'; connect-src data:"


@dataclass(frozen=True, eq=False)
class Picture:
    """PNG picture of a report.

    Fields:
        title: heading of its caption
        description: in the caption and as the alternative text
        png: bytes of the file
        name: of its file; "" for none
    """

    title: str
    description: str
    png: bytes
    name: str = ""

    @classmethod
    def of_file(cls, path: Path, title: str, description: str) -> "Picture":
        """Picture of a PNG file."""
        return cls(title, description, path.read_bytes(), path.name)

    @property
    def url(self) -> str:
        """Data URL of the picture."""
        from PIL import Image

        # A third of the size of PNG.
        stream = io.BytesIO()
        Image.open(io.BytesIO(self.png)).convert("RGB").save(stream, "webp", quality=90)
        return f"data:image/webp;base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"


def render_page(template: str, *, generator: str = "surgsim", scene: TurningScene | None = None, **values: Any) -> str:
    """Text of a page: a template of `templates/` with its values; `generator` names its program."""
    policy = POLICY if scene is None else POLICY + SCENE_POLICY
    return _templates().get_template(template).render(generator=generator, policy=policy, scene=scene, **values)


@cache
def _templates() -> Environment:
    return Environment(
        loader=PackageLoader("surgsim_apps.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
