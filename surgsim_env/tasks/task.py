"""The base of all tasks: an episode's draw, commands, observation, judgement and saved state, from what is declared."""

import inspect
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.material.regions import Lesion
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.measure import TissueLoad
from surgsim_env.coupling.sensors import ForceReading
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.instrument import Instrument
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.family import OrganFamily, family_of
from surgsim_env.scene.levels import DrawnOrgan, Level, find_level
from surgsim_env.scene.load import make_scene, with_instrument
from surgsim_env.scene.model import Endoscope, ForceSensor
from surgsim_env.scene.motions import with_motion
from surgsim_env.tasks.declaration import Channel, Command, ControlStep, Reward
from surgsim_env.tasks.visibility import Disc

InfoValue = bool | float | str

# Full scale of a velocity command [m/s].
SPEED_FULL_SCALE = 0.02
# Length that is observed as 1 [m], near the radius of a tip.
LENGTH_SCALE = 0.01
# Bounds of the tip beyond its workspace [m] and on its speed [m/s].
POSITION_SLACK = 0.005
SPEED_BOUND = 0.5
# Name of the end where tissue bears more than the limits of pressure or strain.
DAMAGE = "damage"


@dataclass(frozen=True, eq=False)
class Start:
    """What an episode begins with: its organ, and the position of the tip [m] (3,), of two arms (2, 3)."""

    organ: OrganModel
    tip_position: FloatArray


@dataclass(frozen=True)
class Verdict:
    """The judgement of a control step: the episode's end, the weighted reward terms, the task's entries of `info`."""

    terminated: bool
    truncated: bool
    rewards: dict[str, float]
    info: dict[str, InfoValue]


class Task:
    """One episode after another on one anatomy; it reads the simulation and never advances it.

    A subclass declares `channels` and `rewards` (and `commands`, where the tip's velocity is not all), and draws an
    episode in `draw`. Bounds, named slices, observations, weighted rewards, documentation and the environment's
    arguments follow from the declaration; arguments of its own are keyword-only parameters of `__init__`.

    For each control step an environment calls `command`, `begin` and, when the simulation has advanced, `observe` and
    `judge`.

    Class attributes:
        commands, channels, rewards: the declaration
        default_scene, default_instrument: names of what an environment has by default; None: the scene's instrument
        episode_steps: control steps until an episode is truncated; None where the task ends it by itself
        kept: names of the attributes that a saved state holds beside what this class counts and draws
        draw_class: of what an episode draws; has `to_json`, `from_json` and `compiled` as `DrawnOrgan` has
        lanes: whether episodes can run side by side in one vector environment
        weights: of the reward terms, by name

    Attributes:
        anatomy, limits: of the scene; of a family the member that the episode plays
        family: the members that episodes are drawn from; None for a scene of one organ
        sensors: the sensor model of each channel that has one, by the channel's name
        sensed: what these sensors read last [N, N m]
        drawn: the organ of the episode; None before the first
        step_count: control steps of the episode so far
        pull_limit: pull of a jaw that ends an episode [N]; infinite where nothing tears
        target: a disc that pictures show; None for none
        endoscope: pose of the endoscope in this episode; None: the scene's
    """

    commands: ClassVar[tuple[Command, ...]] = (
        Command("velocity", 3, SPEED_FULL_SCALE, "m/s", "tip velocity along x, y, z"),
    )
    channels: ClassVar[tuple[Channel, ...]] = ()
    rewards: ClassVar[tuple[Reward, ...]] = ()
    default_scene: ClassVar[str] = "phantom"
    episode_steps: ClassVar[int | None] = 600
    kept: ClassVar[tuple[str, ...]] = ()
    lanes: ClassVar[bool] = True
    default_instrument: ClassVar[str | None] = None
    weights: ClassVar[Mapping[str, float]] = {}
    draw_class: ClassVar[type[Any]] = DrawnOrgan
    # Of that class.
    drawn: Any

    def __init_subclass__(cls, **arguments: Any) -> None:
        """Take the weights of a declaration.

        Raises:
            ValueError: two commands, channels or rewards of one name.
        """
        super().__init_subclass__(**arguments)
        for part in ("commands", "channels", "rewards"):
            names = [entry.name for entry in getattr(cls, part)]
            if len(set(names)) < len(names):
                raise ValueError(f"{cls.__name__}.{part} are {', '.join(names)}; give each its own name")
        cls.weights = {reward.name: reward.weight for reward in cls.rewards}

    def __init__(self, anatomy: Anatomy, instrument: Instrument | None = None) -> None:
        """Take an anatomy and the instrument that acts on it."""
        self.anatomy = anatomy
        self.family: OrganFamily | None = None
        self.limits = anatomy.scene.limits
        self.sensors = {
            channel.name: ForceReading(_scaled(anatomy.scene.sensor, channel.sensor))
            for channel in self.channels
            if channel.sensor
        }
        self.sensed = {name: np.zeros(3) for name in self.sensors}
        self.level: Level | None = None
        self.drawn = None
        self.step_count = 0
        # Values of the terms that pay for their change.
        self._reached: dict[str, float] = {}

    # ---- the environment's arguments ---------------------------------------------------------------------------

    @classmethod
    def make(
        cls,
        scene: str,
        instrument: str | None = None,
        *,
        motion: str | None = None,
        level: str | None = None,
        split: str | None = None,
        **settings: Any,
    ) -> tuple[Simulation, Self]:
        """The simulation and the task of an environment.

        Args:
            scene: name or file of a scene.
            instrument: name of an arm, or its TOML file; the scene's own by default.
            motion: "none", "calm" or "free": how the patient breathes (`surgsim_env.scene.motions`); as the scene says
                by default.
            level: "easy", "standard", "hard" or "clinical": what the organ hides (`surgsim_env.scene.levels`).
            split: "train" (default), "validation" or "test": the members of a scene's family that episodes are played
                with (`surgsim_env.scene.family`); for scenes of one organ it is left out.
            settings: the keyword-only parameters of `__init__`.
        """
        chosen = None if level is None else find_level(level)
        described = with_motion(with_instrument(make_scene(scene), instrument), motion or (chosen and chosen.motion))
        anatomy = load_anatomy(described if chosen is None else chosen.scene(described))
        family = family_of(anatomy, split)
        simulation = Simulation(anatomy)
        task = cls(anatomy, simulation.instrument, **settings)
        task.level, task.family = chosen, family
        return simulation, task

    @classmethod
    def setting_names(cls) -> set[str]:
        """Names of the arguments that `make` takes beside scene and instrument."""
        parameters = [*inspect.signature(cls.make).parameters.values()]
        if any(one.kind is one.VAR_KEYWORD for one in parameters):
            parameters += inspect.signature(cls.__init__).parameters.values()
        return {one.name for one in parameters if one.kind is one.KEYWORD_ONLY}

    # ---- actions -----------------------------------------------------------------------------------------------

    @cached_property
    def action_slices(self) -> dict[str, slice]:
        """The entries of an action that each command has, by its name."""
        return _slices((one.name, _size(one, self)) for one in self.commands)

    @property
    def action_size(self) -> int:
        """Entries of an action, each in [-1, 1]."""
        return max(part.stop for part in self.action_slices.values())

    @property
    def speed_limit(self) -> float:
        """The largest tip velocity that an action can command along an axis [m/s]."""
        return self._scale("velocity")

    def action(self, velocity: FloatArray | None = None, **commands: Any) -> FloatArray:
        """The action of some commands in SI units, shape (action_size,); those left out, or None, are 0.

        Raises:
            TypeError: a command that the task does not have (lists those that it has).
        """
        values = np.zeros(self.action_size)
        for name, value in {"velocity": velocity, **commands}.items():
            if value is None:
                continue
            if name not in self.action_slices:
                raise TypeError(
                    f"{type(self).__name__} has no command {name!r}; its commands are {', '.join(self.action_slices)}"
                )
            values[self.action_slices[name]] = np.asarray(value, dtype=np.float64) / self._scale(name)
        return values

    def commanded(self, action: FloatArray, name: str) -> FloatArray:
        """The value in SI units that an action gives a command, shape (size,)."""
        return np.asarray(action[self.action_slices[name]], dtype=np.float64) * self._scale(name)

    def _scale(self, name: str) -> float:
        return next(one.scale for one in self.commands if one.name == name)

    def command(self, action: FloatArray, instrument: Instrument) -> None:
        """Give the instrument the commands of an action (action_size,): the tip's velocity."""
        instrument.command_velocity(self.commanded(action, "velocity"))

    def begin(self, action: FloatArray) -> None:
        """Begin a control step: count it; a subclass keeps what the action says beside the instrument's commands."""
        self.step_count += 1

    # ---- observations ------------------------------------------------------------------------------------------

    @cached_property
    def _observed(self) -> tuple[tuple[Channel, int], ...]:
        """The channels that this task observes, with their sizes."""
        sized = ((channel, _size(channel, self)) for channel in self.channels)
        return tuple((channel, size) for channel, size in sized if size)

    @cached_property
    def observation_slices(self) -> dict[str, slice]:
        """The entries of an observation that each channel has, by its name."""
        return _slices((channel.name, size) for channel, size in self._observed)

    @property
    def declared(self) -> dict[str, tuple[int, str]]:
        """Size and scale, as the documentation shows it, of each channel that is observed, by its name."""
        return {channel.name: (size, channel.scale_shown) for channel, size in self._observed}

    @classmethod
    def channel_slices(cls, **sizes: int) -> dict[str, slice]:
        """`observation_slices` without an episode, from the sizes of the channels whose size is a function."""
        return _slices((channel.name, sizes.get(channel.name, channel.size)) for channel in cls.channels)

    @property
    def force_entries(self) -> list[int]:
        """Indices of the observation that depend on force sensing: those of the channels marked `felt`."""
        felt = [self.observation_slices[channel.name] for channel, _ in self._observed if channel.felt]
        return [index for part in felt for index in range(part.start, part.stop)]

    def bounds(self, instrument: Instrument | None) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the observation with an instrument, shape (n_observation,) each; all finite.

        Raises:
            ValueError: a channel whose bounds are not finite, do not fit its size, or are the wrong way round.
        """
        pairs = [self._channel_bounds(channel, size, instrument) for channel, size in self._observed]
        return np.concatenate([low for low, _ in pairs]), np.concatenate([high for _, high in pairs])

    def scales(self, instrument: Instrument | None) -> tuple[FloatArray, FloatArray]:
        """Origin and scale of each entry of the observation with an instrument, shape (n_observation,) each.

        An environment observes (value - origin) / scale.

        Raises:
            ValueError: a channel whose origin or scale is not finite, does not fit its size, or a scale not above 0.
        """
        origins = [self._entries(one, size, "origin", one.origin, instrument) for one, size in self._observed]
        scales = [self._entries(one, size, "scale", one.scale, instrument) for one, size in self._observed]
        for (channel, _), scale in zip(self._observed, scales, strict=True):
            if not (scale > 0.0).all():
                raise ValueError(f"channel {channel.name!r}: scale is {scale.tolist()}; it must be above 0")
        return np.concatenate(origins), np.concatenate(scales)

    def _entries(self, channel: Channel, size: int, what: str, given: Any, instrument: Instrument | None) -> FloatArray:
        """A bound, an origin or a scale of a channel as an array (size,)."""
        value = np.asarray(given(self, instrument) if callable(given) else given, dtype=np.float64)
        if value.size not in (1, size) or not np.isfinite(value).all():
            raise ValueError(
                f"channel {channel.name!r}: {what} is {value.tolist()}; it must be one finite number or {size}, "
                f"in {channel.unit or 'its own unit'}"
            )
        return np.broadcast_to(value.ravel(), size).copy()

    def _channel_bounds(
        self, channel: Channel, size: int, instrument: Instrument | None
    ) -> tuple[FloatArray, FloatArray]:
        if channel.low is None or channel.high is None:
            reach = np.full(size, self.sensors[channel.name].sensor.range)
            return -reach, reach
        low = self._entries(channel, size, "a bound", channel.low, instrument)
        high = self._entries(channel, size, "a bound", channel.high, instrument)
        if not (low <= high).all():
            raise ValueError(f"channel {channel.name!r}: low is {low.tolist()}, above high {high.tolist()}: swap them")
        return low, high

    def observe(self, simulation: Simulation, rng: np.random.Generator) -> tuple[FloatArray, bool]:
        """The observation (n_observation,), and whether a sensor saturated.

        Raises:
            ValueError: a channel's `read` returns a value of another size.
        """
        saturated = False
        for channel, _ in self._observed:
            if channel.sensor and channel.read is not None:
                value = np.asarray(channel.read(self, simulation), dtype=np.float64)
                self.sensed[channel.name], cut = self.sensors[channel.name].read(value, rng, simulation.time)
                saturated = saturated or cut
        self.look(simulation)
        return np.concatenate([self._value(channel, size, simulation) for channel, size in self._observed]), saturated

    def _value(self, channel: Channel, size: int, simulation: Simulation) -> FloatArray:
        assert channel.read is not None
        value = self.sensed[channel.name] if channel.sensor else channel.read(self, simulation)
        flat = np.asarray(value, dtype=np.float64).ravel()
        if flat.size != size:
            raise ValueError(
                f"channel {channel.name!r}: read returned {flat.size} numbers, shape {np.shape(value)}; its size is "
                f"{size}: return that many, or declare another size"
            )
        return flat

    def entry_name(self, index: int) -> str:
        """The channel of an entry of the observation, with the place in it: "contact_force[2]"."""
        for name, part in self.observation_slices.items():
            if part.start <= index < part.stop:
                return f"{name}[{index - part.start}]"
        raise IndexError(f"the observation has no entry {index}")

    def sensed_force(self, observation: NDArray[np.floating]) -> FloatArray:
        """The force sensor's reading in an observation [N], shape (3,)."""
        return np.asarray(observation[self.observation_slices["contact_force"]], dtype=np.float64)

    def look(self, simulation: Simulation) -> None:
        """Compute what several channels and rewards share, after the sensors were read."""

    # ---- an episode --------------------------------------------------------------------------------------------

    @property
    def force_limit(self) -> float:
        """Contact force that ends a control step within the haptic step, and the episode with it [N]."""
        return self.limits.hard_force

    @property
    def pull_limit(self) -> float:
        """Likewise for the pull of a jaw [N]."""
        return math.inf

    @property
    def lesions(self) -> tuple[Lesion, ...]:
        """The lesions of the episode; none before the first."""
        return () if self.drawn is None else self.drawn.lesions

    @property
    def target(self) -> Disc | None:
        """A disc that pictures show."""
        return None

    @property
    def endoscope(self) -> Endoscope | None:
        """Pose of the endoscope in this episode."""
        return None

    def take_anatomy(self, anatomy: Anatomy) -> None:
        """Play another member of the family from the next `reset` on.

        A subclass makes anew what it made from the anatomy, as attributes of their own: no object that the task holds
        is changed (`restored` calls it on a shallow copy).
        """
        self.anatomy = anatomy

    def reset(self, rng: np.random.Generator) -> Start:
        """Draw an episode: the organ, the sensors' biases, and what `draw` draws."""
        self.step_count = 0
        self.drawn = self.draw_organ(rng)
        for sensor in self.sensors.values():
            sensor.reset(rng)
        tip_position = self.draw(rng)
        return Start(self.drawn.compiled(self.anatomy), tip_position)

    def draw_organ(self, rng: np.random.Generator) -> DrawnOrgan:
        """Draw the organ: what the level hides, without a level the scene's healthy organ."""
        return DrawnOrgan(()) if self.level is None else self.level.draw(self.anatomy, rng)

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw the rest of an episode; returns the tip's position [m] (3,)."""
        raise NotImplementedError(f"{type(self).__name__} must define draw(rng): it returns the tip's position [m]")

    def accepts(self, simulation: Simulation) -> bool:
        """Whether the episode may begin as drawn, the simulation at rest; if not, another one is drawn."""
        self._reached = self._values(ControlStep(simulation))
        return True

    def judge(self, simulation: Simulation, force_peak: float, fault: str) -> Verdict:
        """End a control step.

        Args:
            simulation: after the step.
            force_peak: largest contact force of its haptic steps [N].
            fault: of the simulation or the observation; "" for none.
        """
        step = ControlStep(simulation, force_peak, fault)
        if not fault:
            self.update(step)
        end, before = self.end(step), self._reached
        load = simulation.tissue_load if self.limits.judges_tissue and not fault else None
        if load is not None and end not in self.failures and self._damages(load):
            end = DAMAGE
        if not fault:
            self._reached = self._values(step)
        # Adding 0.0 turns a product of -0.0 into 0.0.
        rewards = {one.name: one.weight * float(self._amount(one, step, end, before)) + 0.0 for one in self.rewards}
        truncated = not end and self.episode_steps is not None and self.step_count >= self.episode_steps
        return Verdict(bool(end), truncated, rewards, self.info(step, end) | self.tissue_info(load, end))

    @property
    def failures(self) -> tuple[str, ...]:
        """Names of the ends that are failures."""
        declared = [one.name for one in self.rewards if one.per == "failure"]
        return tuple(dict.fromkeys(("fault", *declared, "hard_force", DAMAGE)))

    def _values(self, step: ControlStep) -> dict[str, float]:
        """Values of the terms that pay for their change."""
        return {
            one.name: float(one.value(self, step))
            for one in self.rewards
            if one.per == "change" and one.value is not None
        }

    def _amount(self, reward: Reward, step: ControlStep, end: str, before: Mapping[str, float]) -> float:
        """What a term's weight is multiplied by."""
        if reward.per in ("success", "failure"):
            # Damage is a safety stop, as too large a force is.
            return float(end == reward.name or (end == DAMAGE and reward.name == "hard_force"))
        if reward.per == "change":
            return self._reached[reward.name] - before[reward.name]
        if reward.per == "step left":
            if end not in self.failures:
                return 0.0
            if reward.value is None:
                assert self.episode_steps is not None
                return float(self.episode_steps - self.step_count)
        return 1.0 if reward.value is None else reward.value(self, step)

    def _damages(self, load: TissueLoad) -> bool:
        """Whether tissue bears more than the scene's limits of pressure or strain."""
        limits = self.limits
        return load.pressure > (limits.pressure or math.inf) or load.strain > (limits.strain or math.inf)

    def tissue_info(self, load: TissueLoad | None, end: str) -> dict[str, InfoValue]:
        """Entries of `info` of a scene whose limits judge tissue: largest pressure [Pa] and strain; 0 without one."""
        if not self.limits.judges_tissue:
            return {}
        pressure, strain = (0.0, 0.0) if load is None else (load.pressure, load.strain)
        return {"tissue_pressure": pressure, "tissue_strain": strain, "damaged": end == DAMAGE}

    def update(self, step: ControlStep) -> None:
        """Take in a control step without a fault, before it is judged; called once for each."""

    def end(self, step: ControlStep) -> str:
        """Name of the reason that ends the episode in this control step; "" while it goes on. Called once for each.

        A name in `failures` is a failure; a declared reward of that name is paid.
        """
        if step.fault:
            return "fault"
        return "hard_force" if step.force_peak > self.force_limit else ""

    def info(self, step: ControlStep | None, end: str) -> dict[str, InfoValue]:
        """The task's entries of `info` after a control step, or (None, "") after a reset: the same keys and types."""
        peak = 0.0 if step is None else step.force_peak
        return {
            "force_peak": peak,
            "cost": 0.0 if step is None else max(self.limits.excess(peak), 0.0),
            "hard_limit": end == "hard_force",
            "success": end == "success" or any(one.name == end for one in self.rewards if one.per == "success"),
            **self.measures(),
        }

    def measures(self) -> dict[str, InfoValue]:
        """A subclass's own entries of `info`: fixed keys; bools, floats or texts."""
        return {}

    # ---- saved states ------------------------------------------------------------------------------------------

    def get_state(self) -> str:
        """All that the task drew and counted, as exact JSON.

        Raises:
            TypeError: a `kept` attribute that is no number, text, array or list of these.
        """
        assert self.drawn is not None
        state = {
            "drawn": self.drawn.to_json(),
            "step_count": self.step_count,
            "bias": {name: sensor.get_state() for name, sensor in self.sensors.items()},
            "sensed": self.sensed,
            "reached": self._reached,
            "kept": {name: getattr(self, name) for name in self.kept},
        }
        return json.dumps(state, default=_array_table)

    def saved_organ(self, text: str, anatomy: Anatomy) -> OrganModel:
        """The organ of the episode whose `get_state` is given; changes nothing.

        Args:
            text: from `get_state`.
            anatomy: of the episode: of a family that member's, else this task's own.
        """
        return self.draw_class.from_json(json.loads(text)["drawn"], anatomy).compiled(anatomy)

    def set_state(self, text: str, anatomy: Anatomy) -> None:
        """Restore what `get_state` gave and `saved_organ` accepted, with the anatomy of that episode."""
        saved = json.loads(text, object_hook=_array_of)
        if anatomy is not self.anatomy:
            self.take_anatomy(anatomy)
        self.drawn = self.draw_class.from_json(saved["drawn"], anatomy)
        self.step_count, self._reached, self.sensed = saved["step_count"], saved["reached"], saved["sensed"]
        for name, state in saved["bias"].items():
            self.sensors[name] = ForceReading(self.sensors[name].sensor, state)
        for name, value in saved["kept"].items():
            setattr(self, name, value)


# ---- channels and values that many tasks share ------------------------------------------------------------------


def force_scale(task: Task, instrument: Instrument | None) -> float:
    """Force that is observed as 1 [N]: the scene's soft limit."""
    return task.limits.soft_force


TIP_POSITION = Channel(
    "tip_position", 3, "m",
    low=lambda task, instrument: instrument.lower - POSITION_SLACK,
    high=lambda task, instrument: instrument.upper + POSITION_SLACK,
    read=lambda task, simulation: simulation.instrument.tip_position,
    meaning="tip position", bounds_text="the organ's bounding box with a margin",
    scale=LENGTH_SCALE, origin=lambda task, instrument: 0.5 * (instrument.lower + instrument.upper),
)  # fmt: skip
TIP_VELOCITY = Channel(
    "tip_velocity", 3, "m/s", -SPEED_BOUND, SPEED_BOUND,
    read=lambda task, simulation: simulation.instrument.tip_velocity,
    meaning="tip velocity", scale=SPEED_FULL_SCALE,
)  # fmt: skip
CONTACT_FORCE = Channel(
    "contact_force", 3, "N", sensor=1.0,
    read=lambda task, simulation: simulation.contact_force,
    meaning="contact force on the tip, mean of the last haptic step, through the sensor model",
    scale=force_scale, scale_text="soft limit",
)  # fmt: skip
TIME_LEFT = Channel(
    "time_left", 1, "", 0.0, 1.0,
    read=lambda task, simulation: 1.0 - task.step_count / task.episode_steps,
    meaning="share of the time left",
)  # fmt: skip


def soft_force_share(task: Task, step: ControlStep) -> float:
    """Position of the largest contact force between the soft (0) and the hard limit (1)."""
    return min(max(task.limits.excess(step.force_peak), 0.0), 1.0)


def _scaled(sensor: ForceSensor, factor: float) -> ForceSensor:
    numbers = (sensor.noise, sensor.bias, sensor.range, sensor.drift, sensor.hysteresis)
    return ForceSensor(*(factor * number for number in numbers))


def _size(part: Command | Channel, task: Task) -> int:
    """The number of entries of a command or channel."""
    return part.size(task) if callable(part.size) else part.size


def _slices(sized: Iterable[tuple[str, Any]]) -> dict[str, slice]:
    """Consecutive slices, by name; names of size 0 have none."""
    slices, first = {}, 0
    for name, size in sized:
        if size:
            slices[name] = slice(first, first + size)
        first += size
    return slices


def _array_table(value: Any) -> Any:
    """An array or a number of numpy's in a saved state, as JSON holds it."""
    if isinstance(value, np.ndarray):
        return {"array": value.tolist(), "dtype": str(value.dtype)}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(
        f"a kept attribute holds a {type(value).__name__}; a saved state holds numbers, texts, arrays and lists of "
        "these: keep such, and make the rest from them"
    )


def _array_of(table: dict[str, Any]) -> Any:
    """The array of a table that `_array_table` wrote; any other table unchanged."""
    return np.array(table["array"], table["dtype"]) if table.keys() == {"array", "dtype"} else table
