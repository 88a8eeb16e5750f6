"""Options of pictures."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

from surgsim_env.rendering.painted_fields import PAINTED_FIELDS
from surgsim_env.scene.load import nearest, require_known

# Cameras of each scene.
CAMERAS = ("overview", "endoscope", "side", "above")
# Styles of pictures.
STYLES = ("endoscopic", "plain")
# Largest side of a picture [pixels] that any OpenGL driver can draw.
PIXELS_MOST = 4096


class UnknownArgumentError(ValueError, TypeError):
    """An argument that an environment does not have; also a TypeError, as of any call: TorchRL tries arguments so."""


@dataclass(frozen=True)
class RenderOptions:
    """Options of pictures, for `gym.make(..., render_mode=...)`; all have defaults.

    Args:
        camera: "overview" (organ and instrument), "endoscope" (the palpable face, near and oblique), "side" (level) or
            "above" (from straight above).
        width: of the picture [pixels], up to 4096.
        height: likewise.
        show_force: draw the tissue's force on each tool as an arrow with its size in newtons; none where it is 0.
        show_lesion: the organ is translucent and its lesions are solid inside.
        cut_away: the organ is cut open through its first lesion (without one, through its palpable face).
        smooth_edges: four samples for each pixel; without it pictures take half the time.
        paint: field painted on the organ, a name of `painted_fields.PAINTED_FIELDS`; None for none.
        style: "endoscopic" (wet tissue in an abdomen, lit by an endoscope) or "plain" (a drape with squares); pictures
            with a look or with paint are plain.

    Raises:
        ValueError: names the option, its value and the rule.
    """

    camera: str = "overview"
    width: int = 640
    height: int = 480
    show_force: bool = True
    show_lesion: bool = False
    cut_away: bool = False
    smooth_edges: bool = True
    paint: str | None = None
    style: str = "endoscopic"

    def __post_init__(self) -> None:
        check_camera(self.camera)
        require_known("style", self.style, STYLES)
        if self.paint is not None:
            require_known("paint", self.paint, PAINTED_FIELDS)
        for name in ("width", "height"):
            value = getattr(self, name)
            if not isinstance(value, int) or not 1 <= value <= PIXELS_MOST:
                raise ValueError(f"{name} is {value!r}; it must be a whole number of pixels from 1 to {PIXELS_MOST}")


OPTION_NAMES = [option.name for option in fields(RenderOptions)]


def check_camera(camera: str) -> None:
    """Raise a ValueError with the known cameras if there is none of that name."""
    require_known("camera", camera, CAMERAS)


def render_options(arguments: dict[str, Any]) -> RenderOptions:
    """Options of pictures from keyword arguments.

    Raises:
        UnknownArgumentError: an unknown argument (suggests the nearest).
        ValueError: a value that breaks its rule.
    """
    require_arguments(arguments, OPTION_NAMES)
    return RenderOptions(**arguments)


def require_arguments(given: Iterable[str], known: list[str]) -> None:
    """Raise an UnknownArgumentError with the known names and the nearest if one is not among them."""
    for name in given:
        if name not in known:
            hint = nearest(name, known)
            raise UnknownArgumentError(f"unexpected keyword argument {name!r}; there are {', '.join(known)}{hint}")
