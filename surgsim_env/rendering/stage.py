"""A scene loaded into a graphics context: uploads what moves, draws colour, depth and labels; shared by its users."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.rendering import gl
from surgsim_env.rendering.cameras import Camera
from surgsim_env.rendering.canvas import LOCK, Canvas
from surgsim_env.rendering.drawn_mesh import Shape
from surgsim_env.rendering.instrument_geoms import PREFIX
from surgsim_env.rendering.options import RenderOptions
from surgsim_env.rendering.scene_model import FAR, LESION_COLOUR, NEAR, TARGET_COLOUR, build_scene
from surgsim_env.rendering.surface import DrawnSurface, drawn_surface
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.tasks.visibility import Disc

# Labels of pixels.
LABELS = {"background": 0, "organ": 1, "instrument": 2, "lesion": 3, "target": 4}
# Labels of the scene's meshes.
MESH_LABELS = dict.fromkeys(("organ", "held", "section"), LABELS["organ"]) | {"section_lesion": LABELS["lesion"]}
# Largest number of lesions in a picture; they and a target are geoms that the model does not have.
LESIONS_MOST = 100
# A target is drawn this thick [m], all of it below the disc itself.
TARGET_THICKNESS = 2e-4

_stages: dict[tuple, "Stage"] = {}


@dataclass(frozen=True, eq=False)
class Instant:
    """The contents of a picture.

    Fields:
        shapes: surface and cut faces by their names in the scene
        lesions: centre [m] (3,), half axes [m] (3,) of each solid lesion
        instrument: the instrument's data, which is read
        target: a disc to be drawn, None for none
    """

    shapes: dict[str, Shape]
    lesions: Sequence[tuple[FloatArray, FloatArray]]
    instrument: mujoco.MjData
    target: Disc | None = None


class Stage:
    """The drawn scene of an anatomy, loaded into a graphics context."""

    def __init__(self, anatomy: Anatomy, instrument: mujoco.MjModel, options: RenderOptions, gl_context: Any) -> None:
        """Make the scene and load it into a context."""
        self.users = 0
        self.surface: DrawnSurface = drawn_surface(anatomy.mesh.points, anatomy.mesh.boundary_triangles)
        self.scene = build_scene(anatomy, self.surface, instrument, options)
        self.canvas = Canvas(
            self.scene.model, self.scene.data, gl_context, more_geoms=LESIONS_MOST + 1, shadows=options.shadows
        )
        # Labels of geoms that a picture has beyond those of the model, by their places in it.
        self._added: dict[int, int] = {}

    def show(self, instant: Instant, camera: Camera) -> None:
        """Upload the shapes and poses of a picture and look at them through a camera."""
        self.scene.instrument.pose(instant.instrument, self.scene.data)
        self.canvas.select()
        for name, shape in instant.shapes.items():
            self.scene.meshes[name].upload(shape, self.canvas.context)
        self.canvas.look(camera, sky=camera.sees_above_level())
        self._added.clear()
        for centre, half_axes in instant.lesions[:LESIONS_MOST]:
            self._add_lesion(centre, half_axes)
        if instant.target is not None:
            self._add_target(instant.target)

    def depth(self) -> NDArray[np.float32]:
        """Distance from the camera's plane [m], infinite where there is nothing, shape (height, width)."""
        # 1 / z is linear in the reversed depth.
        raw = self.canvas.depth().astype(np.float64)
        inverse = 1.0 / FAR + raw * (1.0 / NEAR - 1.0 / FAR)
        return np.where(raw > 0.0, 1.0 / inverse, np.inf).astype(np.float32)

    def labels(self) -> NDArray[np.uint8]:
        """Label of each pixel, by LABELS; solid lesions are labelled also through the organ, shape (height, width)."""
        shown = self._labels()
        if self._lesions_solid():
            with self._without_organ():
                inside = self._labels()
            shown[(shown == LABELS["organ"]) & (inside == LABELS["lesion"])] = LABELS["lesion"]
        return shown

    def _labels(self) -> NDArray[np.uint8]:
        numbers, drawn = self.canvas.numbers(), self.canvas.drawn
        table = np.zeros(drawn.ngeom + 1, dtype=np.uint8)
        for geom in drawn.geoms[: drawn.ngeom]:
            if geom.segid >= 0:
                table[geom.segid + 1] = self._label(geom)
        return table[numbers]

    def _label(self, geom: Any) -> int:
        if geom.objtype != mujoco.mjtObj.mjOBJ_GEOM:
            return self._added[geom.segid]
        name = self.scene.model.geom(geom.objid).name
        return LABELS["instrument"] if name.startswith(PREFIX) else MESH_LABELS.get(name, LABELS["background"])

    def _lesions_solid(self) -> bool:
        return LABELS["lesion"] in self._added.values()

    @contextlib.contextmanager
    def _without_organ(self) -> Iterator[None]:
        """Hide the organ's meshes within this block."""
        hidden = [self.scene.meshes[name] for name in ("organ", "held")]
        for mesh in hidden:
            mesh.show(False, self.canvas.context)
        yield
        for mesh in hidden:
            mesh.show(True, self.canvas.context)

    def _add_lesion(self, centre: FloatArray, half_axes: FloatArray) -> None:
        self._add(mujoco.mjtGeom.mjGEOM_ELLIPSOID, half_axes, centre, np.eye(3), LESION_COLOUR, "lesion")

    def _add_target(self, disc: Disc) -> None:
        size = np.array([disc.radius, 0.5 * TARGET_THICKNESS, 0.0])
        centre = disc.centre - 0.5 * TARGET_THICKNESS * disc.normal
        self._add(mujoco.mjtGeom.mjGEOM_CYLINDER, size, centre, disc.rotation, TARGET_COLOUR, "target")

    def _add(
        self, kind: mujoco.mjtGeom, size: FloatArray, centre: FloatArray, rotation: FloatArray,
        colour: tuple[float, float, float], label: str,
    ) -> None:  # fmt: skip
        """Add a geom to the drawn scene that its model does not have."""
        drawn = self.canvas.drawn
        geom = drawn.geoms[drawn.ngeom]
        mujoco.mjv_initGeom(geom, kind, size, centre, rotation.ravel(), np.array([*colour, 1.0], dtype=np.float32))
        geom.specular, geom.shininess = 0.35, 0.5
        # mjv_initGeom does not set these, and the memory is not initialised.
        geom.objtype, geom.objid, geom.category = mujoco.mjtObj.mjOBJ_UNKNOWN, -1, mujoco.mjtCatBit.mjCAT_DECOR
        geom.segid = drawn.ngeom
        self._added[drawn.ngeom] = LABELS[label]
        drawn.ngeom += 1


def borrow_stage(anatomy: Anatomy, instrument: mujoco.MjModel, options: RenderOptions, gl_context: Any) -> Stage:
    """The stage that all simulations of one anatomy share, for pictures of one size and kind; return it when done."""
    key = _key(anatomy, instrument, options, gl_context)
    with LOCK:
        _close_all_at_exit()
        if key not in _stages:
            _stages[key] = Stage(anatomy, instrument, options, gl_context)
        _stages[key].users += 1
        return _stages[key]


def give_back_stage(stage: Stage) -> None:
    """Return a borrowed stage; the last user's return closes it."""
    with LOCK:
        stage.users -= 1
        if stage.users == 0:
            for key in [key for key, one in _stages.items() if one is stage]:
                del _stages[key]
                stage.canvas.close()


def _key(anatomy: Anatomy, instrument: mujoco.MjModel, options: RenderOptions, gl_context: Any) -> tuple:
    drawn = replace(options, camera="overview", show_force=True, force_mm_per_newton=1.0)
    return anatomy, int(instrument.signature), drawn, id(gl_context)


@cache
def _close_all_at_exit() -> None:
    gl.at_exit(_close_all)


def _close_all() -> None:
    while _stages:
        _stages.popitem()[1].canvas.close()
