"""An arm as the instrument of a scene: steered by its tip's velocity through inverse kinematics."""

from pathlib import Path

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy
from surgsim_env.arms.arm import Arm, load_arm
from surgsim_env.arms.model import position_actuator, speed_actuator
from surgsim_env.arms.port import Port
from surgsim_env.arms.port_placement import check_port_outside, default_port
from surgsim_env.arms.steering import SteeredArm, millimetres, missing, placed
from surgsim_env.arms.wrist_sensor import WristSensor
from surgsim_env.instrument import Instrument
from surgsim_env.jaw import Jaw
from surgsim_env.scenes import Scene
from surgsim_env.tool_bodies import make_servo

# Where the tip waits before the first reset: this far above the middle of the palpable face [m].
PARKED_GAP = 0.010
# How many places of the palpable face are tried when an arm is set up.
PLACES_TRIED = 24


class ArmInstrument(Instrument):
    """An arm at a scene's port whose tip is steered by its velocity and points along the scene's approach.

    Fields:
        arm: the arm as a mechanism
        steered: the arm as it is steered
        wrist: its force sensor, None where the model has none
    """

    turning_size = 3

    def __init__(self, anatomy: Anatomy, lower: FloatArray, upper: FloatArray) -> None:
        """Set the scene's arm up at its port; the tip may move in the box from lower to upper [m].

        Raises:
            ValueError: a wrong description or model, a port inside the organ, a palpable face out of reach.
        """
        scene = anatomy.scene
        self.arm = load_scene_arm(anatomy, scene.instrument.model, scene.port or default_port(anatomy.face))
        arm, model = self.arm, self.arm.model
        super().__init__(model, lower, upper, arm.tip_site)
        count = arm.joint_count
        self.servo = joint_servo(model, (*arm.joints, *arm.description.jaw))
        self.servo.lower[:count], self.servo.upper[:count] = arm.lower, arm.upper
        if arm.description.jaw:
            self._set_jaw(Jaw(self, arm.description.jaw, count + np.arange(len(arm.description.jaw))))
        self.steered = SteeredArm(
            arm,
            self,
            np.arange(count),
            direction=start_direction(scene),
            control_step=scene.timing.control_step,
            jaw=self.jaw,
        )
        self.wrist = WristSensor.of(model)
        self.parked = parked_place(anatomy)
        self._check_reach(anatomy)
        self.place(self.parked)

    @property
    def workspace_limited(self) -> bool:
        """Whether the box, a joint's limit or its speed limit kept the tip from going where it was told."""
        return self.steered.limited

    @property
    def direction(self) -> FloatArray:
        """Where the tip shall point, (3,)."""
        wanted = self.steered.wanted
        return wanted.copy() if wanted.ndim == 1 else wanted @ np.asarray(self.arm.description.tip.direction)

    @property
    def joint_positions(self) -> FloatArray:
        """Values of the driven joints [rad or m], (n,)."""
        return self.steered.joint_positions

    @property
    def trocar_residual(self) -> float:
        """Distance of the shaft's axis from the trocar where the joints are now [m]."""
        return self.steered.trocar_residual

    def place(self, position: FloatArray) -> None:
        """Put the tip at rest at a position [m], pointing as at the start as far as the joints allow.

        A jaw with pads is open, one without is as when loaded.

        Raises:
            ValueError: the tip does not reach there (says by how much, and the port).
        """
        self._rest()
        self.steered.place(position)
        mujoco.mj_forward(self.model, self.data)

    def command_velocity(self, velocity: FloatArray, turning: FloatArray | None = None) -> None:
        """Set the velocity of the tip [m/s] (3,), and how the tip turns [rad/s] (3,).

        Good for one control step; held for longer, the joints go on at the same speeds.
        """
        self.steered.command_velocity(velocity, self.turning_of(turning))

    def command_jaw(self, target: float) -> None:
        """Let the jaw go to a target from -1 (closed) to 1 (open), at its limited speed, and stay there.

        Raises:
            ValueError: no jaw, or a target outside that range.
        """
        self.steered.command_jaw(target)

    def get_state(self) -> FloatArray:
        """All of the instrument's state, command and wanted direction included, as one vector."""
        return np.concatenate([super().get_state(), self.steered.get_state()])

    def set_state(self, state: FloatArray) -> None:
        """Restore what `get_state` gave, to the bit."""
        size = len(self.steered.get_state())
        super().set_state(state[:-size])
        self.steered.set_state(state[-size:])

    def _where(self) -> str:
        return self.steered.where

    def _check_reach(self, anatomy: Anatomy) -> None:
        """The tip comes to the parking place and to places all over the palpable face."""
        face = anatomy.face
        corners = face.points[face.triangles]
        thick = np.flatnonzero(face.thickness >= face.thickness_smallest)
        tried = thick[np.linspace(0, len(thick) - 1, min(PLACES_TRIED, len(thick))).astype(int)]
        radius, retract = anatomy.scene.instrument.tip_radius, anatomy.scene.retract
        places = [self.parked, *(corners[tried].mean(axis=1) - radius * face.approach)]
        # Of a flap it takes the edge alone, before which it is parked.
        for place in places[:1] if retract is not None and retract.flap is not None else places:
            found = self.steered.reach(place)
            if not placed(found):
                raise ValueError(
                    f"{self._where()} does not reach the palpable face of scene {anatomy.scene.name!r} at "
                    f"{millimetres(place)}: {missing(found)}; move its [port]"
                )


def load_scene_arm(anatomy: Anatomy, name: str, port: Port) -> Arm:
    """An arm by its name or its file beside the scene, at a port outside the organ.

    Raises:
        ValueError: a wrong description or model, or a port inside the organ.
    """
    scene = anatomy.scene
    check_port_outside(port, f"scene {scene.name!r}", anatomy.mesh.points, anatomy.mesh.boundary_triangles)
    beside = scene.folder / name
    return load_arm(
        beside if beside.is_file() else name,
        port,
        tip_radius=scene.instrument.tip_radius,
        timestep=scene.timing.haptic_step,
        supports=scene.supports,
    )


def start_direction(scene: Scene) -> FloatArray:
    """Where a scene's tip points at the start, (3,)."""
    return np.asarray(scene.instrument.tip_direction or scene.instrument.approach, dtype=np.float64)


def joint_servo(model: mujoco.MjModel, joints: tuple[str, ...]):
    """A servo at rest that drives joints of a model within their limits, in the order given."""
    pairs = [(position_actuator(model, name), speed_actuator(model, name)) for name in joints]
    position, speed = np.array(pairs, dtype=np.int64).T.copy()
    lower, upper = np.array([model.joint(name).range for name in joints]).T
    return make_servo(lower, upper, position, speed)


def parked_place(anatomy: Anatomy) -> FloatArray:
    """Where a tip waits before the first reset [m], (3,).

    Above the middle of the palpable face; for a flap of an organ where a retraction begins.
    """
    retract = anatomy.scene.retract
    if retract is not None and retract.flap is not None:
        return 0.5 * (np.array(retract.start_lower) + np.array(retract.start_upper))
    corners = anatomy.face.points[anatomy.face.triangles]
    middle = anatomy.face.project(corners.mean(axis=(0, 1)))[0]
    return middle - (anatomy.scene.instrument.tip_radius + PARKED_GAP) * anatomy.face.approach


def is_arm(model: str) -> bool:
    """Whether a scene's instrument is an arm (a TOML file or a shipped arm's name), not an MJCF probe."""
    return Path(model).suffix != ".xml"
