"""Execution and recording of scripts in an environment."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium as gym
import numpy as np

from surgsim_env.coupling.simulation import HapticRecord, Simulation
from surgsim_env.envs.surgical_env import Observation, SurgicalEnv
from surgsim_env.instruments.arm.pair import SIDES, Pair
from surgsim_env.scripting.observations import stacked_observations
from surgsim_env.scripting.steps import Action, Control, MayEnd, Script, Step, StepFailed, View
from surgsim_env.scripting.trace import StepInterval, Trace, contact_depth
from surgsim_env.tasks.layout import TaskLayout


class ScriptError(Exception):
    """Failure of a script: the message names the step; `trace` is the run up to there."""

    def __init__(self, message: str, trace: Trace) -> None:
        super().__init__(message)
        self.trace = trace


def run_script(env: gym.Env, script: Script, *, seed: int | None = None) -> Trace:
    """Run the steps of a script in turn and record them, without changing a bit of the episode.

    The episode may end in the last step if that is one with `ends_episode` (Declare, Control, AwaitEnd), and in success
    in a MayEnd step, which ends the script. Any other end of the episode is an error; so are a force limit and a fault
    in any step.

    Args:
        env: one environment of this project, wrapped or not.
        script: steps; those without a name are named by their class: "Hold", "Hold 2" and so on.
        seed: resets the environment first; without it the run continues from the current state.

    Raises:
        ScriptError: a step ran out of time or depth, or the episode ended too soon.
        TypeError: not an environment of this project, a vector environment, or a task without the needed channels.
        ValueError: an empty script, two steps of one name, a speed or an action beyond the environment's limits.
    """
    inner = _inner(env)
    layout = inner.layout
    names = _names(script)
    for step, name in zip(script, names, strict=True):
        if step.speed > layout.speed_limit * (1.0 + 1e-9):
            raise ValueError(
                f"step {name!r}: speed is {step.speed:g} m/s; the largest speed of the tip is "
                f"{layout.speed_limit:g} m/s: use that or less"
            )
    observation = inner.observation if seed is None else env.reset(seed=seed)[0]
    with inner.simulation.recording() as record:
        run = _Run(env, inner, layout, record, observation, inner.simulation.time)
        failure = ""
        for index, (step, name) in enumerate(zip(script, names, strict=True)):
            start = inner.simulation.time
            failure = run.play(step, name, last=index == len(script) - 1)
            run.steps.append(StepInterval(name, start, inner.simulation.time))
            if run.ended:
                break
            if failure:
                failure = f"step {index + 1} of {len(script)}, {name!r}, {failure}"
                break
        trace = run.trace(failure)
    if failure:
        raise ScriptError(failure, trace)
    return trace


@dataclass
class _Run:
    """State of a run, extended in each control step."""

    env: gym.Env
    inner: SurgicalEnv
    layout: TaskLayout
    record: HapticRecord
    observation: Observation
    start: float
    times: list[float] = field(default_factory=list)
    observations: list[Observation] = field(default_factory=list)
    actions: list[Action] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    infos: list[dict[str, Any]] = field(default_factory=list)
    steps: list[StepInterval] = field(default_factory=list)
    terminated: bool = False
    truncated: bool = False
    # True if the episode ended as intended by the script.
    ended: bool = False

    def play(self, step: Step, name: str, *, last: bool) -> str:
        """Run a step of the script; returns "" or the reason of its failure."""
        start, first = self.inner.simulation.time, len(self.record)
        view = self._look(start, first)
        plan = step.actions(view)
        try:
            action = next(plan)
            while True:
                if view.step_time >= step.timeout - 1e-9:
                    return f"ran out of its {step.timeout:g} s: {step}; {view.reached()}"
                self._take(action, name, checked=not isinstance(step, Control))
                view = self._look(start, first)
                if self.terminated or self.truncated:
                    harm = self._harm()
                    allowed = last or (isinstance(step, MayEnd) and bool(self.infos[-1].get("success")))
                    self.ended = step.ends_episode and not harm and allowed
                    cut = "was cut short: the episode is over" + (", its time is up" if self.truncated else "")
                    return "" if self.ended else f"{harm or cut}; {view.reached()}"
                action = plan.send(view)
        except StopIteration:
            return ""
        except StepFailed as reason:
            return f"{reason}: {step}; {view.reached()}"
        finally:
            plan.close()

    def trace(self, failure: str) -> Trace:
        """Trace of the run so far."""
        record, simulation = self.record, self.inner.simulation
        return Trace(
            start=self.start,
            haptic_time=record.time,
            wrench=record.wrench,
            taxels=record.taxels,
            tip_position=record.tip_position,
            tip_orientation=record.tip_orientation,
            depth=contact_depth(record.wrench, record.tip_position, simulation.anatomy.face.approach),
            control_time=np.array(self.times),
            observation=stacked_observations(self.env.observation_space, self.observations),
            action=np.array(self.actions) if self.times else np.zeros((0, self.layout.action_size)),
            reward=np.array(self.rewards),
            infos=tuple(self.infos),
            steps=tuple(self.steps),
            tool_names=tuple(simulation.instrument.tool_names),
            terminated=self.terminated,
            truncated=self.truncated,
            failure=failure,
        )

    def _look(self, start: float, first: int) -> View:
        """Current view, in a step from a time [s] and a number of recorded haptic steps on."""
        simulation, contact = self.inner.simulation, self.record.first_contact(first)
        instrument, force = simulation.instrument, self.layout.observation_slices["contact_force"]
        view = View(
            time=simulation.time,
            step_time=simulation.time - start,
            control_step=simulation.anatomy.scene.timing.control_step,
            observation=copy.deepcopy(self.observation),
            tip_position=instrument.tip_position,
            tip_velocity=instrument.tip_velocity,
            true_force=simulation.contact_force,
            # From the task's observation, before wrappers and pictures.
            sensed_force=self.inner.task_observation[force].astype(np.float64),
            contact_position=None if contact is None else self.record.tip_position_at(contact),
            approach=simulation.anatomy.face.approach.copy(),
            grasp=simulation.grasp,
            layout=self.layout,
        )
        if not isinstance(instrument, Pair):
            return view
        return replace(view, arms={side: _of_arm(view, simulation, instrument, side) for side in SIDES})

    def _take(self, action: Action, name: str, *, checked: bool) -> None:
        values = np.asarray(action, dtype=np.float32)
        observation, reward, terminated, truncated, info = self.env.step(values)
        if checked and not np.array_equal(self.inner.last_action, values):
            raise ValueError(
                f"a wrapper in {self.env} changes the actions of step {name!r}: run the script in the environment "
                "inside it, or give the wrapper's own actions in a Control step"
            )
        self.observation = copy.deepcopy(observation)
        self.terminated, self.truncated = bool(terminated), bool(truncated)
        self.times.append(self.inner.simulation.time)
        self.observations.append(self.observation)
        self.actions.append(values.copy())
        self.rewards.append(float(reward))
        self.infos.append(dict(info))

    def _harm(self) -> str:
        """Fault, tear or force limit at the episode's end; "" for none."""
        info = self.infos[-1]
        if info.get("sim_fault"):
            return f"came to a fault of the simulation ({info['sim_fault']})"
        if info.get("torn"):
            return f"tore the tissue ({info['pull_force_peak']:.3f} N)"
        if info.get("collided"):
            return f"pressed the arms on each other ({info['collision_force']:.3f} N)"
        force = max(info["force_peak"], info.get("touch_force", 0.0))
        return f"passed the hard force limit ({force:.3f} N)" if info.get("hard_limit") else ""


def _of_arm(view: View, simulation: Simulation, pair: Pair, side: str) -> View:
    """View of one arm of a pair; its sensed force is the true one."""
    arm, force = pair.arms[side], pair.contact_force(side, simulation.contact_wrench)
    supports = simulation.anatomy.scene.supports
    return replace(
        view,
        tip_position=arm.tip_position,
        tip_velocity=arm.tip_velocity,
        true_force=force,
        sensed_force=force.copy(),
        grasp=view.grasp if arm.jaw is not None else None,
        support_force=max((pair.touch_force(side, support.name) for support in supports), default=0.0),
        arm=side,
    )


def _inner(env: gym.Env) -> SurgicalEnv:
    """Unwrapped environment, checked for the channels of scripts."""
    if isinstance(env, gym.vector.VectorEnv):
        raise TypeError("a script runs in one environment, not in a vector environment: make one with gym.make")
    inner = env.unwrapped
    if not isinstance(inner, SurgicalEnv):
        raise TypeError(f'{type(inner).__name__} is no environment of this project: use gym.make("SurgSim/Palpate-v0")')
    if "velocity" not in inner.layout.action_slices or "contact_force" not in inner.layout.observation_slices:
        raise TypeError(
            f"{type(inner.task).__name__} cannot be scripted: steps command `velocity` and sense `contact_force`; "
            "declare a command and a channel of these names"
        )
    return inner


def _names(script: Sequence[Step]) -> list[str]:
    """Name of each step: its own, or its class's, from the second on with a number."""
    if not script:
        raise ValueError("the script is empty; give it at least one step, such as Hold(0.1)")
    names: list[str] = []
    for step in script:
        base = step.name or type(step).__name__
        count = sum((other.name or type(other).__name__) == base for other in script[: len(names)])
        if step.name and step.name in names:
            raise ValueError(f"two steps are called {step.name!r}; the trace is cut by names: give each its own")
        names.append(f"{base} {count + 1}" if count else base)
    return names
