"""Two arms in one model, in contact with the organ, its supports and each other; the left arm grasps."""

import math
from itertools import product

import mujoco
import numpy as np

from msdm_core.arithmetic import matmul, norm
from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from surgsim_env.instruments.arm.arm import Arm
from surgsim_env.instruments.arm.arm_instrument import (
    SteeredArms,
    joint_servo,
    load_scene_arm,
    parked_place,
    start_direction,
)
from surgsim_env.instruments.arm.model import LINK_GROUP, arm_spec, warned
from surgsim_env.instruments.arm.steering import SteeredArm
from surgsim_env.instruments.instrument import Jaw
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP, ROUGHNESS, SOLIMP, SOLREF, SUPPORT_PREFIX, add_supports
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.load import pair_names
from surgsim_env.scene.model import Scene

SIDES = ("left", "right")
# Contact mask bits: geoms of an arm collide with those of the other arm and supports, not with their own arm's.
ARM_BITS = {"left": 4, "right": 8}
# Contact between arms is soft: critically damped, with a time constant of five haptic steps [s].
CONTACT_SOFTNESS = (0.005, 1.0)
# The right arm on a support: 1240 N/m at its ball, 0.08 mm for 0.1 N, more than its motion in a control step. As
# MuJoCo's contact stiffness is proportional to the tool's mass (`SOLREF`), this is 1 / 6.5 of that of others.
TOUCH_SOFTNESS = (SOLREF[0] / 6.5, SOLREF[1] / math.sqrt(6.5))
# Half the distance between the tips before the first reset [m].
PARKED_ASIDE = 0.025
# Largest measured distance between the arms [m].
DISTANCE_MOST = 0.05


class Pair(SteeredArms):
    """Two arms at two ports, each controlled like an `ArmInstrument`.

    The tip and the jaw of the instrument are the left arm's; `place` and `command_velocity` take one row per arm.

    Fields:
        arms: control of the arms, by "left" and "right"
        parked: positions of the tips before the first reset [m]                 (2, 3)
    """

    def __init__(self, anatomy: Anatomy, lower: FloatArray, upper: FloatArray) -> None:
        """Place the scene's arms at its two ports; both tips may move in the box from lower to upper [m].

        Raises:
            ValueError: not two ports, a wrong description or model, a port inside the organ, an organ out of reach.
        """
        scene = anatomy.scene
        names = pair_names(scene.instrument.model)
        assert names is not None
        if len(scene.ports) != 2:
            raise ValueError(
                f"scene {scene.name!r} has {len(scene.ports)} [[ports]]; {scene.instrument.model!r} needs two, the "
                "left arm's first: add them, or take a scene that has them, such as 'lobe'"
            )
        arms = {side: load_scene_arm(anatomy, name, port) for side, name, port in zip(SIDES, names, scene.ports)}
        if any(part.taxels is not None for part in (scene.instrument, *(arm.description for arm in arms.values()))):
            raise ValueError(
                f"scene {scene.name!r}: the pair {scene.instrument.model!r} has taxels, and pairs of arms do not read "
                "them: take one arm alone, or leave [taxels] out of the scene's and the arms' files"
            )
        with warned(f"scene {scene.name!r}"):
            model = _compile(arms, scene)
        super().__init__(model, lower, upper, model.site(f"left_{arms['left'].description.tip.site}").id)
        driven = [f"{side}_{name}" for side, arm in arms.items() for name in arm.joints]
        fingers = {side: [f"{side}_{name}" for name in arm.description.jaw] for side, arm in arms.items()}
        self.servo = joint_servo(model, (*driven, *fingers["left"], *fingers["right"]))
        self.arms: dict[str, SteeredArm] = {}
        for side, arm in arms.items():
            places = np.array([index for index, name in enumerate(driven) if name.startswith(side)])
            jaw = None
            if fingers[side]:
                first = len(driven) + (len(fingers["left"]) if side == "right" else 0)
                jaw = Jaw(self, tuple(fingers[side]), first + np.arange(len(fingers[side])))
            self.arms[side] = SteeredArm(
                arm,
                self,
                places,
                direction=start_direction(scene),
                control_step=scene.timing.control_step,
                joint_errors=scene.instrument.joint_errors,
                jaw=jaw,
                prefix=f"{side}_",
            )
        jaws = [arm.jaw for arm in self.arms.values() if arm.jaw is not None]
        self.jaw = jaws[0] if jaws else None
        self.jaws = np.array([jaw.tools for jaw in jaws], dtype=np.int32).reshape(-1, 2)
        self._geoms_of = {side: _outside(model, side) for side in SIDES}
        aside = np.array(scene.ports[1].point) - np.array(scene.ports[0].point)
        aside *= PARKED_ASIDE / norm(aside)
        middle = parked_place(anatomy)
        self.parked = np.stack([middle - aside, middle + aside])
        self.place(self.parked)

    @property
    def distance(self) -> float:
        """Smallest distance between the arms' outer shapes, at most DISTANCE_MOST [m]; negative under pressure."""
        least, ends = DISTANCE_MOST, np.zeros(6)
        for left in self._geoms_of["left"]:
            for right in self._geoms_of["right"]:
                least = min(least, mujoco.mj_geomDistance(self.model, self.data, left, right, least, ends))
        return least

    @property
    def collision_force(self) -> float:
        """Size of the force between the arms in the last haptic step [N]."""
        return self._contact_force(self._geoms_of["left"], self._geoms_of["right"])

    def place(self, position: FloatArray) -> None:
        """Place the tips at rest at two positions [m], (2, 3), in the start direction; a jaw with pads is open.

        Raises:
            ValueError: a tip does not reach its position (gives the distance and the port).
        """
        self._rest()
        for side, place in zip(SIDES, position, strict=True):
            self.arms[side].place(place)
        mujoco.mj_forward(self.model, self.data)

    def command_velocity(self, velocity: FloatArray, turning: FloatArray | None = None) -> None:
        """Command both tips' velocities [m/s] (2, 3) and angular velocities [rad/s] (2, 3) for one control step."""
        turns = np.zeros((2, 3)) if turning is None else turning
        for side, speed, turn in zip(SIDES, velocity, turns, strict=True):
            self.arms[side].command_velocity(speed, self.turning_of(turn))

    def contact_force(self, side: str, wrench: FloatArray) -> FloatArray:
        """Force of the tissue on an arm [N], (3,), from the wrenches on all tools (n_tool, 6)."""
        return wrench[self.tools_of(side), :3].sum(axis=0)

    def tools_of(self, side: str) -> IntArray:
        """Indices of an arm's tools, (n,)."""
        return np.flatnonzero([name.startswith(f"{side}_") for name in self.tool_names]).astype(np.int32)

    def touch_force(self, side: str, support: str) -> float:
        """Size of the force between an arm and one of the scene's supports in the last haptic step [N]."""
        return self._contact_force(self._geoms_of[side], np.array([self.model.geom(SUPPORT_PREFIX + support).id]))

    def _contact_force(self, geoms: IntArray, others: IntArray) -> float:
        """Size of the sum of MuJoCo's contact forces between two sets of geoms [N]."""
        total, force = np.zeros(3), np.zeros(6)
        for index in range(self.data.ncon):
            contact = self.data.contact[index]
            first, second = contact.geom
            sign = 1.0 if first in geoms and second in others else -1.0 if first in others and second in geoms else 0.0
            if sign:
                mujoco.mj_contactForce(self.model, self.data, index, force)
                total += sign * matmul(contact.frame.reshape(3, 3).T, force[:3])
        return float(norm(total))

    def _where(self) -> str:
        return f"the pair of {self.arms['left'].where} and {self.arms['right'].where}"


def _compile(arms: dict[str, Arm], scene: Scene) -> mujoco.MjModel:
    """Compile both arms and the supports into one model; the names of an arm's parts have its side as a prefix."""
    spec, timestep = mujoco.MjSpec(), scene.timing.haptic_step
    for side, arm in arms.items():
        child = arm_spec(arm.description, arm.port, scene.instrument.tip_radius, timestep)
        spec.option.timestep = timestep
        for name in ("integrator", "jacobian", "gravity", "disableflags"):
            setattr(spec.option, name, getattr(child.option, name))
        for geom in child.geoms:
            if geom.group in (CONTACT_GROUP, LINK_GROUP):
                other = next(bit for name, bit in ARM_BITS.items() if name != side)
                geom.contype, geom.conaffinity = ARM_BITS[side], other
                geom.solref, geom.condim = CONTACT_SOFTNESS, 1
        rough = {number.name: list(number.data) for number in child.numerics if number.name.startswith(ROUGHNESS)}
        spec.attach(child, prefix=f"{side}_", frame=spec.worldbody.add_frame())
        for name, value in rough.items():
            spec.add_numeric(name=f"{ROUGHNESS}{side}_{name.removeprefix(ROUGHNESS)}", data=value, size=1)
    add_supports(spec, scene.supports, moving=bool(scene.motions))
    for name, support in product(arms["right"].description.contact, scene.supports):
        friction = [support.friction, support.friction, 0.005, 1e-4, 1e-4]
        touch = {"solref": TOUCH_SOFTNESS, "solimp": SOLIMP, "friction": friction, "condim": 3}
        spec.add_pair(geomname1=f"right_{name}", geomname2=SUPPORT_PREFIX + support.name, **touch)
    return spec.compile()


def _outside(model: mujoco.MjModel, side: str) -> IntArray:
    """Indices of an arm's outer geoms, (n,)."""
    named = [model.geom(index).name.startswith(f"{side}_") for index in range(model.ngeom)]
    return np.flatnonzero(named & np.isin(model.geom_group, (CONTACT_GROUP, LINK_GROUP))).astype(np.int32)
