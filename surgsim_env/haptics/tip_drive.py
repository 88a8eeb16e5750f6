"""How the force of a coupling comes onto an instrument's tip, through the commands that the instrument has anyway."""

from typing import Protocol

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.arms.arm_instrument import ArmInstrument
from surgsim_env.arms.pair import SIDES, Pair
from surgsim_env.arms.steering import SteeredArm
from surgsim_env.haptics.coupling import TipDynamics
from surgsim_env.instrument import Instrument

# An arm is steered as if its tip were this heavy [kg] and damped by this [N s/m]: as heavy as a probe, and damped by
# more than what 100 N/m of tissue, felt 20 ms late, would feed into it.
STEERED = TipDynamics(mass=0.15, damping=4.0)
# Inverse kinematics of an arm, 0.3 ms each, are solved once in so many haptic steps.
STEER_EVERY = 10
# How fast an arm catches up with the point that it follows [s].
STEER_TIME = 0.02


class TipDrive(Protocol):
    """One tip of an instrument as a coupling sees it.

    Fields:
        dynamics: mass and damping that the coupling meets
        force_largest: what it can be pushed with [N]
        has_jaw: whether it carries a jaw to command
    """

    dynamics: TipDynamics
    force_largest: float
    has_jaw: bool

    @property
    def position(self) -> FloatArray:
        """What the coupling pulls at [m], (3,)."""
        ...

    @property
    def tip(self) -> FloatArray:
        """Where the tip is [m], (3,)."""
        ...

    @property
    def limited(self) -> bool:
        """Whether the edge of its workspace, or a joint's limit, holds it."""
        ...

    def push(self, force: FloatArray, contact_force: FloatArray) -> None:
        """Let a force act on the tip through the next haptic step, beside the tissue's in the last one [N], (3,)."""
        ...

    def command_jaw(self, target: float) -> None:
        """`Instrument.command_jaw`."""
        ...

    def restart(self) -> None:
        """The tip has been put somewhere else."""
        ...


class CartesianDrive:
    """The tip of a probe or grasper on slides: its servo pushes with the coupling's force, to the newton.

    The servo pushes with kp (c + u T - q) + kv (u - v), c - q being how far its target leads, v the slide's speed. So

        u = (F - kp (c - q) + kv v) / (kp T + kv)

    makes it push with F; the lead dies out with kv / kp (12 ms). MuJoCo takes kv implicitly, which makes the tip kv T
    (60 g) heavier than its slides, and the slides' damping too, so that it takes energy at any step.
    """

    def __init__(self, instrument: Instrument) -> None:
        """Drive an instrument whose servo's first three joints are slides along x, y and z.

        Raises:
            TypeError: its first joints are not such slides.
        """
        model, servo = instrument.model, instrument.servo
        self._instrument = instrument
        self.has_jaw = instrument.jaw is not None
        hold, pace = servo.position[:3], servo.speed[:3]
        joints = model.actuator_trnid[hold, 0]
        slides = model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE
        if len(hold) < 3 or not slides.all() or not np.allclose(model.jnt_axis[joints], np.eye(3)):
            raise TypeError(f"{type(instrument).__name__} has no slides along x, y and z to push its tip with")
        self._hold, self._place, self._speed = hold, model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._stiffness, self._damping = model.actuator_gainprm[hold, 0], model.actuator_gainprm[pace, 0]
        self._gain = 1.0 / (self._stiffness * model.opt.timestep + self._damping)
        ranges = np.where(model.actuator_forcelimited[hold], model.actuator_forcerange[hold, 1], np.inf)
        self.force_largest = float(ranges.min())
        mujoco.mj_forward(model, instrument.data)
        inertia = instrument.damped_inertia(0.0).copy()
        inertia[self._speed, self._speed] += self._damping * model.opt.timestep
        yields = np.linalg.inv(inertia)[np.ix_(self._speed, self._speed)]
        mass = 1.0 / float(np.linalg.eigvalsh(yields)[-1])
        self.dynamics = TipDynamics(mass, float(model.dof_damping[self._speed].min()))

    @property
    def position(self) -> FloatArray:
        """The tip [m]: poses are up to date after `Instrument.refresh`."""
        return self._instrument.tip_position

    @property
    def tip(self) -> FloatArray:
        """The tip [m]."""
        return self._instrument.tip_position

    @property
    def limited(self) -> bool:
        """Whether the tip's box holds it."""
        return self._instrument.workspace_limited

    def push(self, force: FloatArray, contact_force: FloatArray) -> None:
        """Command the speed with which the servo pushes with a force [N], (3,); tissue pushes back by itself."""
        data = self._instrument.data
        lead = data.ctrl[self._hold] - data.qpos[self._place]
        speed = data.qvel[self._speed]
        self._instrument.command_velocity((force - self._stiffness * lead + self._damping * speed) * self._gain)

    def command_jaw(self, target: float) -> None:
        """`Instrument.command_jaw`."""
        self._instrument.command_jaw(target)

    def restart(self) -> None:
        """Nothing is remembered."""


class SteeredDrive:
    """The tip of an arm: it follows a point that coupling and tissue push as they would push a tip of 150 g.

    m dv/dt = F + F_tissue - b v at haptic rate; the arm's inverse kinematics follow at a tenth of it. That lag is not
    in `stiffness_limit`: what it promises is for tips on slides.
    """

    dynamics = STEERED
    force_largest = np.inf

    def __init__(self, steered: SteeredArm, haptic_step: float, turn: int = 0) -> None:
        """Steer an arm in steps of `haptic_step` [s]; two arms take turns, 0 and 1."""
        self._steered = steered
        self.has_jaw = steered.jaw is not None
        self._haptic_step = haptic_step
        self._first = (turn * STEER_EVERY // 2) % STEER_EVERY
        self._step = 0
        self._place = steered.tip_position
        self._velocity = np.zeros(3)

    @property
    def position(self) -> FloatArray:
        """The point that the arm follows [m]."""
        return self._place

    @property
    def tip(self) -> FloatArray:
        """The arm's tip [m]."""
        return self._steered.tip_position

    @property
    def limited(self) -> bool:
        """Whether the box, a joint's limit or its speed limit holds the tip."""
        return self._steered.limited

    def push(self, force: FloatArray, contact_force: FloatArray) -> None:
        """Move the point by one haptic step under two forces [N], (3,), and steer the arm when it is its turn."""
        dt, steered = self._haptic_step, self._steered
        push = force + contact_force + self.dynamics.mass / dt * self._velocity
        self._velocity = push / (self.dynamics.mass / dt + self.dynamics.damping)
        wanted = self._place + dt * self._velocity
        self._place = np.clip(wanted, steered.lower, steered.upper)
        self._velocity = np.where(self._place == wanted, self._velocity, 0.0)
        if self._step % STEER_EVERY == self._first:
            behind = (self._place - steered.tip_position) / STEER_TIME
            steered.command_velocity(self._velocity + behind, np.zeros(3))
        self._step += 1

    def command_jaw(self, target: float) -> None:
        """`Instrument.command_jaw`."""
        self._steered.command_jaw(target)

    def restart(self) -> None:
        """Follow from where the tip is now, at rest."""
        self._place, self._velocity, self._step = self._steered.tip_position, np.zeros(3), 0


def tip_drives(instrument: Instrument, haptic_step: float) -> list[TipDrive]:
    """One drive for each tip of an instrument, the left arm's first."""
    if isinstance(instrument, Pair):
        return [SteeredDrive(instrument.arms[side], haptic_step, turn) for turn, side in enumerate(SIDES)]
    if isinstance(instrument, ArmInstrument):
        return [SteeredDrive(instrument.steered, haptic_step)]
    return [CartesianDrive(instrument)]
