"""Fields of tissue painted on an organ: their values at nodes, the scale of their colours, and its bar in a picture."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from msdm_core.organ.fields import TissueFields
from msdm_core.organ.measure import corner_sums

# Perceptually uniform, and distinct for all kinds of colour blindness.
COLOUR_MAP = "viridis"
# Share of a picture's height that the text beside the bar takes.
TEXT_HEIGHT = 0.03


@dataclass(frozen=True)
class PaintedField:
    """A field with a value at each node, and the linear scale of its colours.

    Fields:
        title: in words
        unit: of shown values, "" for a ratio
        shown: shown value over that in SI units
        lowest: start of the scale, the value of undeformed tissue [unit]
        least: smallest length of the scale; below, rounding errors would be painted [unit]
        at_nodes: values at the nodes in SI units, (n_node,)
    """

    title: str
    unit: str
    shown: float
    lowest: float
    least: float
    at_nodes: Callable[[OrganModel, TissueFields], FloatArray]

    def node_values(self, model: OrganModel, fields: TissueFields) -> FloatArray:
        """Values at the nodes of an organ [unit], (n_node,)."""
        return self.shown * self.at_nodes(model, fields)

    def scale_end(self, values: FloatArray) -> float:
        """End of the scale of values [unit]: the largest; NaN if one is."""
        return float(np.maximum(values.max(), self.lowest + self.least))

    def shares(self, values: FloatArray, end: float) -> FloatArray:
        """Place of values on the scale up to its end [unit], 0 to 1; 0 also below its start, and for NaN."""
        return np.nan_to_num(np.clip((values - self.lowest) / (end - self.lowest), 0.0, 1.0))

    def scale_text(self, end: float) -> str:
        """Title, start and end [unit] of the scale."""
        return f"{self.title}: {self.lowest:g} to {end:.3g} {self.unit}"


def _node_means(model: OrganModel, items: IntArray, values: FloatArray, weights: FloatArray) -> FloatArray:
    """Mean at each node over the items (n_item, n_corner) around it, by their weights; 0 at nodes of none."""
    total, weight = (corner_sums(model, items, part) for part in (values * weights, weights))
    return np.divide(total, weight, out=total, where=weight > 0.0)


def _pressure(model: OrganModel, fields: TissueFields) -> FloatArray:
    return _node_means(model, model.surface_triangles, fields.pressure, fields.area)


def _stretch(model: OrganModel, fields: TissueFields) -> FloatArray:
    return _node_means(model, model.tet_nodes, fields.principal_stretch[:, 0], model.tet_rest_volume)


# By the names of the option `paint`.
PAINTED_FIELDS = {
    "pressure": PaintedField("contact pressure", "kPa", 1e-3, 0.0, 0.1, _pressure),
    "stress": PaintedField("von Mises stress", "kPa", 1e-3, 0.0, 0.1, lambda _, fields: fields.von_mises),
    "stretch": PaintedField("largest principal stretch", "", 1.0, 1.0, 0.01, _stretch),
    "energy": PaintedField("strain energy density", "kJ/m^3", 1e-3, 0.0, 0.01, lambda _, fields: fields.energy_density),
}


@cache
def field_colours(count: int) -> NDArray[np.uint8]:
    """Colours of a scale from its start to its end, (count, 3)."""
    from matplotlib import colormaps

    return colormaps[COLOUR_MAP](np.linspace(0.0, 1.0, count), bytes=True)[:, :3]


def draw_bar(frame: NDArray[np.uint8], field: PaintedField, end: float) -> None:
    """Paint the scale of a field up to its end [unit] into the lower left of a picture (height, width, 3)."""
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.fromarray(frame)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(size=TEXT_HEIGHT * picture.height)
    text, line = field.scale_text(end), round(TEXT_HEIGHT * picture.height)
    width = round(draw.textlength(text, font=font))
    top = picture.height - 4 * line
    draw.rectangle((0, top, width + 2 * line, picture.height), fill="black")
    draw.text((line, top + line // 2), text, font=font, fill="white")
    bar = Image.fromarray(np.repeat(field_colours(256)[None], line, axis=0))
    picture.paste(bar.resize((width, line)), (line, top + 5 * line // 2))
    frame[:] = np.asarray(picture)
