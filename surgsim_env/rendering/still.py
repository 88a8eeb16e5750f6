"""Pictures of arms on an organ at rest, without a simulation."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from surgsim_env.rendering import gl
from surgsim_env.rendering.cameras import Camera
from surgsim_env.rendering.canvas import LOCK, Canvas
from surgsim_env.rendering.drawn_mesh import Shape
from surgsim_env.rendering.instrument_geoms import add_instrument, find_instrument
from surgsim_env.rendering.scene_model import add_lights, add_tissue, compile_scene, empty_scene
from surgsim_env.rendering.surface import drawn_surface

BACKGROUND = (0.93, 0.95, 0.96)
# Far clipping plane [m]: an arm's whole length is seen.
FAR = 10.0


@dataclass(frozen=True, eq=False)
class Capsule:
    """A capsule, or a ball where both ends are the same.

    Fields:
        ends: of its axis [m]                                                       (2, 3)
        radius: [m]                                                                 scalar
        colour: red, green, blue, opacity                                           (4,)
    """

    ends: FloatArray
    radius: float
    colour: tuple[float, float, float, float]


def draw_still(
    surface: tuple[FloatArray, IntArray],
    arms: Sequence[tuple[mujoco.MjModel, mujoco.MjData]],
    capsules: Sequence[Capsule],
    cameras: Sequence[Camera],
    size: tuple[int, int],
) -> list[NDArray[np.uint8]]:
    """A picture (height, width, 3) from each camera.

    Args:
        surface: points [m] (n_node, 3) and outward triangles (n_triangle, 3) of the organ.
        arms: models and data, their kinematics computed; drawn as they are posed.
        capsules: whatever else is there.
        cameras: the first one's `up` is up in the scene.
        size: width and height [pixels].

    Raises:
        NoGLError: there is no OpenGL; names the packages that are missing.
    """
    context = gl.context()
    organ = drawn_surface(*surface)
    spec = empty_scene(*size, BACKGROUND, far=FAR)
    add_lights(spec, -cameras[0].up)
    add_tissue(spec, "organ", organ.vertex_count, len(organ.faces))
    for number, (model, _) in enumerate(arms):
        add_instrument(spec, model, f"arm_{number}")
    for one in capsules:
        _add_capsule(spec, one)
    model, data, meshes = compile_scene(spec, ["organ"])
    for number, (arm, posed) in enumerate(arms):
        find_instrument(model, arm, f"arm_{number}").pose(posed, data)
    with LOCK, gl.current(context):
        canvas = Canvas(model, data, context)
        canvas.select()
        meshes["organ"].upload(Shape(*organ.follow(surface[0]), organ.faces), canvas.context)
        frames = []
        for camera in cameras:
            canvas.look(camera)
            frames.append(canvas.colour())
        canvas.close()
    return frames


def _add_capsule(spec: mujoco.MjSpec, capsule: Capsule) -> None:
    geom = spec.worldbody.add_geom(rgba=capsule.colour, contype=0, conaffinity=0)
    if np.array_equal(*capsule.ends):
        geom.type, geom.pos, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, capsule.ends[0], [capsule.radius, 0.0, 0.0]
    else:
        geom.type, geom.fromto = mujoco.mjtGeom.mjGEOM_CAPSULE, capsule.ends.ravel()
        geom.size = [capsule.radius, 0.0, 0.0]
