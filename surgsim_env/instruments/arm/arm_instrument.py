"""One arm as the instrument of a scene; ports and servos, shared with pairs of arms."""

import math

import mujoco
import numpy as np

from msdm_core.arithmetic import cos, matmul, norm, sin
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.arm.arm import Arm, load_arm
from surgsim_env.instruments.arm.model import position_actuator, speed_actuator
from surgsim_env.instruments.arm.steering import SteeredArm, millimetres, missing, placed
from surgsim_env.instruments.instrument import Instrument, Jaw
from surgsim_env.instruments.tool_bodies import make_servo
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.model import Port, Scene
from surgsim_env.scene.palpable_surface import PalpableFace, tangent_axes

# Ports are 10 to 20 cm from their target, and instrument ports about 8 cm beside the camera's: 13 cm away at 30 degrees
# from the approach is 6.5 cm beside it (port placement for da Vinci: docs/arms.md).
PORT_DISTANCE = 0.13
PORT_TILT = math.radians(30.0)
# Height of the tip above the middle of the palpable face before the first reset [m].
PARKED_GAP = 0.010
# Number of places on the palpable face to be reached by an arm.
PLACES_CHECKED = 24


class SteeredArms(Instrument):
    """Instrument of one arm or two.

    Fields:
        arms: control of each arm, by its side; an arm alone has the side ""
    """

    turning_size = 3
    arms: dict[str, SteeredArm]

    @property
    def workspace_limited(self) -> bool:
        """True if the box, a joint's limit or its speed limit stopped the commanded motion of a tip."""
        return any(arm.limited for arm in self.arms.values())

    @property
    def trocar_residual(self) -> float:
        """Distance of the shaft's axis from the trocar at the current joint values [m], the larger of two arms'."""
        return max(arm.trocar_residual for arm in self.arms.values())

    @property
    def trocar_force(self) -> float | None:
        """Size of the shaft's force on a yielding wall [N], the larger of two arms'; None for rigid walls."""
        forces = [norm(arm.trocar_force) for arm in self.arms.values() if arm.trocar_force is not None]
        return float(max(forces)) if forces else None

    @property
    def tip_reading(self) -> FloatArray:
        """Position of the tip, of two arms the left one's, by the joints' encoders [m], (3,)."""
        return next(iter(self.arms.values())).tip_reading

    def draw_errors(self, rng: np.random.Generator) -> None:
        """Draw the errors of each arm's joints for an episode; of exact joints none."""
        for arm in self.arms.values():
            arm.deviation.draw(rng)

    def get_state(self) -> FloatArray:
        """Whole state of the instrument, with commands and commanded directions, as a vector."""
        return np.concatenate([super().get_state(), *(arm.get_state() for arm in self.arms.values())])

    def set_state(self, state: FloatArray) -> None:
        """Restore a state from `get_state`, to the bit; contact forces are updated by the next haptic step."""
        sizes = [len(arm.get_state()) for arm in self.arms.values()]
        own, *parts = np.split(state, np.cumsum([len(state) - sum(sizes), *sizes])[:-1])
        super().set_state(own)
        for arm, part in zip(self.arms.values(), parts, strict=True):
            arm.set_state(part)


class ArmInstrument(SteeredArms):
    """Arm at a scene's port, commanded by its tip's velocity through inverse kinematics.

    Fields:
        arm: its kinematics
        steered: its control
    """

    def __init__(self, anatomy: Anatomy, lower: FloatArray, upper: FloatArray) -> None:
        """Place the scene's arm at its port; the tip may move in the box from lower to upper [m].

        Raises:
            ValueError: a wrong description or model, a port inside the organ, a palpable face out of reach.
        """
        scene = anatomy.scene
        self.arm = load_scene_arm(anatomy, scene.instrument.model, scene.port or default_port(anatomy.face))
        arm, model = self.arm, self.arm.model
        super().__init__(model, lower, upper, arm.tip_site)
        count = arm.joint_count
        self.servo = joint_servo(model, (*arm.joints, *arm.description.jaw))
        if arm.description.jaw:
            self._set_jaw(Jaw(self, arm.description.jaw, count + np.arange(len(arm.description.jaw))))
        self.steered = SteeredArm(
            arm,
            self,
            np.arange(count),
            direction=start_direction(scene),
            control_step=scene.timing.control_step,
            joint_errors=scene.instrument.joint_errors,
            jaw=self.jaw,
        )
        self.arms = {"": self.steered}
        self.parked = parked_place(anatomy)
        self._check_reach(anatomy)
        self.place(self.parked)
        self.set_patches(scene.instrument, matmul(self.data.site_xmat[arm.tip_site].reshape(3, 3), arm.tip_axis))

    def place(self, position: FloatArray) -> None:
        """Place the tip at rest at a position [m], in the start direction as far as the joints allow.

        A jaw with pads is opened, another jaw is reset.

        Raises:
            ValueError: the tip does not reach the position (gives the distance and the port).
        """
        self._rest()
        self.steered.place(position)
        mujoco.mj_forward(self.model, self.data)

    def command_velocity(self, velocity: FloatArray, turning: FloatArray | None = None) -> None:
        """Command the velocity [m/s] (3,) and the angular velocity [rad/s] (3,) of the tip.

        Valid for one control step; after it the joints continue at the same speeds.
        """
        self.steered.command_velocity(velocity, self.turning_of(turning))

    def _where(self) -> str:
        return self.steered.where

    def _check_reach(self, anatomy: Anatomy) -> None:
        """Check that the tip reaches places all over the palpable face."""
        face, retract = anatomy.face, anatomy.scene.retract
        if retract is not None and retract.flap is not None:
            # Only the edge of a flap is grasped.
            return
        corners = face.points[face.triangles]
        thick = np.flatnonzero(face.thickness >= face.thickness_smallest)
        checked = thick[np.linspace(0, len(thick) - 1, min(PLACES_CHECKED, len(thick))).astype(int)]
        for place in corners[checked].mean(axis=1) - anatomy.scene.instrument.tip_radius * face.approach:
            solution = self.steered.reach(place)
            if not placed(solution):
                raise ValueError(
                    f"{self._where()} does not reach the palpable face of scene {anatomy.scene.name!r} at "
                    f"{millimetres(place)}: {missing(solution)}; move its [port]"
                )


def load_scene_arm(anatomy: Anatomy, name: str, port: Port) -> Arm:
    """Load an arm by its name, or from its file beside the scene, at a port outside the organ.

    Raises:
        ValueError: a wrong description or model, or a port inside the organ.
    """
    scene = anatomy.scene
    check_port_outside(port, anatomy)
    beside = scene.folder / name
    return load_arm(
        beside if beside.is_file() else name,
        port,
        tip_radius=scene.instrument.tip_radius,
        timestep=scene.timing.haptic_step,
        supports=scene.supports,
        supports_move=bool(scene.motions),
    )


def default_port(face: PalpableFace) -> Port:
    """Port above the palpable face, 13 cm from its middle, at 30 degrees from the approach."""
    corners = face.points[face.triangles]
    area = norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    target = matmul(area, corners.mean(axis=1)) / area.sum()
    aside, _ = tangent_axes(face.approach)
    out = float(cos(PORT_TILT)) * -face.approach + float(sin(PORT_TILT)) * aside
    x, y, z = (target + PORT_DISTANCE * out).tolist()
    u, v, w = (-out).tolist()
    return Port((x, y, z), (u, v, w))


def check_port_outside(port: Port, anatomy: Anatomy, *, name: str = "the port") -> None:
    """Check that a port is outside the organ.

    Raises:
        ValueError: the port is inside (states its place and the scene).
    """
    corners = anatomy.mesh.points[anatomy.mesh.tets]
    # Inside a tet the volume [m^3] stays positive, but for rounding, with any corner moved to the port.
    inside = np.ones(len(corners), dtype=bool)
    for corner in range(4):
        moved = corners.copy()
        moved[:, corner] = port.point
        a, b, c = (moved[:, index] - moved[:, 0] for index in (1, 2, 3))
        inside &= (np.cross(a, b) * c).sum(axis=1) >= -1e-15
    if inside.any():
        raise ValueError(
            f"{name} at {millimetres(np.array(port.point))} lies inside the organ of scene {anatomy.scene.name!r}: "
            "move it out through the body wall"
        )


def start_direction(scene: Scene) -> FloatArray:
    """Direction of a scene's tip at the start, (3,)."""
    return np.asarray(scene.instrument.tip_direction or scene.instrument.approach, dtype=np.float64)


def joint_servo(model: mujoco.MjModel, joints: tuple[str, ...]):
    """Servo at rest for joints of a model, in the given order, with their limits."""
    pairs = [(position_actuator(model, name), speed_actuator(model, name)) for name in joints]
    position, speed = np.array(pairs, dtype=np.int64).T.copy()
    lower, upper = np.array([model.joint(name).range for name in joints]).T
    return make_servo(lower, upper, position, speed)


def parked_place(anatomy: Anatomy) -> FloatArray:
    """Position of the tip before the first reset [m], (3,).

    It is above the middle of the palpable face, or at the start of a flap's retraction.
    """
    retract = anatomy.scene.retract
    if retract is not None and retract.flap is not None:
        return 0.5 * (np.array(retract.start_lower) + np.array(retract.start_upper))
    corners = anatomy.face.points[anatomy.face.triangles]
    middle = anatomy.face.project(corners.mean(axis=(0, 1)))[0]
    return middle - (anatomy.scene.instrument.tip_radius + PARKED_GAP) * anatomy.face.approach
