"""The Gymnasium environment: it puts a simulation and a task together and computes no physics and no reward itself."""

import inspect
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.lane_group import LaneGroup
from surgsim_env.envs.saved_state import pack_state, restore_state, state_maker
from surgsim_env.rendering.episode_view import RENDER_MODES, EpisodeView, Shown, Window
from surgsim_env.rendering.looks import Look, LookRanges, draw_look, find_look_ranges, look_generator
from surgsim_env.rendering.options import OPTION_NAMES, require_arguments
from surgsim_env.scene.load import fill, require_known
from surgsim_env.tasks.declaration import ControlStep, documentation
from surgsim_env.tasks.runtime import make_runtime, setting_names
from surgsim_env.tasks.task import Task

if TYPE_CHECKING:
    from surgsim_env.rendering.renderer import OrganRenderer

# Numbers as float32, a picture as uint8, or a table of both.
Observation = Any
Action = NDArray[np.float32]
Info = dict[str, Any]

# How far an action may leave [-1, 1] by rounding.
ACTION_SLACK = 1e-6
# Why no step may be taken: states of an environment without a running episode.
NOT_BEGUN = "no episode has begun, or its reset failed"
OVER = "the episode is over"
BROKEN_OFF = "an exception broke off the last step, so that its organ and its counts may not be of one moment"
# Kinds of observation, and the size of an observed picture [pixels].
OBSERVATION_MODES = ("state", "dict", "rgb", "rgb_force")
PICTURE_SIZE = 84


class SurgicalEnv(gym.Env[Observation, Action]):
    """One organ, one instrument and one task as a Gymnasium environment.

    A subclass says in `task_class` which task; its docstring and its arguments follow from the task's declaration.

    Args:
        scene: name or file of a scene; the task's default by default.
        instrument: name of an arm, or its TOML file; the task's default, else the scene's own, by default.
        obs_mode: "state" observes the task's vector, "dict" its channels by name, "rgb" the endoscope's picture, uint8
            of shape (84, 84, 3), "rgb_force" a dictionary of the "picture" and, as "force", the channels that depend on
            force sensing.
        observe_force: False observes all channels that depend on force sensing as 0.
        looks: "train" or "test" draws a look of all pictures for each episode (`take_looks`), None takes the scene's.
        measure_tissue: True measures the tissue's load in each step also where the scene has no limits of it.
        render_mode: None, "rgb_array" or "human".
        settings: the task's own arguments, and fields of `RenderOptions`.

    Raises:
        ValueError: an obs_mode, looks, a render_mode or a setting that is unknown, looks where no picture is drawn,
            forces of a task without force sensing, or what the task refuses.
    """

    metadata: ClassVar[Info] = {"render_modes": list(RENDER_MODES), "render_fps": 20}
    task_class: ClassVar[type[Task]]
    task: Any

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if "task_class" in vars(cls):
            cls.__doc__ = documentation(cls.task_class)

    def __init__(
        self,
        scene: str | Path | None = None,
        instrument: str | Path | None = None,
        *,
        obs_mode: str = "state",
        scaled: bool = True,
        observe_force: bool = True,
        looks: str | None = None,
        measure_tissue: bool = False,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        require_known("obs_mode", obs_mode, OBSERVATION_MODES)
        kind = self.task_class
        require_arguments(settings, [*ARGUMENT_NAMES, *sorted(setting_names(kind)), *OPTION_NAMES])
        own = {name: settings.pop(name) for name in setting_names(kind) & set(settings)}
        simulation, self.runtime = make_runtime(kind, scene and str(scene), instrument and str(instrument), **own)
        self.runtime.measures_tissue |= measure_tissue
        self.scene, self._mesh = simulation.anatomy.scene, simulation.anatomy.mesh
        self.simulation = simulation
        self._view = EpisodeView(self.simulation, render_mode, settings)
        self.render_mode = render_mode
        # The modes that this machine offers; the class names all that there are.
        self.metadata = self._view.metadata()  # type: ignore[misc]
        self.task, self.layout = self.runtime.task, self.runtime.layout
        self._low, self._high = (side.astype(np.float32) for side in self.layout.bounds(simulation.instrument))
        # An observation is (task observation - origin) / scale.
        origin, scale = self.layout.scales(simulation.instrument)
        self.scaled = scaled
        self._origin, self._scale = (origin, scale) if scaled else (np.zeros_like(origin), np.ones_like(scale))
        self._eye: EpisodeView | None = None
        # Entries of the task's vector that are observed beside a picture; None: the picture alone.
        self._felt: list[int] | None = None
        # Entries of each channel that is observed by its name; None: one vector.
        self._named: dict[str, slice] | None = None
        if obs_mode.startswith("rgb"):
            sight = {"camera": "endoscope", "width": PICTURE_SIZE, "height": PICTURE_SIZE}
            # Policies keep the style of their training.
            sight |= {"show_force": False, "smooth_edges": False, "style": "plain"}
            self._eye = EpisodeView(self.simulation, "rgb_array", sight)
            self.observation_space = gym.spaces.Box(0, 255, (PICTURE_SIZE, PICTURE_SIZE, 3), dtype=np.uint8)
        low, high = self.as_observed(self._low), self.as_observed(self._high)
        if obs_mode == "rgb_force":
            self._felt = self.layout.force_entries
            if not self._felt:
                raise ValueError(
                    f'obs_mode is "rgb_force", and {kind.__name__} has no channel that depends on force sensing: '
                    'mark one as felt, or observe "rgb"'
                )
            force = gym.spaces.Box(low[self._felt], high[self._felt], dtype=np.float32)
            self.observation_space = gym.spaces.Dict({"picture": self.observation_space, "force": force})
        elif obs_mode == "state":
            self.observation_space = gym.spaces.Box(low, high, dtype=np.float32)
        elif obs_mode == "dict":
            self._named = {name: part for name, part in self.observation_slices.items() if part.start < part.stop}
            boxes: dict[str, gym.Space] = {
                name: gym.spaces.Box(low[part], high[part], dtype=np.float32) for name, part in self._named.items()
            }
            self.observation_space = gym.spaces.Dict(boxes)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.layout.action_size,), dtype=np.float32)
        self._observation = np.zeros(self._low.shape, dtype=np.float32)
        self._unobserved = [] if observe_force else self.layout.force_entries
        # The eye's picture of the last observation; None until it is drawn.
        self._picture: NDArray[np.uint8] | None = None
        self._look_ranges: LookRanges | None = None
        self._look_random = np.random.default_rng(0)
        self._look: Look | None = None
        if looks is not None:
            self.take_looks(looks)
        # The action of the last step, after wrappers changed it.
        self.last_action = np.zeros(self.layout.action_size)
        # Why no step may be taken; "" while an episode runs.
        self.halted = NOT_BEGUN

    def take_looks(self, looks: str) -> None:
        """Draw a look of a split for the pictures of each episode from the next reset on.

        Looks have random numbers of their own, which follow from the seed of the reset: nothing else is changed.

        Raises:
            ValueError: an unknown split (lists the known), or no picture is observed or rendered.
        """
        if self._eye is None and self.render_mode is None:
            raise ValueError(
                f'looks is {looks!r}, and no picture is drawn: give obs_mode="rgb" or "rgb_force", or '
                'render_mode="rgb_array"'
            )
        self._look_ranges = find_look_ranges(looks)
        self.halted = NOT_BEGUN

    @property
    def look(self) -> Look | None:
        """The look of this episode's pictures; None for the scene's own."""
        return self._look

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Info]:
        """Draw an episode and put its organ and instrument at rest; no options are known."""
        if options:
            raise ValueError(f"reset option {next(iter(options))!r} is unknown; this environment takes none")
        self.halted = NOT_BEGUN
        super().reset(seed=seed)
        self._draw_look(seed)
        self._draw()
        values, saturated = self.runtime.observe(ControlStep(self.simulation), self.np_random)
        if wrong := self._out_of_bounds(values):
            raise ValueError(
                f"{type(self.task).__name__}, after a reset: {wrong}; a channel's read must stay within its low and "
                "high: widen them, or correct read"
            )
        self._take(values)
        unpaid = {reward.name: 0.0 for reward in self.runtime.rewards}
        info = self._info("", saturated, self.runtime.first_info(), unpaid)
        # Stiff lesions need added mass, which would tell of them.
        info["added_mass"] = 0.0
        self.halted = ""
        self._show()
        return self._observed(), info

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, Info]:
        """One control step: haptic steps until it is over, a force limit is passed or the simulation faults.

        An exception in a step that has begun, Ctrl-C among them, breaks the episode off: `reset` or `load_state`.

        Raises:
            ResetNeeded: no episode is running, or the last step was broken off.
            ValueError: names the entry of the action that is out of bounds.
        """
        self.begin(self.checked(action))
        self.advance([self])
        return self.finish()

    def checked(self, action: Action | FloatArray, lane: int | None = None) -> FloatArray:
        """An action (n_action,) for `begin`; the lane of a vector environment is named in refusals.

        Raises:
            ResetNeeded: no episode is running.
            ValueError: names the entry of the action that is out of bounds.
        """
        place, wrapper = ("", "ClipAction") if lane is None else (f"lane {lane}: ", "vector.ClipAction")
        if self.halted:
            raise gym.error.ResetNeeded(f"{place}{self.halted}: call reset()")
        values = np.asarray(action, dtype=np.float64)
        if values.shape != self.action_space.shape:
            raise ValueError(f"{place}action has shape {values.shape}; the rule is {self.action_space.shape}")
        bad = np.flatnonzero(~(np.abs(values) <= 1.0 + ACTION_SLACK))
        if bad.size:
            raise ValueError(
                f"{place}action[{bad[0]}] is {values[bad[0]]}; every entry must be finite and in [-1, 1]: "
                f"wrap the environment in gymnasium.wrappers.{wrapper}"
            )
        return values

    def begin(self, action: FloatArray) -> None:
        """Command a `checked` action (n_action,): the first part of `step`."""
        self.halted = BROKEN_OFF
        self.last_action = action
        self.runtime.begin(action, self.simulation.instrument)

    def advance(self, group: Sequence[Any], lanes: LaneGroup | None = None) -> None:
        """Advance the simulations of a group by one control step: the second part of `step`, once for the group.

        Args:
            group: environments that have begun the step, this one among them.
            lanes: has their simulations; None for this one alone.
        """
        count = self.scene.timing.haptic_steps_per_control
        limits = (self.runtime.force_limit, self.runtime.pull_limit)
        if lanes is None:
            self.simulation.control_step(count, *limits)
        else:
            lanes.control_step([env.simulation for env in group], count, *limits)

    def finish(self) -> tuple[Observation, float, bool, bool, Info]:
        """Observe and judge the step: the last part of `step`, with its result."""
        fault = self.simulation.fault
        saturated = False
        if not fault:
            self.simulation.end_control_step()
            values, saturated = self.runtime.observe(ControlStep(self.simulation, self.force_peak), self.np_random)
            fault = self.simulation.fault or self._out_of_bounds(values)
            if not fault:
                self._take(values)
        verdict = self.runtime.judge(ControlStep(self.simulation, self.force_peak, fault))
        info = self._info(fault, saturated, verdict.info, verdict.rewards)
        # Not `sum`, which rounds once from Python 3.12 on and at each term before.
        reward = math.fsum(verdict.rewards.values())
        self.halted = OVER if verdict.terminated or verdict.truncated else ""
        self._show()
        return self._observed(), reward, verdict.terminated, verdict.truncated, info

    @property
    def force_peak(self) -> float:
        """Largest contact force of the last step [N]."""
        return self.simulation.force_peak

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """The picture of this moment in mode "rgb_array", shape (height, width, 3); a window shows each step by itself.

        Raises:
            ResetNeeded: before the first reset there is nothing to show.
            NoGLError: there is no OpenGL to draw with; names the packages that are missing.
        """
        if self.render_mode is None:
            gym.logger.warn(
                "render() without a render_mode shows nothing: make the environment with "
                f'gym.make("{self.spec.id if self.spec else "SurgSim/..."}", render_mode="rgb_array")'
            )
            return None
        if self.render_mode == "human":
            self._shown()
            return None
        return self._view.frame(self._shown())

    @property
    def renderer(self) -> "OrganRenderer":
        """Draws the episode in any render_mode: `rgb(camera)`, `depth(camera)` [m], `segmentation(camera)`.

        Raises:
            ResetNeeded: before the first reset there is nothing to show.
        """
        return self._view.renderer(self._shown())

    @property
    def observation_slices(self) -> dict[str, slice]:
        """Entries of each channel in an observation: `observation[observation_slices["contact_force"]]`."""
        return dict(self.layout.observation_slices)

    @property
    def observation(self) -> Observation:
        """The last observation of reset or step."""
        return self._observed()

    @property
    def task_observation(self) -> NDArray[np.float32]:
        """All of the task's own numbers in the last observation, in SI units."""
        return self._observation.copy()

    def si_values(self, observations: NDArray[np.floating]) -> NDArray[np.float64]:
        """Observations (..., n_observation) of this environment in SI units, whether it is `scaled` or not."""
        return np.asarray(observations, dtype=np.float64) * self._scale + self._origin

    def as_observed(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """The task's numbers (..., n_observation) in SI units as this environment observes them, `si_values` undone."""
        return ((values - self._origin) / self._scale).astype(np.float32)

    @property
    def window(self) -> Window | None:
        """The window of render_mode "human", once the first reset has opened it; else None."""
        return self._view.window

    def close(self) -> None:
        """Close the window and release the graphics; may be called repeatedly."""
        self._view.close()
        if self._eye is not None:
            self._eye.close()

    def save_state(self) -> bytes:
        """The whole state as bytes, in numpy's own format without executable parts.

        Wrappers keep counts of their own (TimeLimit): load a state into an environment that was just reset.

        Raises:
            ResetNeeded: no episode has begun, or the last step was broken off.
        """
        if self.halted in (NOT_BEGUN, BROKEN_OFF):
            raise gym.error.ResetNeeded(f"nothing to save: {self.halted}: call reset()")
        return pack_state(self._maker(), self.simulation, self.runtime, self._own_state())

    def load_state(self, state: bytes) -> None:
        """Restore a state from `save_state`, to the bit, in this or another environment of the same scene.

        Everything is read and checked before anything changes: a refused state leaves the environment as it was.

        Raises:
            ValueError: bytes that are no saved state, or one of another scene, mesh or version (names both); names the
                entry that is missing, unknown or of another shape.
        """
        before = self.simulation.organ_state
        try:
            own = restore_state(state, self._maker(), self.simulation, self.runtime, self._own_state())
            self.np_random.bit_generator.state = json.loads(str(own["random"]))
            if self._look_ranges is not None:
                self._look = fill(Look, json.loads(str(own["look"])), "look")
                self._look_random.bit_generator.state = json.loads(str(own["look_random"]))
            self._take(own["observation"])
        except BaseException:
            # A refused state has changed nothing; an interrupt, or a task's own setter, may come later.
            if self.simulation.organ_state is not before:
                self.halted = BROKEN_OFF
            raise
        self.halted = "" if own["running"] else OVER

    def _own_state(self) -> dict[str, np.ndarray]:
        """The environment's part of a saved state, by name."""
        arrays = {
            "random": np.array(json.dumps(self.np_random.bit_generator.state)),
            "observation": self._observation.copy(),
            "running": np.array(not self.halted),
        }
        if self._look_ranges is not None:
            look = None if self._look is None else asdict(self._look)
            arrays["look"] = np.array(json.dumps(look))
            arrays["look_random"] = np.array(json.dumps(self._look_random.bit_generator.state))
        return arrays

    def _maker(self) -> str:
        return state_maker(type(self).__name__, self.scene, self._mesh)

    def _draw_look(self, seed: int | None) -> None:
        """Draw the look of the next episode; a seed begins the random numbers of looks anew."""
        ranges = self._look_ranges
        if ranges is None:
            return
        if self._look is None or seed is not None:
            # Without a seed of the first reset the environment's generator has drawn one.
            assert self.np_random is not None
            self._look_random = look_generator(ranges, self.np_random_seed)
        self._look = draw_look(ranges, self._look_random)

    def _draw(self) -> None:
        """Draw an episode."""
        self.runtime.reset(self.simulation, self.np_random)

    def _take(self, values: NDArray[np.floating]) -> None:
        """Take the task's numbers as the last observation; its picture is of this moment too."""
        self._observation, self._picture = values.astype(np.float32), None

    def _observed(self) -> Observation:
        """The last observation, as obs_mode has it."""
        if self._eye is None:
            numbers = self._observed_numbers()
            return numbers if self._named is None else {name: numbers[part] for name, part in self._named.items()}
        if self._picture is None:
            self._picture = self._eye.frame(self._shown())
        if self._felt is None:
            return self._picture.copy()
        return {"picture": self._picture.copy(), "force": self._observed_numbers()[self._felt]}

    def picture(self, look: Look | None) -> NDArray[np.uint8]:
        """The observed picture of this moment as another look has it, shape (84, 84, 3); nothing is changed by it.

        Raises:
            ResetNeeded: before the first reset there is nothing to show.
            ValueError: obs_mode observes no picture.
        """
        if self._eye is None:
            raise ValueError('obs_mode is "state", which observes no picture: make it with "rgb" or "rgb_force"')
        return self._eye.frame(replace(self._shown(), look=look))

    def _observed_numbers(self) -> NDArray[np.float32]:
        observed = self.as_observed(self._observation)
        observed[self._unobserved] = 0.0
        return observed

    def _shown(self) -> Shown:
        if self.halted == NOT_BEGUN:
            raise gym.error.ResetNeeded(f"nothing to show: {NOT_BEGUN}: call reset()")
        target, endoscope = self.task.pictured.target, self.task.pictured.endoscope
        moved = None if target is None else target.moved(self.simulation.ground_shift(target.centre))
        return Shown(self.task.lesions, moved, endoscope, self._look, self.task.step_count)

    def _show(self) -> None:
        if self.render_mode == "human":
            self._view.show(self._shown())

    def _out_of_bounds(self, values: FloatArray) -> str:
        single = values.astype(np.float32)
        bad = np.flatnonzero(~((single >= self._low) & (single <= self._high)))
        if not bad.size:
            return ""
        index = int(bad[0])
        return (
            f"observation {self.layout.entry_name(index)} = {values[index]:g} left its bounds, {self._low[index]:g} to "
            f"{self._high[index]:g}"
        )

    def _info(self, fault: str, saturated: bool, task_info: Info, rewards: dict[str, float]) -> Info:
        residual = self.simulation.instrument.trocar_residual
        force = self.simulation.instrument.trocar_force
        wall = {} if force is None else {"trocar_force": force}
        member = {} if self.runtime.family is None else {"member": str(self.task.anatomy.member)}
        return {
            "sim_fault": fault,
            "sensor_saturated": saturated,
            "workspace_limited": self.simulation.instrument.workspace_limited,
            "added_mass": self.simulation.organ_model.added_mass,
            "trocar_error_mm": -1.0 if residual is None else residual * 1000.0,
            **wall,
            **member,
            **task_info,
            **{f"reward_{name}": value for name, value in rewards.items()},
        }


# Without self and the settings of tasks and pictures.
ARGUMENT_NAMES = [*inspect.signature(SurgicalEnv.__init__).parameters][1:-1]
