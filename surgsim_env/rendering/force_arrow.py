"""The tissue's force on each tool as an arrow with its size in newtons, drawn over a finished picture."""

import math

import numpy as np
from numpy.typing import NDArray

from msdm_core.kernels.contact_kernels import QUADRATURE_BARYCENTRIC, QUADRATURE_COUNT
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.rendering.cameras import Camera

# A force whose label would be "0.00 N" is not drawn [N].
SMALLEST_FORCE = 0.005
COLOUR, OUTLINE, LABEL_BACK = (255, 214, 10, 255), (25, 22, 0, 255), (10, 14, 18, 165)
# Half width of the shaft, half width and length of the head, outline, at a picture height of 480 [pixels].
SHAFT, HEAD_WIDTH, HEAD_LENGTH, EDGE, TEXT_SIZE = 3.0, 8.0, 16.0, 1.3, 15.0
# Room for head and label beyond the arrow's ends: to the left and up, to the right and down, likewise [pixels].
ROOM = np.array([[20.0, 36.0], [95.0, 36.0]])
# The arrow is painted larger by this factor and scaled down, so that its edges are smooth.
OVERSAMPLING = 3


def draw_forces(frame: NDArray[np.uint8], simulation: Simulation, camera: Camera, mm_per_newton: float) -> None:
    """Paint the force on each tool into a picture (height, width, 3), as seen by its camera."""
    for tool, force in enumerate(simulation.contact_wrench[:, :3]):
        size = float(np.linalg.norm(force))
        if size < SMALLEST_FORCE:
            continue
        start = contact_point(simulation, tool)
        ends = np.stack([start, start + force * mm_per_newton * 1e-3])
        pixels, depth = camera.project(ends, frame.shape[1], frame.shape[0])
        # After a fault positions may not be finite.
        if (depth > 0.0).all() and np.isfinite(pixels).all():
            _paint(frame, pixels, f"{size:.2f} N")


def contact_point(simulation: Simulation, tool: int) -> FloatArray:
    """Middle of the surface that a tool touches [m], shape (3,); the tool's centre of mass without contact."""
    state, model, shapes = simulation.organ_state, simulation.organ_model, simulation.instrument.shapes
    engaged = state.contact_engaged[shapes.shape_tool == tool].any(axis=0).reshape(-1, QUADRATURE_COUNT)
    if not engaged.any():
        return shapes.tool_centre[tool].copy()
    triangles, points = np.nonzero(engaged)
    corners = state.node_position[model.surface_triangles[triangles]]
    weights = model.surface_rest_area[triangles]
    touched = np.einsum("qc,qcx->qx", QUADRATURE_BARYCENTRIC[points], corners)
    return weights @ touched / weights.sum()


def _paint(frame: NDArray[np.uint8], ends: FloatArray, label: str) -> None:
    """An outlined arrow between two points [pixels] and a label beside its head, into the picture."""
    from PIL import Image, ImageDraw, ImageFont

    scale = frame.shape[0] / 480.0
    lower = np.maximum(np.floor(ends.min(axis=0) - ROOM[0] * scale), 0.0).astype(int)
    upper = np.minimum(np.ceil(ends.max(axis=0) + ROOM[1] * scale), [frame.shape[1], frame.shape[0]]).astype(int)
    if (upper <= lower).any():
        return
    many = OVERSAMPLING
    size = (upper - lower) * many
    layer = Image.new("RGBA", (int(size[0]), int(size[1])), (0, 0, 0, 0))
    draw = ImageDraw.Draw(layer)
    start, end = (ends - lower) * many
    outline = _arrow(start, end, scale * many, EDGE * scale * many)
    draw.polygon([tuple(point) for point in outline], fill=OUTLINE)
    draw.polygon([tuple(point) for point in _arrow(start, end, scale * many, 0.0)], fill=COLOUR)
    font = ImageFont.load_default(size=max(TEXT_SIZE * scale * many, 1.0))
    # Beyond the head, to the right of it where the arrow points up or down.
    place = end + np.array([14.0, 5.0 if end[1] > start[1] else -23.0]) * scale * many
    box = np.array(draw.textbbox(tuple(place), label, font=font))
    box += np.array([-5, -4, 5, 4]) * scale * many
    # Moved back into the picture where it would be cut off.
    shift = np.maximum(-box[:2], 0.0) + np.minimum(size - box[2:], 0.0)
    draw.rounded_rectangle((box + np.tile(shift, 2)).tolist(), radius=4 * scale * many, fill=LABEL_BACK)
    draw.text(tuple(place + shift), label, font=font, fill=COLOUR)
    small = layer.resize(tuple((upper - lower).tolist()), Image.Resampling.BOX)
    part = (slice(lower[1], upper[1]), slice(lower[0], upper[0]))
    below = Image.fromarray(frame[part]).convert("RGBA")
    frame[part] = np.asarray(Image.alpha_composite(below, small).convert("RGB"))


def _arrow(start: FloatArray, end: FloatArray, scale: float, edge: float) -> FloatArray:
    """Corners of an arrow from start to end, made wider by an edge on every side [pixels], shape (7, 2)."""
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length if length > 0.0 else np.array([0.0, -1.0])
    across = np.array([-along[1], along[0]])
    head = min(HEAD_LENGTH * scale, max(0.6 * length, 0.5 * HEAD_LENGTH * scale))
    wide = HEAD_WIDTH * scale * head / (HEAD_LENGTH * scale)
    slope = math.hypot(head, wide) / wide
    neck, tip = end - (head + edge) * along, end + edge * slope * along
    shaft, wing = SHAFT * scale * min(1.0, wide / (HEAD_WIDTH * scale) + 0.25) + edge, wide + 1.8 * edge
    tail = start - edge * along
    return np.stack(
        [
            tail + shaft * across,
            neck + shaft * across,
            neck + wing * across,
            tip,
            neck - wing * across,
            neck - shaft * across,
            tail - shaft * across,
        ]
    )
