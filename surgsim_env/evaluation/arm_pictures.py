"""Pictures of two arms in the patient: the organ, the trocars, the endoscope and the arms where they work."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.arms.arm import Arm
from surgsim_env.evaluation.kinematics import BatchKinematics
from surgsim_env.evaluation.ports import Ports
from surgsim_env.evaluation.reach import Reach
from surgsim_env.rendering import gl
from surgsim_env.tool_bodies import CONTACT_GROUP

WIDTH, HEIGHT, FIELD_OF_VIEW = 960, 720, 35.0
# The tips work so far to both sides of the middle [m].
TIPS_ASIDE = 0.02
ORGAN_COLOUR, TROCAR_COLOUR, ENDOSCOPE_COLOUR = (0.50, 0.16, 0.13, 1.0), (0.95, 0.75, 0.2, 1.0), (0.2, 0.25, 0.3, 1.0)
WALL_COLOUR, SKY = (0.85, 0.65, 0.55, 0.18), (0.93, 0.95, 0.96)
DRAWN = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_ELLIPSOID,
         mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX)  # fmt: skip


@dataclass(frozen=True)
class View:
    """Where a camera is [m] (3,), what it looks at [m] (3,), what is up (3,), and its field of view [degrees]."""

    position: FloatArray
    target: FloatArray
    up: FloatArray
    angle: float


def draw_arms(
    points: FloatArray, triangles: IntArray, ports: Ports, left: Reach, right: Reach, sites: FloatArray
) -> dict[str, NDArray[np.uint8]]:
    """Pictures (height, width, 3) by caption: from beside the table and through the endoscope's port.

    The tips stand at the sites (n, 3) [m] nearest to 2 cm on both sides of the middle that their arm reaches; an arm
    that reaches none stands at home. Meshes of a model are not drawn, its spheres, capsules, cylinders and boxes are.

    Raises:
        NoGLError: there is no OpenGL; names what is missing.
    """
    line = np.array(ports.right.point) - np.array(ports.left.point)
    line /= np.linalg.norm(line)
    middle = sites.mean(axis=0)
    poses = [
        (reach.kinematics, _pose(reach, sites, middle + side * TIPS_ASIDE * line))
        for reach, side in ((left, -1.0), (right, 1.0))
    ]
    spec = _stage(points, triangles, ports)
    for kinematics, joints in poses:
        _add_arm(spec, kinematics.arm, joints)
    views = {
        "The arms at their ports": _from_beside(poses, ports, middle),
        "Through the endoscope": _endoscope(ports),
    }
    for index, view in enumerate(views.values()):
        _add_camera(spec, f"view_{index}", view)
    model = spec.compile()
    frames = _render(model, len(views))
    return dict(zip(views, frames, strict=True))


def _pose(reach: Reach, sites: FloatArray, place: FloatArray) -> FloatArray:
    reached = np.flatnonzero(reach.report.reachable[: len(sites)])
    if reached.size == 0:
        return reach.kinematics.arm.home
    nearest = reached[np.argmin(np.linalg.norm(sites[reached] - place, axis=1))]
    return reach.report.joints[nearest]


def _stage(points: FloatArray, triangles: IntArray, ports: Ports) -> mujoco.MjSpec:
    """Organ, wall, trocars, endoscope and light."""
    spec = mujoco.MjSpec()
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=16, height=96)
    sky.builtin, sky.rgb1, sky.rgb2 = mujoco.mjtBuiltin.mjBUILTIN_FLAT, SKY, SKY
    spec.visual.global_.offwidth, spec.visual.global_.offheight = WIDTH, HEIGHT
    spec.visual.map.znear, spec.visual.map.zfar, spec.stat.extent = 0.005, 10.0, 1.0
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35] * 3, [0.35] * 3
    light = spec.worldbody.add_light(name="lamp", dir=-ports.wall_normal + [0.3, 0.2, 0.0])
    light.type, light.diffuse = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, [0.5] * 3
    used, renumbered = np.unique(triangles, return_inverse=True)
    mesh = spec.add_mesh(name="organ", uservert=points[used].ravel(), userface=renumbered.ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    world = spec.worldbody
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="organ", rgba=ORGAN_COLOUR)
    for place in (ports.left, ports.right):
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=place.point, size=[0.008, 0, 0], rgba=TROCAR_COLOUR)
    start, end = np.array(ports.endoscope.point), np.array(ports.endoscope.target)
    along = (end - start) / np.linalg.norm(end - start)
    ends = np.concatenate([start - 0.12 * along, start])
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=[0.006, 0, 0], rgba=ENDOSCOPE_COLOUR)
    if not ports.wall.plate:
        centre, radius = ports.dome_centre, ports.wall.radius
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=centre, size=[radius, 0, 0], rgba=WALL_COLOUR, group=4)
    return spec


def _add_arm(spec: mujoco.MjSpec, arm: Arm, joints: FloatArray) -> None:
    """The arm's geoms as they stand at joint values, each with its own colour."""
    model, data = arm.model, mujoco.MjData(arm.model)
    arm.write(data, joints)
    mujoco.mj_kinematics(model, data)
    for geom in range(model.ngeom):
        if model.geom_group[geom] > CONTACT_GROUP or model.geom_type[geom] not in [int(kind) for kind in DRAWN]:
            continue
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[geom])
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom(int(model.geom_type[geom])),
            size=model.geom_size[geom],
            pos=data.geom_xpos[geom],
            quat=quaternion,
            rgba=model.geom_rgba[geom],
        )


def _from_beside(poses: list[tuple[BatchKinematics, FloatArray]], ports: Ports, middle: FloatArray) -> View:
    """From the side where the arms' bases are not, so far off that all shapes are in sight."""
    ends = np.concatenate([kinematics.at(joints[None]).shape_ends.reshape(-1, 3) for kinematics, joints in poses])
    out = ports.wall_normal
    line = np.array(ports.right.point) - np.array(ports.left.point)
    away = np.cross(line, out)
    away /= np.linalg.norm(away)
    if (ends.mean(axis=0) - middle) @ away > 0.0:
        away = -away
    everything = np.concatenate([ends, middle[None]])
    centre = 0.5 * (everything.min(axis=0) + everything.max(axis=0))
    radius = float(np.linalg.norm(everything - centre, axis=1).max())
    direction = 0.88 * away + 0.48 * out + 0.15 * line / np.linalg.norm(line)
    direction /= np.linalg.norm(direction)
    distance = 1.05 * radius / np.sin(np.radians(0.5 * FIELD_OF_VIEW))
    return View(centre + distance * direction, centre, out, FIELD_OF_VIEW)


def _endoscope(ports: Ports) -> View:
    point, target = np.array(ports.endoscope.point), np.array(ports.endoscope.target)
    line = np.array(ports.right.point) - np.array(ports.left.point)
    along = (target - point) / np.linalg.norm(target - point)
    # The tip of the endoscope is a little way in; the right arm comes from the right.
    return View(point + 0.02 * along, target, np.cross(line, target - point), 70.0)


def _add_camera(spec: mujoco.MjSpec, name: str, view: View) -> None:
    back = view.position - view.target
    back = back / np.linalg.norm(back)
    right = np.cross(view.up, back)
    right /= np.linalg.norm(right)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.column_stack([right, np.cross(back, right), back]).ravel())
    spec.worldbody.add_camera(name=name, pos=view.position, quat=quaternion, fovy=view.angle)


def _render(model: mujoco.MjModel, count: int) -> list[NDArray[np.uint8]]:
    """A frame from each of the model's cameras; the wall in the first alone."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with gl.current(gl.context()):
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        scene, option, camera = (
            mujoco.MjvScene(model, maxgeom=model.ngeom + 100),
            mujoco.MjvOption(),
            mujoco.MjvCamera(),
        )
        option.geomgroup[:] = 1
        camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        frames = []
        for index in range(count):
            camera.fixedcamid = index
            option.geomgroup[4] = index == 0
            every = mujoco.mjtCatBit.mjCAT_ALL
            mujoco.mjv_updateScene(model, data, option, mujoco.MjvPerturb(), camera, every, scene)
            area, frame = mujoco.MjrRect(0, 0, WIDTH, HEIGHT), np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
            mujoco.mjr_render(area, scene, context)
            mujoco.mjr_readPixels(frame, None, area, context)
            frames.append(frame[::-1].copy())
        context.free()
    return frames
