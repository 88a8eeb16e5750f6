"""Gymnasium environments: a simulation and a task put together; no physics and no reward is computed here."""

import io
import json
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from msdm_core.regions import Lesion
from surgsim_env.anatomy import load_anatomy
from surgsim_env.rendering.episode_view import RENDER_MODES, EpisodeView
from surgsim_env.rendering.renderer import OrganRenderer
from surgsim_env.scenes import make_scene, with_instrument
from surgsim_env.simulation import Simulation
from surgsim_env.tasks.palpate import EPISODE_STEPS, PalpateTask

Observation = NDArray[np.float32]
Info = dict[str, Any]

# How far an action may leave [-1, 1] by rounding.
ACTION_SLACK = 1e-6


class PalpateEnv(gym.Env[Observation, Observation]):
    """Find a hidden lesion by touch.

    ## Description
    A robot's ball tip presses a soft organ (a tetrahedral mass-spring-damper model, Sala et al. 2011) with one stiff
    lesion hidden under its surface. Tissue and tip exchange forces 1000 times a second; the agent acts 20 times a
    second. It wins by pressing on the lesion and declaring it.

    ## Action Space
    `Box(-1, 1, (4,), float32)`

    | num | meaning | full scale |
    |---|---|---|
    | 0-2 | tip velocity along x, y, z | 20 mm/s |
    | 3 | declare: above 0.8 for 3 successive control steps, in contact, says "the lesion is here" | |

    ## Observation Space
    `Box((10,), float32)`, all bounds finite

    | num | meaning | bounds |
    |---|---|---|
    | 0-2 | tip position [m] | the organ's bounding box with a margin |
    | 3-5 | tip velocity [m/s] | +-0.5 |
    | 6-8 | contact force on the tip [N], mean of the last haptic step, through the sensor model | +-range |
    | 9 | share of the time left | 0 to 1 |

    ## Rewards
    Named terms, weighted in `surgsim_env.rewards.PALPATE_WEIGHTS`; `info["reward_<term>"]` shows each. Ending without
    finding (a wrong declare, the hard limit, a fault) also pays the dearest step for every step left, so that it never
    pays more than searching on.

    ## Starting State
    Radius, cover and modulus ratio of the lesion, its place on the palpable face, the sensor's bias and the tip's place
    2 to 6 mm above the surface are drawn anew; their ranges are in the scene file. The organ is at rest.

    ## Episode End
    Terminated: the lesion was declared (success within 10 mm of its centre, measured along the surface); the contact
    force passed the hard limit in any haptic step; the simulation came to a fault (`info["sim_fault"]` says which, the
    observation is the last finite one). Truncated: 600 control steps (30 s).

    ## Info
    Fixed keys and types: `sim_fault` (str, "" if none), `sensor_saturated`, `workspace_limited` (the box, or an arm's
    joint and speed limits), `hard_limit`, `declared`, `success` (bool), `force_peak` [N], `error_mm` (-1 if nothing was
    declared), `trocar_error_mm` (distance of the shaft's axis from the trocar; -1 for the probe, which passes through
    none), `added_mass` [kg] (of the scene's mass scaling, 0 without), one `reward_<term>` each.

    ## Arguments
    * `scene`: a scene's name (`surgsim_env.list_scenes()`) or the path of a scene file; default "phantom".
    * `instrument`: "probe", the name of an arm (`surgsim_env.list_arms()`, such as "psm_palpator") or the path of an
      arm's TOML file (docs/arms.md); by default the scene's own. An arm enters the body at the scene's `[port]`, and
      its tip points along the scene's approach as far as its joints allow.
    * `render_mode`: None, "rgb_array" (off screen, no display needed) or "human" (a window).
    * `camera`, `width`, `height`, `show_force`, `show_lesion`, `cut_away` and the other fields of
      `surgsim_env.rendering.options.RenderOptions`: what pictures show. `env.unwrapped.renderer` also draws depth and
      the label of each pixel.

    `env.unwrapped.save_state()` and `load_state()` cover organ, robot, task, counters and random generator; wrappers'
    own counts (TimeLimit) they cannot reach: load a state into an environment that was just reset.

    ## Version History
    * v0: first version.
    """

    metadata: ClassVar[Info] = {"render_modes": list(RENDER_MODES), "render_fps": 20}

    def __init__(
        self, scene: str = "phantom", instrument: str | None = None, render_mode: str | None = None, **pictures: Any
    ) -> None:
        self.scene = with_instrument(make_scene(scene), instrument)
        anatomy = load_anatomy(self.scene)
        self.simulation = Simulation(anatomy)
        self._view = EpisodeView(self.simulation, render_mode, pictures)
        self.render_mode = render_mode
        # The modes that this machine offers; the class names all that there are.
        self.metadata = self._view.metadata()  # type: ignore[misc]
        self.task = PalpateTask(anatomy)
        low, high = self.task.bounds(self.simulation.instrument.lower, self.simulation.instrument.upper)
        self.observation_space = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.task.action_size,), dtype=np.float32)
        self._observation = np.zeros(self.observation_space.shape, dtype=np.float32)
        # What the last step was told, after what wrappers made of it.
        self.last_action = np.zeros(self.task.action_size)
        self._running = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Info]:
        """Hide a new lesion and lift the tip off the organ; no options are known."""
        super().reset(seed=seed)
        if options:
            raise ValueError(f"reset option {next(iter(options))!r} is unknown; this environment takes none")
        start = self.task.reset(self.np_random)
        organ = self.simulation.anatomy.organ(start.lesions)
        self.simulation.reset(organ, start.tip_position)
        values, saturated = self.task.observe(self.simulation, self.np_random)
        self._observation = values.astype(np.float32)
        self._running = True
        info = self._info("", saturated, self.task.blank_info(), self.task.blank_rewards())
        self._show()
        return self._observation.copy(), info

    def command(self, action: Observation) -> None:
        """Check an action and set the tip velocity that it asks for; the first part of `step`, which repeats it.

        Raises:
            ResetNeeded: no episode is running.
            ValueError: names the entry of the action that is out of bounds.
        """
        if not self._running:
            raise gym.error.ResetNeeded("the episode is over or has not begun: call reset()")
        values = self._checked(action)
        if not self.simulation.taken_over:
            self.simulation.instrument.command_velocity(self.task.velocity(values))

    def step(self, action: Observation) -> tuple[Observation, float, bool, bool, Info]:
        """One control step: haptic steps until it is over, the hard limit is passed or the simulation faults."""
        self.command(action)
        self.last_action = self._checked(action)
        self.task.begin(self.last_action)
        count = self.scene.timing.haptic_steps_per_control
        force_peak = self.simulation.control_step(count, self.task.force_limit)
        fault = self.simulation.fault
        saturated = False
        if not fault:
            self.simulation.end_control_step()
            values, saturated = self.task.observe(self.simulation, self.np_random)
            fault = self.simulation.fault or self._out_of_bounds(values)
            if not fault:
                self._observation = values.astype(np.float32)
        verdict = self.task.judge(self.simulation, force_peak, fault)
        self._running = not (verdict.terminated or verdict.truncated)
        info = self._info(fault, saturated, verdict.info, verdict.rewards)
        self._show()
        return self._observation.copy(), sum(verdict.rewards.values()), verdict.terminated, verdict.truncated, info

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """The picture of this moment in mode "rgb_array", shape (height, width, 3); a window shows each step by itself.

        Raises:
            ResetNeeded: before the first reset there is nothing to show.
            NoGLError: there is no OpenGL to draw with; names the packages that are missing.
        """
        if self.render_mode is None:
            gym.logger.warn(
                "render() without a render_mode shows nothing: make the environment with "
                f'gym.make("{self.spec.id if self.spec else "SurgSim/Palpate-v0"}", render_mode="rgb_array")'
            )
            return None
        if self.render_mode == "human":
            self._lesions()
            return None
        return self._view.frame(self._lesions())

    @property
    def renderer(self) -> OrganRenderer:
        """Draws the episode in any render_mode: `rgb(camera)`, `depth(camera)` [m], `segmentation(camera)`.

        Raises:
            ResetNeeded: before the first reset there is nothing to show.
        """
        return self._view.renderer(self._lesions())

    @property
    def observation(self) -> Observation:
        """The last observation that reset or step gave."""
        return self._observation.copy()

    def close(self) -> None:
        """Close the window and give back the graphics; more than once is no harm."""
        self._view.close()

    def save_state(self) -> bytes:
        """Everything that decides what comes next, as bytes; numpy's own format, nothing in it is executed.

        Wrappers keep counts of their own (TimeLimit): load a state into an environment that was just reset.

        Raises:
            ResetNeeded: before the first reset there is nothing to save.
        """
        if self.task.lesion is None:
            raise gym.error.ResetNeeded("nothing to save before the first reset: call reset()")
        arrays = self.simulation.get_state()
        arrays["made_by"] = np.array(self._fingerprint())
        arrays["task"] = np.array(self.task.get_state())
        arrays["random"] = np.array(json.dumps(self.np_random.bit_generator.state))
        arrays["observation"] = self._observation.copy()
        arrays["running"] = np.array(self._running)
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        return buffer.getvalue()

    def load_state(self, state: bytes) -> None:
        """Go on from what `save_state` gave, to the bit, in this or another environment of the same scene.

        Raises:
            ValueError: bytes that are no saved state, or one of another scene or mesh (names both).
        """
        try:
            with np.load(io.BytesIO(state), allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            made_by = str(arrays["made_by"])
        except (ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"not a saved state of this kind of environment: {error}") from None
        if made_by != self._fingerprint():
            raise ValueError(f"the state was saved by {made_by}, this is {self._fingerprint()}: use the same scene")
        self._check_entries(arrays)
        lesions = self.task.set_state(str(arrays["task"]))
        self.simulation.set_state(self.simulation.anatomy.organ(lesions), arrays)
        self.np_random.bit_generator.state = json.loads(str(arrays["random"]))
        self._observation = arrays["observation"]
        self._running = bool(arrays["running"])

    def _lesions(self) -> tuple[Lesion, ...]:
        if self.task.lesion is None:
            raise gym.error.ResetNeeded("nothing to show before the first reset: call reset()")
        return (self.task.lesion,)

    def _show(self) -> None:
        if self.render_mode == "human":
            self._view.show(self._lesions())

    def _check_entries(self, arrays: dict[str, np.ndarray]) -> None:
        """Refuse an archive that lacks an entry or has one of another shape, before anything is changed."""
        wanted = {name: array.shape for name, array in self.simulation.get_state().items()}
        wanted |= {"task": (), "random": (), "running": (), "observation": self._observation.shape}
        for name, shape in wanted.items():
            if name not in arrays or arrays[name].shape != shape:
                found = arrays[name].shape if name in arrays else "nothing"
                raise ValueError(f"not a saved state of this environment: {name} has shape {shape}, found {found}")

    def _fingerprint(self) -> str:
        """What a saved state must agree with: the environment, its scene and mesh, the rates."""
        mesh, timing = self.simulation.anatomy.mesh, self.scene.timing
        digest = zlib.crc32(mesh.tets.tobytes(), zlib.crc32(mesh.points.tobytes()))
        digest = zlib.crc32(repr(replace(self.scene, folder=Path())).encode(), digest)
        return (
            f"{type(self).__name__} of scene {self.scene.name!r} ({mesh.node_count} nodes, {mesh.tet_count} tets, "
            f"{timing.substep_count} substeps in {timing.haptic_step:g} s, digest {digest:08x})"
        )

    def _checked(self, action: Observation) -> FloatArray:
        values = np.asarray(action, dtype=np.float64)
        if values.shape != self.action_space.shape:
            raise ValueError(f"action has shape {values.shape}; the rule is {self.action_space.shape}")
        bad = np.flatnonzero(~(np.abs(values) <= 1.0 + ACTION_SLACK))
        if bad.size:
            raise ValueError(
                f"action[{bad[0]}] is {values[bad[0]]}; every entry must be finite and in [-1, 1]: "
                "wrap the environment in gymnasium.wrappers.ClipAction"
            )
        return values

    def _out_of_bounds(self, values: FloatArray) -> str:
        low, high = self.observation_space.low, self.observation_space.high  # type: ignore[attr-defined]
        bad = np.flatnonzero(~((values.astype(np.float32) >= low) & (values.astype(np.float32) <= high)))
        return f"observation[{bad[0]}] = {values[bad[0]]:g} left its bounds" if bad.size else ""

    def _info(self, fault: str, saturated: bool, task_info: Info, rewards: dict[str, float]) -> Info:
        residual = self.simulation.instrument.trocar_residual
        return {
            "sim_fault": fault,
            "sensor_saturated": saturated,
            "workspace_limited": self.simulation.instrument.workspace_limited,
            "added_mass": self.simulation.organ_model.added_mass,
            "trocar_error_mm": -1.0 if residual is None else residual * 1000.0,
            **task_info,
            **{f"reward_{name}": value for name, value in rewards.items()},
        }


def register() -> None:
    """Register the environment ids with Gymnasium; importing `surgsim_env` does it."""
    if "SurgSim/Palpate-v0" not in gym.registry:
        gym.register(
            id="SurgSim/Palpate-v0",
            entry_point="surgsim_env.env:PalpateEnv",
            vector_entry_point="surgsim_env.vector_env:PalpateVectorEnv",
            max_episode_steps=EPISODE_STEPS,
        )
