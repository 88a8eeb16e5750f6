"""Fields of tissue painted on an organ: their values at nodes, the scale of their colours, and its bar in a picture."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.fields import TissueFields

# Perceptually uniform, and distinct for all kinds of colour blindness.
COLOUR_MAP = "viridis"
# A scale's length is one of these times a power of ten, so that it changes in few steps.
STEPS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
# Length and width of a picture's bar, its distance from the edges, and the size of its text, at a picture height of 480
# [pixels].
BAR_LENGTH, BAR_WIDTH, BAR_GAP, BAR_TEXT = 150.0, 10.0, 14.0, 14.0
BAR_BACK, BAR_INK = (10, 14, 18), (235, 238, 240)


@dataclass(frozen=True)
class PaintedField:
    """A field with a value at each node.

    Fields:
        title: in words
        unit: of shown values, "" for a ratio
        shown: shown value over that in SI units
        lowest: start of the scale, the value of undeformed tissue [unit]
        least: smallest length of the scale; below, rounding errors would be painted [unit]
        at_nodes: values at the nodes, (n_node,), in SI units
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
        """End of the scale of values [unit]: the first round number that none exceeds."""
        length = max(float(values.max()) - self.lowest, self.least)
        power = 10.0 ** np.floor(np.log10(length))
        return self.lowest + power * next(step for step in STEPS if step * power >= length * (1.0 - 1e-12))

    def shares(self, values: FloatArray, end: float) -> FloatArray:
        """Place of values on the scale up to its end [unit], 0 to 1; values below its start have the first colour."""
        return np.clip((values - self.lowest) / (end - self.lowest), 0.0, 1.0)

    def text(self, value: float) -> str:
        """A value [unit] with its unit."""
        return f"{value:.3g} {self.unit}".rstrip()


def _of_triangles(model: OrganModel, fields: TissueFields, values: FloatArray) -> FloatArray:
    """Mean at each node over the surface triangles around it by present area; 0 inside the organ."""
    count, corners = len(model.node_mass), model.surface_triangles
    area = np.bincount(corners.ravel(), np.repeat(fields.area, 3), count)
    total = np.bincount(corners.ravel(), np.repeat(values * fields.area, 3), count)
    return np.divide(total, area, out=np.zeros(count), where=area > 0.0)


def _of_tets(model: OrganModel, values: FloatArray) -> FloatArray:
    """Mean at each node over the tets around it by undeformed volume."""
    quarters = np.repeat(0.25 * values * model.tet_rest_volume, 4)
    return np.bincount(model.tet_nodes.ravel(), quarters, len(model.node_mass)) / model.node_rest_volume


# By the names of the option `paint`.
PAINTED_FIELDS = {
    "pressure": PaintedField(
        "contact pressure", "kPa", 1e-3, 0.0, 0.1, lambda model, fields: _of_triangles(model, fields, fields.pressure)
    ),
    "stress": PaintedField("von Mises stress", "kPa", 1e-3, 0.0, 0.1, lambda _, fields: fields.von_mises),
    "stretch": PaintedField(
        "largest principal stretch", "", 1.0, 1.0, 0.01,
        lambda model, fields: _of_tets(model, fields.principal_stretch[:, 0]),
    ),
    "energy": PaintedField("strain energy density", "kJ/m^3", 1e-3, 0.0, 0.01, lambda _, fields: fields.energy_density),
}  # fmt: skip


@cache
def field_colours(count: int) -> NDArray[np.uint8]:
    """Colours of a scale from its start to its end, (count, 3)."""
    from matplotlib import colormaps

    return colormaps[COLOUR_MAP](np.linspace(0.0, 1.0, count), bytes=True)[:, :3]


def draw_bar(frame: NDArray[np.uint8], field: PaintedField, end: float) -> None:
    """Paint the bar of a field's scale up to its end [unit] into the lower left of a picture (height, width, 3)."""
    from PIL import Image, ImageDraw, ImageFont

    size = frame.shape[0] / 480.0
    length, width, gap = (max(1, round(part * size)) for part in (BAR_LENGTH, BAR_WIDTH, BAR_GAP))
    picture = Image.fromarray(frame)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(size=max(BAR_TEXT * size, 1.0))
    line = round(1.25 * BAR_TEXT * size)
    top = picture.height - gap - width - 2 * line
    box = (gap // 2, top - gap // 2, length + 3 * gap // 2, picture.height - gap // 2)
    wide = draw.textlength(field.title, font=font) + 3 * gap // 2
    draw.rectangle((*box[:2], max(box[2], wide), box[3]), fill=BAR_BACK)
    draw.text((gap, top), field.title, font=font, fill=BAR_INK)
    bar = np.broadcast_to(field_colours(length), (width, length, 3))
    picture.paste(Image.fromarray(np.ascontiguousarray(bar)), (gap, top + line))
    below = top + line + width
    draw.text((gap, below), f"{field.lowest:g}", font=font, fill=BAR_INK)
    draw.text((gap + length, below), field.text(end), font=font, fill=BAR_INK, anchor="ra")
    frame[:] = np.asarray(picture)
