"""MuJoCo model of an arm: read from MJCF or URDF, checked against its description, placed at a port, compiled."""

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from msdm_core.arithmetic import matmul, norm
from msdm_core.mesh_files.mesh_file import checked_content
from msdm_core.organ.support import Support
from surgsim_env.instruments.arm.urdf import check_numbers, import_mesh, prepare_urdf
from surgsim_env.instruments.joint_couplings import Followers, followers_of, narrowed_limits
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP, add_supports
from surgsim_env.scene.arm_description import ArmDescription, LinkInertia, Trocar
from surgsim_env.scene.load import nearest
from surgsim_env.scene.model import Port, YieldingWall, frame_into

# Groups of geoms: visual only, and outer links for clearances; geoms of CONTACT_GROUP touch tissue.
VISUAL_GROUP, LINK_GROUP = 1, 2
TIP_SITE = "surgsim_tip"
# A yielding wall, its joints (the last along the port's axis), and what slides on the shaft, with its mass [kg].
WALL, WALL_JOINTS, CANNULA, CANNULA_MASS = "wall", ("wall_x", "wall_y", "wall_z"), "cannula", 0.01
# Couplings of joints are as rigid as MuJoCo can make them: within two steps, and by all but 1e-4 of their force.
COUPLING_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
# Joints of a URDF that may follow others and be followed.
URDF_JOINTS = ("revolute", "continuous", "prismatic")
# Limits that PyBullet writes for a joint without any.
NO_LIMITS = [0.0, -1.0]
# Largest size of a model file [bytes]: chosen, MuJoCo would read a larger one for minutes.
FILE_SIZE_MOST = 200_000_000
# Colour of a description's added shapes.
SHAPE_COLOUR = (0.72, 0.74, 0.78, 1.0)


def compile_arm(
    description: ArmDescription,
    port: Port,
    tip_radius: float | None,
    timestep: float,
    supports: Sequence[Support] = (),
    supports_move: bool = False,
) -> mujoco.MjModel:
    """Compile the model of an arm alone with its trocar at a port; `tip_radius` [m] replaces that of the tip's ball.

    In MuJoCo geoms collide only with supports. Bodies are gravity-compensated; gravity is that of the model file.

    Raises:
        ValueError: a missing or broken file, or a part of the description without a match in the model.
    """
    where = f"arm {description.name!r}"
    try:
        with warned(where):
            spec = arm_spec(description, port, tip_radius, timestep)
            add_supports(spec, supports, moving=supports_move)
            model = spec.compile()
            _narrow_limits(model, description)
    except (ValueError, TypeError, RuntimeError, mujoco.FatalError) as error:
        raise ValueError(f"{where}: {' '.join(str(error).split())}") from None
    _check_joints(model, description, where)
    return model


def arm_spec(description: ArmDescription, port: Port, tip_radius: float | None, timestep: float) -> mujoco.MjSpec:
    """Specification of `compile_arm`, also for a model with several arms."""
    spec = read_model(description.folder / description.model, description.inertias, description.dropped_meshes)
    _add_shapes(spec, description)
    _check_parts(spec, description)
    hold_joints(spec, description.held)
    _set_up(spec, description, port, tip_radius, timestep)
    if port.wall is not None:
        _add_wall(spec, description.trocar, port, port.wall)
    return spec


@contextmanager
def warned(where: str) -> Iterator[None]:
    """Turn MuJoCo's warnings within the block into Python warnings, in place of printed and logged lines.

    Those of equal limits are left out: `_check_joints` and `surgsim arm check` name them.
    """
    messages: list[str] = []
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(messages.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)
        for text in dict.fromkeys(text for text in messages if "limit ignored" not in text):
            warnings.warn(f"{where}: MuJoCo: {' '.join(text.split())}", stacklevel=1)


def read_model(path: Path, inertias: Sequence[LinkInertia] = (), dropped_meshes: Sequence[str] = ()) -> mujoco.MjSpec:
    """Read MuJoCo's specification of an MJCF or URDF file.

    Args:
        path: of the file.
        inertias: of links of a URDF file, in place of its own.
        dropped_meshes: file names of left out meshes of a URDF file.

    Raises:
        ValueError: a missing or wrong file; entries for a URDF with an MJCF.
    """
    root = read_xml(path)
    if root.tag == "robot":
        _check_leaders(root)
        prepare_urdf(root, path, inertias, dropped_meshes)
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        spec.modelfiledir = str(path.parent)
        for joint in spec.joints:
            if np.isinf(joint.range).any() or joint.range.tolist() == NO_LIMITS:
                joint.range = [0.0, 0.0]
            joint.limited = mujoco.mjtLimited(int(joint.range[0] < joint.range[1]))
    elif inertias or dropped_meshes:
        name = "inertias" if inertias else "dropped_meshes"
        raise ValueError(f"{name} is for URDF files; model file {path} is MJCF: change it there")
    else:
        spec = mujoco.MjSpec.from_file(str(path))
    for mesh in spec.meshes:
        file = Path(spec.modelfiledir, spec.meshdir, mesh.file)
        if file.is_file():
            import_mesh(mesh, file)
    return spec


def read_xml(path: Path) -> ElementTree.Element:
    """Read the root element of a model file.

    Raises:
        ValueError: an unreadable file, one larger than FILE_SIZE_MOST, one without valid XML, a URDF with text in place
            of a number.
    """
    checked_content(path)
    try:
        size = path.stat().st_size
        if size > FILE_SIZE_MOST:
            raise ValueError(f"model file {path} has {size} bytes; at most {FILE_SIZE_MOST} are read: reduce it")
        root = ElementTree.fromstring(path.read_bytes())
    except OSError as error:
        raise ValueError(f"model file {path} cannot be read: {error.strerror}") from None
    except ElementTree.ParseError as error:
        raise ValueError(f"model file {path} is not valid XML: {error}") from None
    if root.tag == "robot":
        check_numbers(root, path)
    return root


def _check_leaders(root: ElementTree.Element) -> None:
    """Check that the joints of a URDF follow joints that move: MuJoCo leaves out other couplings."""
    moving = {joint.get("name", "") for joint in root.findall("joint") if joint.get("type") in URDF_JOINTS}
    for joint in root.findall("joint"):
        mimic, name = joint.find("mimic"), joint.get("name", "")
        leader = "" if mimic is None else mimic.get("joint", "")
        others = moving - {name}
        if mimic is not None and name in moving and leader not in others:
            raise ValueError(
                f"joint {name!r} follows {leader!r} by <mimic>, which is no other joint that moves"
                f"{nearest(leader, sorted(others))}: name one there, or take the <mimic> out"
            )


def _check_parts(spec: mujoco.MjSpec, description: ArmDescription) -> None:
    """Check that all parts of the description are in the model and of a permitted kind."""
    joints = {joint.name: joint for joint in spec.joints}
    for name in (*description.joints, *description.jaw):
        kind = "jaw joint" if name in description.jaw else "joint"
        _require_part(kind, name, joints)
        if joints[name].type not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            raise ValueError(f"{kind} {name!r} is neither a hinge nor a slide; give single joints")
    for name in description.limits:
        _require_part("limits of joint", name, joints)
    for name, joint in joints.items():
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"the model hangs on the free joint {name!r}: take it out, the port places the arm")
    geoms = {geom.name: geom for geom in spec.geoms}
    tip, trocar = description.tip, description.trocar
    for name in (*description.contact, *description.links, *([tip.ball] if tip.ball else [])):
        kind = "contact geom" if name in description.contact else "geom"
        _require_part(kind, name, geoms)
        rounded = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
        pad = name in description.contact and geoms[name].type == mujoco.mjtGeom.mjGEOM_BOX
        if geoms[name].type not in rounded and not pad:
            shape = geoms[name].type.name.removeprefix("mjGEOM_").lower()
            raise ValueError(
                f"{kind} {name!r} is a {shape}; only spheres and capsules can be felt, and boxes as contact: draw one "
                "around it"
            )
    bodies = {body.name: body for body in spec.bodies}
    _require_part("trocar.shaft_body", trocar.shaft_body, bodies)
    if tip.site is not None:
        _require_part("tip site", tip.site, {site.name: site for site in spec.sites})
    if tip.body is not None:
        _require_part("tip body", tip.body, bodies)


def _require_part(kind: str, name: str, known: Iterable[str]) -> None:
    names = sorted(item for item in known if item)
    if name not in names:
        listed = ", ".join(names) if names else "none with a name"
        raise ValueError(f"{kind} {name!r} is not in the model{nearest(name, names)}; the model has {listed}")


def _set_up(spec: mujoco.MjSpec, arm: ArmDescription, port: Port, tip_radius: float | None, timestep: float) -> None:
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    for geom in spec.geoms:
        geom.contype, geom.conaffinity = 0, 0
        if geom.name and geom.name in arm.contact:
            geom.group = CONTACT_GROUP
        elif geom.name and geom.name in arm.links:
            geom.group = LINK_GROUP
        elif geom.group in (CONTACT_GROUP, LINK_GROUP):
            geom.group = VISUAL_GROUP
        if tip_radius is not None and geom.name and geom.name == arm.tip.ball:
            geom.size = [tip_radius, *geom.size[1:]]
    for body in spec.bodies:
        body.gravcomp = 1.0
    if arm.tip.body is not None:
        spec.body(arm.tip.body).add_site(name=TIP_SITE, pos=arm.tip.offset, size=[0.001, 0.001, 0.001])
    for name, limits in arm.limits.items():
        joint = spec.joint(name)
        if joint is not None:  # None for a held joint
            joint.range = np.array(limits) / _angle_unit(spec, joint)
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
    # Keyframes give a value for each joint and actuator of the file.
    for key in list(spec.keys):
        spec.delete(key)
    coupled: set[str] = set()
    for equality in spec.equalities:
        if equality.type == mujoco.mjtEq.mjEQ_JOINT:
            equality.solref, equality.solimp = (2.0 * timestep, 1.0), COUPLING_SOLIMP
            coupled |= {equality.name1, equality.name2}
    # What follows a driven joint has no drive of its own.
    for actuator in list(spec.actuators):
        if actuator.target in coupled.difference(arm.joints, arm.jaw):
            spec.delete(actuator)
    if arm.control.mode == "servo":
        _add_servos(spec, arm)
    _place(spec, arm, port)


def _add_shapes(spec: mujoco.MjSpec, arm: ArmDescription) -> None:
    """Add the description's own spheres and capsules, without mass; those of links are invisible."""
    bodies, names = {body.name: body for body in spec.bodies}, {geom.name for geom in spec.geoms}
    for shape in arm.shapes:
        _require_part(f"body of shape {shape.name!r},", shape.body, bodies)
        if shape.name in names:
            raise ValueError(f"shapes: the model has a geom {shape.name!r} already: rename the shape")
        colour = (*SHAPE_COLOUR[:3], 0.0) if shape.name in arm.links else SHAPE_COLOUR
        geom = bodies[shape.body].add_geom(name=shape.name, mass=0.0, rgba=colour)
        if shape.end is None:
            geom.type, geom.pos = mujoco.mjtGeom.mjGEOM_SPHERE, shape.start
        else:
            geom.type, geom.fromto = mujoco.mjtGeom.mjGEOM_CAPSULE, [*shape.start, *shape.end]
        geom.size = [shape.radius, 0.0, 0.0]


def hold_joints(spec: mujoco.MjSpec, held: Mapping[str, float]) -> None:
    """Fix joints at values [rad or m]: remove them with their couplings and actuators, and place their bodies.

    Raises:
        ValueError: an unknown joint, or a joint with a body that cannot be moved.
    """
    joints = {joint.name: joint for joint in spec.joints}
    for name, value in held.items():
        _require_part("held joint", name, joints)
        joint, body = joints[name], joints[name].parent
        offset = value - joint.ref * _angle_unit(spec, joint)
        if abs(offset) > 1e-12:
            turned = body.alt.type != mujoco.mjtOrientation.mjORIENTATION_QUAT
            if body.frame is not None or turned or len(body.joints) > 1:
                raise ValueError(
                    f"held joint {name!r} is at {value:g}, but its body {body.name!r} is in a <frame>, turned by other "
                    "angles than a quaternion, or has several joints: hold it at its value in the model, or change that"
                )
            _move_body(body, joint, offset)
        spec.delete(joint)
    coupled = [equality for equality in spec.equalities if not held.keys().isdisjoint((equality.name1, equality.name2))]
    driven = [actuator for actuator in spec.actuators if actuator.target in held]
    for part in (*coupled, *driven):
        spec.delete(part)


def _move_body(body: Any, joint: Any, offset: float) -> None:
    """Place a body as if its joint were displaced by an offset [rad or m] from the model's value."""
    axis = np.array(joint.axis) / norm(joint.axis)
    turned = np.zeros(3)
    if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
        mujoco.mju_rotVecQuat(turned, offset * axis, body.quat)
        body.pos = body.pos + turned
        return
    turn, quaternion, anchor = np.zeros(4), np.zeros(4), np.zeros(3)
    mujoco.mju_axisAngle2Quat(turn, axis, offset)
    mujoco.mju_rotVecQuat(anchor, np.array(joint.pos), turn)
    mujoco.mju_rotVecQuat(turned, np.array(joint.pos) - anchor, body.quat)
    mujoco.mju_mulQuat(quaternion, body.quat, turn)
    body.pos, body.quat = body.pos + turned, quaternion


def _angle_unit(spec: mujoco.MjSpec, joint: Any) -> float:
    """Radians in the unit of a joint's angles in the specification; 1 for slides."""
    return math.radians(1.0) if spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE else 1.0


def _add_servos(spec: mujoco.MjSpec, arm: ArmDescription) -> None:
    """Give each joint a position and a speed servo in place of its actuators; its effort limits their sum."""
    control = arm.control
    for actuator in list(spec.actuators):
        if actuator.target in arm.joints:
            spec.delete(actuator)
    for index, name in enumerate(arm.joints):
        joint, effort = spec.joint(name), control.effort[index]
        if control.armature:
            joint.armature = control.armature[index]
        joint.actfrcrange = [-effort, effort]
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
        shared: dict[str, Any] = {"trntype": mujoco.mjtTrn.mjTRN_JOINT, "target": name}
        hold = spec.add_actuator(name=f"hold_{name}", **shared)
        hold.set_to_position(kp=control.stiffness[index])
        drive = spec.add_actuator(name=f"drive_{name}", **shared)
        drive.set_to_velocity(kv=control.damping[index])
        # The file's default class may limit actuators.
        for servo in (hold, drive):
            servo.ctrllimited = servo.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE


def _place(spec: mujoco.MjSpec, arm: ArmDescription, port: Port) -> None:
    """Move all parts of the model's world so that its trocar coincides with the port."""
    trocar = arm.trocar
    rotation = matmul(port.rotation, frame_into(np.array(trocar.into)).T)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    world = spec.worldbody
    rooted = [part for kind in (world.bodies, world.geoms, world.sites, world.frames) for part in kind]
    rooted = [part for part in rooted if part.frame is None]
    frame = world.add_frame(pos=np.array(port.point) - matmul(rotation, np.array(trocar.point)), quat=quaternion)
    for part in rooted:
        part.set_frame(frame)


def _add_wall(spec: mujoco.MjSpec, trocar: Trocar, port: Port, wall: YieldingWall) -> None:
    """Add a wall on three springs at the port, joined at one point to a cannula that slides on the shaft."""
    most = wall.mass / (spec.option.timestep * spec.option.timestep)
    if max(wall.stiffness_across, wall.stiffness_along) > most:
        raise ValueError(
            f"wall: stiffness {wall.stiffness_across:g} and {wall.stiffness_along:g} N/m; the rule is at most mass / "
            f"step^2 = {most:g} N/m for a stable step: lower it, or raise wall.mass"
        )
    body = spec.worldbody.add_body(name=WALL, pos=port.point, mass=wall.mass, inertia=[1e-6] * 3, gravcomp=1.0)
    mujoco.mju_mat2Quat(body.quat, port.rotation.ravel())
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    for name, axis in zip(WALL_JOINTS, np.eye(3), strict=True):
        along = name == WALL_JOINTS[-1]
        joint = body.add_joint(name=name, type=slide, axis=axis)
        joint.stiffness[0] = wall.stiffness_along if along else wall.stiffness_across
        joint.damping[0] = wall.damping
    cannula = spec.body(trocar.shaft_body).add_body(
        name=CANNULA, pos=trocar.shaft_point, mass=CANNULA_MASS, inertia=[1e-7] * 3, gravcomp=1.0
    )
    joint = cannula.add_joint(name=CANNULA, type=slide, axis=trocar.shaft_axis, frictionloss=wall.friction)
    # By default MuJoCo's friction creeps under half its load.
    joint.solref_friction, joint.solimp_friction = rigid = (2.0 * spec.option.timestep, 1.0), COUPLING_SOLIMP
    for part in (body, cannula):
        part.add_site(name=f"{part.name}_point")
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE, name1=f"{WALL}_point",
        name2=f"{CANNULA}_point", solref=rigid[0], solimp=rigid[1],
    )  # fmt: skip


def _narrow_limits(model: mujoco.MjModel, arm: ArmDescription) -> None:
    """Narrow the limits of driven joints to those of the joints that follow them."""
    driven = [model.joint(name).id for name in arm.joints]
    narrow = narrowed_limits(model, driven, followers_in(model, arm))
    for joint, limits in zip(driven, narrow, strict=True):
        if np.isfinite(limits).all():
            model.jnt_limited[joint], model.jnt_range[joint] = 1, limits


def followers_in(model: mujoco.MjModel, arm: ArmDescription) -> Followers:
    """The followers of an arm's driven joints in its compiled model; the fingers of a jaw have drives of their own."""
    driven, jaw = ([model.joint(name).id for name in names] for names in (arm.joints, arm.jaw))
    return followers_of(model, driven, [joint for joint in range(model.njnt) if joint not in jaw])


def _check_joints(model: mujoco.MjModel, arm: ArmDescription, where: str) -> None:
    """Check that all driven joints have limits around their home values, and position actuators."""
    for name in (*arm.joints, *arm.jaw):
        joint = model.joint(name)
        lower, upper = joint.range
        if not joint.limited[0]:
            raise ValueError(f"{where}: joint {name!r} has no limits, or limits that cross; give it a range")
        home = arm.home.get(name)
        if home is not None and not lower - 1e-9 <= home <= upper + 1e-9:
            raise ValueError(
                f"{where}: home of joint {name!r} is {home:g}, outside its limits {lower:g} to {upper:g} (rad or m)"
            )
        actuator = position_actuator(model, name)
        if actuator < 0:
            raise ValueError(
                f"{where}: joint {name!r} has no position actuator of gear 1; give the model one"
                + (', or use control.mode = "servo"' if name in arm.joints else "")
            )
        least, most = model.actuator_ctrlrange[actuator]
        if model.actuator_ctrllimited[actuator] and (least > lower + 1e-9 or most < upper - 1e-9):
            raise ValueError(
                f"{where}: the position actuator of joint {name!r} takes {least:g} to {most:g}, less than the joint's "
                f"limits {lower:g} to {upper:g}: widen its ctrlrange, or leave it out"
            )


def position_actuator(model: mujoco.MjModel, joint: str) -> int:
    """Index of a joint's position actuator, force = kp (ctrl - q) - kv qdot, or -1."""
    return next((a for a in _actuators(model, joint) if _is_servo(model, a, bias=1)), -1)


def speed_actuator(model: mujoco.MjModel, joint: str) -> int:
    """Index of a joint's speed actuator, force = kv (ctrl - qdot), or -1."""
    return next((a for a in _actuators(model, joint) if _is_servo(model, a, bias=2)), -1)


def _actuators(model: mujoco.MjModel, joint: str) -> list[int]:
    index = model.joint(joint).id
    of_joint = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == index)
    return [int(actuator) for actuator in np.flatnonzero(of_joint)]


def _is_servo(model: mujoco.MjModel, actuator: int, bias: int) -> bool:
    """True if an actuator's force is exactly gain (ctrl - x), with x the position (bias 1) or speed (bias 2)."""
    gain, biases = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator]
    plain = model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE and model.actuator_gear[actuator, 0] == 1.0
    simple = plain and gain > 0.0
    return bool(simple and math.isclose(biases[bias], -gain) and (bias == 1 or biases[1] == 0.0))
