"""Renderer of a simulation, and still pictures of arms on an organ at rest."""

import contextlib
import math
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import OrganDivergedError
from msdm_core.kernels.contact_kernels import QUADRATURE_BARYCENTRIC, QUADRATURE_COUNT
from msdm_core.material.regions import Lesion
from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.rendering import gl
from surgsim_env.rendering.cameras import Camera, scene_cameras
from surgsim_env.rendering.looks import Look
from surgsim_env.rendering.options import RenderOptions, check_camera
from surgsim_env.rendering.painted_fields import PAINTED_FIELDS, PaintedField, draw_bar
from surgsim_env.rendering.scene_model import (
    add_instrument,
    add_lights,
    compile_scene,
    empty_scene,
    find_instrument,
)
from surgsim_env.rendering.stage import LOCK, Canvas, Stage, borrow_stage, give_back_stage
from surgsim_env.rendering.surface import Shape
from surgsim_env.rendering.tissue import Tissue
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.tasks.visibility import Disc

# Height of the shadow above the drape [m].
SHADOW_GAP = 0.0002
# Smallest drawn force [N]; below, its label would be "0.00 N".
SMALLEST_FORCE = 0.005
# Length of a force's arrow [m/N].
FORCE_LENGTH = 0.06
ARROW_COLOUR, ARROW_OUTLINE, LABEL_BACK = (255, 214, 10, 255), (25, 22, 0, 255), (10, 14, 18, 165)
# Half width of the shaft, half width and length of the head, outline, at a picture height of 480 [pixels].
ARROW_SHAFT, ARROW_HEAD_WIDTH, ARROW_HEAD_LENGTH, ARROW_EDGE, TEXT_SIZE = 3.0, 8.0, 16.0, 1.3, 15.0
# Room for head and label beyond the arrow's ends: to the left and up, to the right and down, also [pixels].
ARROW_ROOM = np.array([[20.0, 36.0], [95.0, 36.0]])
# The arrow is painted larger by this factor and scaled down: antialiasing.
OVERSAMPLING = 3
# Background of still pictures, and their far clipping plane [m], beyond the length of an arm.
STILL_BACKGROUND, STILL_FAR = (0.93, 0.95, 0.96), 10.0


class OrganRenderer:
    """Colour, depth and labels of the current state of a simulation, without changing it.

        renderer = OrganRenderer(simulation, RenderOptions(camera="endoscope"))
        frame = renderer.rgb()

    `lesions` are the episode's, shown if the options ask for them; `target` is a disc to be shown. A `look` shifts
    cameras given by name and adds its noise of the `moment`, the number of the episode's step, to colour. OpenGL
    is loaded with the first picture. Renderers of one anatomy and size share one stage.
    """

    def __init__(
        self,
        simulation: Simulation,
        options: RenderOptions | None = None,
        *,
        lesions: Sequence[Lesion] = (),
        gl_context: Any = None,
    ) -> None:
        """Take a simulation; `gl_context` is a window's, None for pictures off screen. Graphics are loaded later."""
        self.options = options or RenderOptions()
        self.cameras: dict[str, Camera] = {}
        self.lesions: tuple[Lesion, ...] = tuple(lesions)
        self.target: Disc | None = None
        self.look: Look | None = None
        self.moment = 0
        self._simulation = simulation
        self._anatomy: Anatomy | None = None
        self._gl_context = gl_context
        self._stage: Stage | None = None
        self._tissue: Tissue | None = None
        self._tissue_lesions: tuple[Lesion, ...] = ()
        self._scale_end = 0.0
        self.follow_anatomy()

    def follow_anatomy(self) -> None:
        """Replace cameras and graphics if the simulation has changed to another member of its family."""
        anatomy = self._simulation.anatomy
        if self._anatomy is anatomy:
            return
        self.close()
        self._anatomy = anatomy
        self.cameras.update(scene_cameras(anatomy, self.options.width / self.options.height))

    def rgb(self, camera: str | Camera | None = None) -> NDArray[np.uint8]:
        """Picture of the current state, shape (height, width, 3), its first row on top.

        Args:
            camera: a name in `cameras`, or a camera of your own; that of the options if left out.

        Raises:
            ValueError: an unknown camera (lists the known ones).
            NoGLError: there is no OpenGL; names the missing packages.
        """
        view = self._camera(camera)
        with self._shown(view, in_colour=True) as stage:
            frame = stage.colour()
        if self.look is not None:
            frame = self.look.exposed(frame, self.moment)
        if self.options.paint is not None:
            draw_bar(frame, PAINTED_FIELDS[self.options.paint], self._scale_end)
        if self.options.show_force:
            draw_forces(frame, self._simulation, view)
        return frame

    def depth(self, camera: str | Camera | None = None) -> NDArray[np.float32]:
        """Distance of each pixel from the camera's plane [m], infinite for background, shape (height, width).

        The surface of a translucent organ counts; the force arrow does not.
        """
        with self._shown(self._camera(camera)) as stage:
            return stage.depth()

    def segmentation(self, camera: str | Camera | None = None) -> NDArray[np.uint8]:
        """Label of each pixel by `stage.LABELS`, shape (height, width).

        Lesions are labelled if the options show them, also through a translucent organ.
        """
        with self._shown(self._camera(camera)) as stage:
            return stage.labels()

    def close(self) -> None:
        """Free the graphics; the next picture loads them again."""
        if self._stage is not None:
            self._finalizer()
            self._stage = self._tissue = None

    def __getstate__(self) -> dict[str, Any]:
        """State without graphics: a copy loads its own."""
        return {**self.__dict__, "_stage": None, "_tissue": None, "_finalizer": None}

    def present(self, frame: NDArray[np.uint8]) -> None:
        """Show a picture in the renderer's window."""
        canvas = self._ready_stage().canvas
        with LOCK:
            canvas.gl_context.make_current()
            canvas.present(frame)

    @contextlib.contextmanager
    def _shown(self, camera: Camera, *, in_colour: bool = False) -> Iterator[Stage]:
        """Stage with the simulation's current state before a camera; its graphics context is current."""
        with LOCK:
            stage = self._ready_stage()
            stage.canvas.gl_context.make_current()
            self._show(stage, camera, in_colour)
            yield stage

    def _camera(self, camera: str | Camera | None) -> Camera:
        if isinstance(camera, Camera):
            return camera
        name = self.options.camera if camera is None else camera
        check_camera(name)
        self.follow_anatomy()
        seen = self.cameras[name]
        return seen if self.look is None else self.look.seen_from(seen)

    def _ready_stage(self) -> Stage:
        self.follow_anatomy()
        # Looks and the colours of a field are those of the plain style.
        style = "plain" if self.look is not None or self.options.paint is not None else self.options.style
        if self._stage is not None and self._stage.style != style:
            self.close()
        if self._stage is None:
            context = gl.context() if self._gl_context is None else self._gl_context
            simulation = self._simulation
            options = replace(self.options, style=style)
            self._stage = borrow_stage(simulation.anatomy, simulation.instrument.model, options, context)
            self._finalizer = weakref.finalize(self, give_back_stage, self._stage)
        return self._stage

    def _show(self, stage: Stage, camera: Camera, in_colour: bool) -> None:
        simulation, options = self._simulation, self.options
        shown = self.lesions if options.show_lesion or options.cut_away else ()
        if self._tissue is None or shown != self._tissue_lesions:
            self._tissue = Tissue(simulation.anatomy, stage.surface, shown, options.cut_away)
            self._tissue_lesions = shown
        nodes, tissue, scene = simulation.organ_state.node_position, self._tissue, stage.scene
        shapes = tissue.shapes(nodes)
        if options.paint is not None:
            self._paint(shapes, PAINTED_FIELDS[options.paint], tissue)
        if "shadow" in scene.meshes:
            up = -simulation.anatomy.downward
            triangles = simulation.anatomy.mesh.boundary_triangles
            light = scene.light if self.look is None else self.look.lit(scene.light, -up)
            shapes["shadow"] = ground_shadow(nodes, triangles, light, scene.ground, up)
        lesions = tissue.lesion_ellipsoids(nodes) if options.show_lesion else []
        data = simulation.instrument.data
        stage.show(camera, shapes, data, lesions, self.target, self.look, in_colour=in_colour)

    def _paint(self, shapes: dict[str, Shape], field: PaintedField, tissue: Tissue) -> None:
        """Give the shapes of tissue their places on a field's scale, whose end is NaN for a diverged organ."""
        model = self._simulation.organ_model
        try:
            nodes = field.node_values(model, self._simulation.fields())
        except OrganDivergedError:
            nodes = np.full(len(model.node_mass), np.nan)
        values = tissue.vertex_values(nodes)
        self._scale_end = field.scale_end(np.concatenate(list(values.values())))
        for name, value in values.items():
            shares = field.shares(value, self._scale_end)
            shapes[name] = replace(shapes[name], face_places=shapes[name].faces, shares=shares)


def ground_shadow(
    points: FloatArray, triangles: IntArray, light: FloatArray, ground: FloatArray, up: FloatArray
) -> Shape:
    """Projection of the lit triangles along the light onto the plane through `ground` [m] with unit normal `up`."""
    height = (points - ground) @ up - SHADOW_GAP
    flat = points - (height / (light @ up))[:, None] * light
    corners = flat[triangles]
    lit = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ up > 0.0
    return Shape(flat, np.tile(up, (len(flat), 1)), triangles[lit])


def draw_arm_still(
    arm: mujoco.MjModel,
    posed: mujoco.MjData,
    ball: FloatArray,
    colour: tuple[float, ...],
    camera: Camera,
    size: tuple[int, int],
) -> NDArray[np.uint8]:
    """Draw a picture (height, width, 3) of an arm alone.

    Args:
        arm: its model.
        posed: its data, with computed kinematics.
        ball: middle and radius of a ball to show beside it [m], (4,).
        colour: of the ball.
        camera: its `up` is the scene's.
        size: width and height [pixels].

    Raises:
        NoGLError: there is no OpenGL; names the missing packages.
    """
    context = gl.context()
    spec = empty_scene(*size, STILL_BACKGROUND, far=STILL_FAR)
    add_lights(spec, -camera.up)
    add_instrument(spec, arm, "arm")
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    spec.worldbody.add_geom(type=sphere, rgba=colour, contype=0, conaffinity=0, pos=ball[:3], size=[ball[3], 0.0, 0.0])
    model, data, _ = compile_scene(spec, [])
    find_instrument(model, arm, "arm").pose(posed, data)
    with LOCK:
        context.make_current()
        canvas = Canvas(model, data, context)
        canvas.select()
        canvas.look(camera)
        frame = canvas.colour()
        canvas.close()
    return frame


# ---- the tissue's force on each tool: an arrow with its size in newtons over a finished picture --------------------


def draw_forces(frame: NDArray[np.uint8], simulation: Simulation, camera: Camera) -> None:
    """Paint the tissue's force on each tool, with its size in newtons, into a camera's picture (height, width, 3)."""
    for tool, force in enumerate(simulation.contact_wrench[:, :3]):
        size = float(np.linalg.norm(force))
        if size < SMALLEST_FORCE:
            continue
        start = contact_point(simulation, tool)
        ends = np.stack([start, start + FORCE_LENGTH * force])
        pixels, depth = camera.project(ends, frame.shape[1], frame.shape[0])
        # After a divergence positions may not be finite.
        if (depth > 0.0).all() and np.isfinite(pixels).all():
            _paint_arrow(frame, pixels, f"{size:.2f} N")


def contact_point(simulation: Simulation, tool: int) -> FloatArray:
    """Middle of a tool's contact area [m], shape (3,); the tool's centre of mass without contact."""
    state, model, shapes = simulation.organ_state, simulation.organ_model, simulation.instrument.shapes
    engaged = state.contact_engaged[shapes.shape_tool == tool].any(axis=0).reshape(-1, QUADRATURE_COUNT)
    if not engaged.any():
        return shapes.tool_centre[tool].copy()
    triangles, points = np.nonzero(engaged)
    corners = state.node_position[model.surface_triangles[triangles]]
    weights = model.surface_rest_area[triangles]
    places = np.einsum("qc,qcx->qx", QUADRATURE_BARYCENTRIC[points], corners)
    return weights @ places / weights.sum()


def _paint_arrow(frame: NDArray[np.uint8], ends: FloatArray, label: str) -> None:
    """Paint an outlined arrow between two points [pixels] and a label beside its head."""
    from PIL import Image, ImageDraw, ImageFont

    scale = frame.shape[0] / 480.0
    lower = np.maximum(np.floor(ends.min(axis=0) - ARROW_ROOM[0] * scale), 0.0).astype(int)
    upper = np.minimum(np.ceil(ends.max(axis=0) + ARROW_ROOM[1] * scale), [frame.shape[1], frame.shape[0]]).astype(int)
    if (upper <= lower).any():
        return
    size = (upper - lower) * OVERSAMPLING
    layer = Image.new("RGBA", (int(size[0]), int(size[1])), (0, 0, 0, 0))
    draw = ImageDraw.Draw(layer)
    start, end = (ends - lower) * OVERSAMPLING
    outline = _arrow(start, end, scale * OVERSAMPLING, ARROW_EDGE * scale * OVERSAMPLING)
    draw.polygon([tuple(point) for point in outline], fill=ARROW_OUTLINE)
    draw.polygon([tuple(point) for point in _arrow(start, end, scale * OVERSAMPLING, 0.0)], fill=ARROW_COLOUR)
    font = ImageFont.load_default(size=max(TEXT_SIZE * scale * OVERSAMPLING, 1.0))
    # Beyond the head and to the right of it, below or above with the arrow's direction.
    place = end + np.array([14.0, 5.0 if end[1] > start[1] else -23.0]) * scale * OVERSAMPLING
    box = np.array(draw.textbbox(tuple(place), label, font=font))
    box += np.array([-5, -4, 5, 4]) * scale * OVERSAMPLING
    # Moved back into the picture if it would be cut off.
    shift = np.maximum(-box[:2], 0.0) + np.minimum(size - box[2:], 0.0)
    draw.rounded_rectangle((box + np.tile(shift, 2)).tolist(), radius=4 * scale * OVERSAMPLING, fill=LABEL_BACK)
    draw.text(tuple(place + shift), label, font=font, fill=ARROW_COLOUR)
    small = layer.resize(tuple((upper - lower).tolist()), Image.Resampling.BOX)
    part = (slice(lower[1], upper[1]), slice(lower[0], upper[0]))
    below = Image.fromarray(frame[part]).convert("RGBA")
    frame[part] = np.asarray(Image.alpha_composite(below, small).convert("RGB"))


def _arrow(start: FloatArray, end: FloatArray, scale: float, edge: float) -> FloatArray:
    """Corners of an arrow from start to end, wider by an edge on each side [pixels], shape (7, 2)."""
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length if length > 0.0 else np.array([0.0, -1.0])
    across = np.array([-along[1], along[0]])
    head = min(ARROW_HEAD_LENGTH * scale, max(0.6 * length, 0.5 * ARROW_HEAD_LENGTH * scale))
    wide = ARROW_HEAD_WIDTH * scale * head / (ARROW_HEAD_LENGTH * scale)
    slope = math.hypot(head, wide) / wide
    neck, tip = end - (head + edge) * along, end + edge * slope * along
    shaft, wing = ARROW_SHAFT * scale * min(1.0, wide / (ARROW_HEAD_WIDTH * scale) + 0.25) + edge, wide + 1.8 * edge
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
