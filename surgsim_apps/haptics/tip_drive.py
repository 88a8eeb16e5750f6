"""Application of a coupling's force to an instrument's tip, through the instrument's velocity commands."""

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_apps.haptics.coupling import TipDynamics
from surgsim_env.instruments import SIDES, ArmInstrument, Instrument, Pair, SteeredArm

# Mass [kg] and damping [N s/m] of the point before an arm: as heavy as a probe, and damped by more than the energy fed
# in by tissue of 100 N/m with a lag of 20 ms.
STEERED = TipDynamics(mass=0.15, damping=4.0)
# Haptic steps per solution of an arm's inverse kinematics, which takes 0.3 ms.
STEER_EVERY = 10
# Time constant of an arm after the point [s].
STEER_TIME = 0.02


class CartesianDrive:
    """The tip of a probe or grasper on slides: its servo exerts exactly the coupling's force.

    The servo exerts kp (c + u T - q) + kv (u - v) with target c, position q, speed v and commanded speed u, so that

        u = (F - kp (c - q) + kv v) / (kp T + kv)

    makes it exert F; the lead c - q decays with kv / kp (12 ms). MuJoCo integrates kv implicitly, which makes the tip
    kv T (60 g) heavier than its slides, and the slides' damping too, so that it dissipates at any step.

    Fields:
        tool: the instrument
        dynamics: mass and damping at the coupling
        force_largest: its largest force [N]
    """

    def __init__(self, instrument: Instrument) -> None:
        """Drive an instrument with slides along x, y and z as the servo's first three joints."""
        model, servo = instrument.model, instrument.servo
        self.tool = instrument
        hold, pace = servo.position[:3], servo.speed[:3]
        joints = model.actuator_trnid[hold, 0]
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
        """The tip, the coupling's end [m], (3,); up to date after `Instrument.refresh`."""
        return self.tool.tip_position

    @property
    def limited(self) -> bool:
        """True if the tip's box stops it."""
        return self.tool.workspace_limited

    def push(self, force: FloatArray, contact_force: FloatArray) -> None:
        """Command the speed for a servo force [N], (3,); the simulation adds the tissue's."""
        data = self.tool.data
        lead = data.ctrl[self._hold] - data.qpos[self._place]
        speed = data.qvel[self._speed]
        self.tool.command_velocity((force - self._stiffness * lead + self._damping * speed) * self._gain)

    def restart(self) -> None:
        """There is no state to restart."""


class SteeredDrive:
    """The tip of an arm: it follows a point of 150 g under the forces of coupling and tissue.

    m dv/dt = F + F_tissue - b v at haptic rate; the arm's inverse kinematics follow at a tenth of it. `stiffness_limit`
    does not include that lag: its guarantee is for tips on slides.

    Fields:
        tool: the arm
        dynamics, force_largest: as in `CartesianDrive`
    """

    dynamics = STEERED
    force_largest = np.inf

    def __init__(self, steered: SteeredArm, haptic_step: float, turn: int = 0) -> None:
        """Steer an arm in steps of `haptic_step` [s]; two arms take turns, 0 and 1."""
        self.tool, self._haptic_step = steered, haptic_step
        self._first = (turn * STEER_EVERY // 2) % STEER_EVERY
        self.restart()

    @property
    def position(self) -> FloatArray:
        """The point before the arm, the coupling's end [m], (3,)."""
        return self._place

    @property
    def limited(self) -> bool:
        """True if the box, a joint limit or a speed limit stops the tip."""
        return self.tool.limited

    def push(self, force: FloatArray, contact_force: FloatArray) -> None:
        """Move the point by one haptic step under two forces [N], (3,), and steer the arm in its turn."""
        dt, steered = self._haptic_step, self.tool
        push = force + contact_force + self.dynamics.mass / dt * self._velocity
        self._velocity = push / (self.dynamics.mass / dt + self.dynamics.damping)
        wanted = self._place + dt * self._velocity
        self._place = np.clip(wanted, steered.lower, steered.upper)
        self._velocity = np.where(self._place == wanted, self._velocity, 0.0)
        if self._step % STEER_EVERY == self._first:
            behind = (self._place - steered.tip_position) / STEER_TIME
            steered.command_velocity(self._velocity + behind, np.zeros(3))
        self._step += 1

    def restart(self) -> None:
        """Restart at rest at the tip's present position."""
        self._place, self._velocity, self._step = self.tool.tip_position, np.zeros(3), 0


TipDrive = CartesianDrive | SteeredDrive


def tip_drives(instrument: Instrument, haptic_step: float) -> list[TipDrive]:
    """One drive for each tip of an instrument, the left arm's first."""
    if isinstance(instrument, Pair):
        return [SteeredDrive(instrument.arms[side], haptic_step, turn) for turn, side in enumerate(SIDES)]
    if isinstance(instrument, ArmInstrument):
        return [SteeredDrive(instrument.steered, haptic_step)]
    return [CartesianDrive(instrument)]
