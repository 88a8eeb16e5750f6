"""Episodes of a task: their draw, observation, judgement and saved state, from the task's declaration."""

import base64
import inspect
import io
import json
import math
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.measure import TissueLoad
from surgsim_env.coupling.sensors import ForceReading, TaxelReading
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.instrument import Instrument
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.family import OrganFamily, family_of
from surgsim_env.scene.levels import find_level
from surgsim_env.scene.load import with_instrument
from surgsim_env.scene.model import ForceSensor
from surgsim_env.scene.motions import with_motion
from surgsim_env.tasks.declaration import ControlStep, Reward, real_numbers
from surgsim_env.tasks.layout import TaskLayout
from surgsim_env.tasks.task import InfoValue, Scenario, Task

# Draws of an episode until the task has to accept one.
DRAWS_MOST = 20
# Name of the end by tissue above the limits of pressure, strain or dose.
DAMAGE = "damage"
# Ends that need no reward of their name: failures, a success, and an end that is neither.
ENDS = ("fault", "hard_force", DAMAGE, "success", "done")


@dataclass(frozen=True)
class Verdict:
    """The judgement of a control step: the episode's end, the weighted reward terms, the task's entries of `info`."""

    terminated: bool
    truncated: bool
    rewards: dict[str, float]
    info: dict[str, InfoValue]


class TaskRuntime:
    """Episodes of a task.

    For an episode an environment calls `reset` and `observe`, for each control step `begin` and, when the simulation
    has advanced, `observe` and `judge`.

    Fields:
        task: the task
        layout: of its actions and observations
        family: members that episodes draw from; None for a scene of one organ
        sensors: sensor models, by the channel's name
        successes, failures: names of the ends that are these
        measures_tissue: True if `info` has the tissue's load, as it has by itself where the scene limits it
    """

    def __init__(
        self, task: Task, family: OrganFamily | None = None, *, shaping: float = 0.0, failure_share: float = 1.0
    ) -> None:
        """Play the episodes of a task, with its rewards or those for training (`training_rewards`)."""
        self.task, self.family = task, family
        # Terms hold functions, which cannot be pickled: an environment is, with these numbers.
        self._training = float(shaping), float(failure_share)
        training_rewards(type(task), *self._training)
        self.measures_tissue = task.limits.judges_tissue
        self.layout = TaskLayout(task)
        own = task.anatomy.scene.sensor
        taxels, shape = task.anatomy.scene.instrument.taxels, task.taxel_shape
        self.sensors: dict[str, ForceReading | TaxelReading] = {
            channel.name: TaxelReading(taxels, shape)
            if channel.taxels and taxels is not None
            else ForceReading(_scaled(own, channel.sensor))
            for channel, _ in self.layout.sensed
        }
        declared = [reward.name for reward in task.rewards if reward.per == "failure"]
        for reward in task.rewards:
            if reward.per == "step left" and reward.value is None and task.episode_steps is None:
                raise ValueError(
                    f"{type(task).__name__}: reward {reward.name!r} pays the control steps left, and the task has no "
                    "episode_steps: give Setup.episode_steps, or the reward a value"
                )
        self.failures = tuple(dict.fromkeys(("fault", *declared, "hard_force", DAMAGE)))
        # A subclass may leave out terms whose ends its base returns.
        terms = [term for base in type(task).__mro__ for term in vars(base).get("rewards", ())]
        self._ends = {*ENDS, *(term.name for term in terms if term.per in ("success", "failure"))}
        self.successes = ("success", *(reward.name for reward in task.rewards if reward.per == "success"))
        # Last values of the terms paid per change.
        self._reached: dict[str, float] = {}

    @property
    def rewards(self) -> tuple[Reward, ...]:
        """The task's terms, as they are paid."""
        unchanged = self._training == (0.0, 1.0)
        return self.task.rewards if unchanged else training_rewards(type(self.task), *self._training)

    # ---- limits of a control step ------------------------------------------------------------------------------

    @property
    def force_limit(self) -> float:
        """Limit of the contact force [N]; above it a control step ends within the haptic step."""
        return self.task.limits.hard_force

    @property
    def pull_limit(self) -> float:
        """Limit of a jaw's pull [N], likewise; infinite for a task without a failure "torn"."""
        return self.task.limits.tear_force if "torn" in self.failures else math.inf

    # ---- an episode --------------------------------------------------------------------------------------------

    def reset(self, simulation: Simulation, rng: np.random.Generator) -> None:
        """Draw episodes until the task accepts one; organ and instrument are at rest.

        Raises:
            ValueError: none of DRAWS_MOST draws is accepted, a tip inside the organ or without a finite position, or a
                term paid per change without a finite value.
        """
        name, shape = type(self.task).__name__, simulation.instrument.parked.shape
        for _ in range(DRAWS_MOST):
            tip_position = real_numbers(self.draw(rng), "draw of", name)
            if tip_position.shape != shape or not np.isfinite(tip_position).all():
                raise ValueError(
                    f"{name}.draw returned {tip_position.tolist()}; return the tip's position, finite numbers [m] of "
                    f"shape {shape}"
                )
            anatomy = self.task.anatomy
            simulation.take_anatomy(anatomy)
            simulation.instrument.draw_errors(rng)
            simulation.reset(self.task.drawn.compiled(anatomy), tip_position)
            if any(map(simulation.covers, tip_position.reshape(-1, 3))):
                raise ValueError(
                    f"{name}.draw puts the tip at {tip_position.tolist()} m, inside the organ: return a position "
                    "outside it, such as a point of its surface plus the tip's radius along the normal"
                )
            simulation.draw_motion(rng)
            if self.task.accepts(simulation):
                self._reached = self._values(ControlStep(simulation))
                return
        raise ValueError(
            f"scene {self.task.anatomy.scene.name!r}: none of {DRAWS_MOST} draws is an episode that the task accepts: "
            "narrow the ranges of the scene's draw"
        )

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw member, organ, biases of the sensors and the task's own; returns the tip's position [m]."""
        task = self.task
        if self.family is not None:
            task.anatomy = self.family.draw(rng)
        task.step_count = 0
        self._take(task.setup.drawn.draw(task.anatomy, rng, task.level, task.setup.lesion_count))
        self._draw_biases(rng, late=False)
        tip_position = task.draw(rng)
        self._draw_biases(rng, late=True)
        return tip_position

    def _take(self, drawn: Any) -> None:
        self.task.drawn, self.task.lesions = drawn, drawn.lesions

    def _draw_biases(self, rng: np.random.Generator, *, late: bool) -> None:
        for channel, _ in self.layout.sensed:
            if channel.late_bias is late:
                self.sensors[channel.name].reset(rng)

    def begin(self, action: FloatArray, instrument: Instrument) -> None:
        """Begin a control step: count it and give the instrument the commands of an action (action_size,)."""
        self.task.step_count += 1
        self.task.command(self.layout.commands(action), instrument)

    def observe(self, step: ControlStep, rng: np.random.Generator) -> tuple[FloatArray, bool]:
        """The observation (n_observation,) after a reset or a control step, and True if a sensor saturated.

        Raises:
            ValueError: a channel's `read` returns other than real numbers, or another size.
        """
        task, simulation, saturated = self.task, step.simulation, False
        for channel, size in self.layout.sensed:
            value = self.layout.reading(channel, size, simulation)
            task.sensed[channel.name], cut = self.sensors[channel.name].read(value, rng, simulation.time)
            saturated = saturated or cut
        task.update(step)
        return self.layout.read(simulation), saturated

    # ---- judgement ---------------------------------------------------------------------------------------------

    def judge(self, step: ControlStep) -> Verdict:
        """Judgement of a control step, after its observation unless it has a fault.

        Raises:
            ValueError: a reward that is not finite, or an end that is not declared (names it).
        """
        task, before = self.task, self._reached
        end = task.end(step)
        if not isinstance(end, str) or (end and end not in self._ends):
            raise ValueError(
                f'{type(task).__name__}.end returned {end!r}; return "" while the episode goes on, else one of '
                f"{', '.join(sorted(self._ends))}, or declare a reward of that name"
            )
        load = step.simulation.tissue_load if self.measures_tissue and not step.fault else None
        if load is not None and end not in self.failures and self._damages(load, step.simulation.tissue_dose):
            end = DAMAGE
        if not step.fault:
            self._reached = self._values(step)
        # Adding 0.0 turns a product of -0.0 into 0.0.
        rewards = {
            reward.name: self._finite(reward, reward.weight * self._amount(reward, step, end, before) + 0.0)
            for reward in self.rewards
        }
        truncated = not end and task.episode_steps is not None and task.step_count >= task.episode_steps
        return Verdict(bool(end), truncated, rewards, self._info(step, load, end))

    def first_info(self) -> dict[str, InfoValue]:
        """The task's entries of `info` after a reset."""
        return self._info(None, None, "")

    def _info(self, step: ControlStep | None, load: TissueLoad | None, end: str) -> dict[str, InfoValue]:
        """The task's entries of `info`, the tissue's, and the success by the names that trainers read."""
        info = {"success": end in self.successes, **self.task.info(step, end), **self._tissue_info(step, load, end)}
        return {**info, "is_success": bool(info["success"])}

    def _values(self, step: ControlStep) -> dict[str, float]:
        """Values of the terms paid per change."""
        return {
            reward.name: self._finite(reward, self._value(reward, step))
            for reward in self.rewards
            if reward.per == "change"
        }

    def _value(self, reward: Reward, step: ControlStep) -> float:
        """Value of a term; 1 without one."""
        value = 1.0 if reward.value is None else reward.value(self.task, step)
        if type(value) is float:  # most are
            return value
        numbers = real_numbers(value, "reward", reward.name)
        return numbers.item() if numbers.size == 1 else math.nan

    def _finite(self, reward: Reward, number: float) -> float:
        if not math.isfinite(number):
            raise ValueError(
                f"{type(self.task).__name__}, control step {self.task.step_count}: reward {reward.name!r} is {number}; "
                "its value must be one number, finite also when it is weighted"
            )
        return number

    def _amount(self, reward: Reward, step: ControlStep, end: str, before: Mapping[str, float]) -> float:
        """Factor of a term's weight."""
        task = self.task
        if reward.per in ("success", "failure"):
            # Damage is a safety stop, as too large a force is.
            return float(end == reward.name or (end == DAMAGE and reward.name == "hard_force"))
        if reward.per == "change":
            return self._reached[reward.name] - before[reward.name]
        if reward.per == "step left":
            if end not in self.failures:
                return 0.0
            if reward.value is None:
                assert task.episode_steps is not None
                return float(task.episode_steps - task.step_count)
        return self._value(reward, step)

    def _damages(self, load: TissueLoad, dose: float) -> bool:
        """True if a load or a dose [Pa s] exceeds the scene's limits."""
        limits = self.task.limits
        measured = ((load.pressure, limits.pressure), (load.strain, limits.strain), (dose, limits.dose))
        return any(value > (limit or math.inf) for value, limit in measured)

    def _tissue_info(self, step: ControlStep | None, load: TissueLoad | None, end: str) -> dict[str, InfoValue]:
        """Largest pressure [Pa], strain and dose [Pa s] of the tissue, where measured; 0 without a load, or a step.

        It is extrapolated beyond the equivalent strain up to which recorded presses support the tissue's law.
        """
        if not self.measures_tissue:
            return {}
        dose = 0.0 if step is None else step.simulation.tissue_dose
        pressure, strain, equivalent = (
            (0.0, 0.0, 0.0) if load is None else (load.pressure, load.strain, load.equivalent_strain)
        )
        extrapolated = equivalent > self.task.anatomy.scene.material.strain_supported
        return {
            "tissue_pressure": pressure, "tissue_strain": strain, "tissue_extrapolated": extrapolated,
            "damaged": end == DAMAGE, **({} if self.task.limits.dose is None else {"tissue_dose": dose}),
        }  # fmt: skip

    # ---- saved states ------------------------------------------------------------------------------------------

    def get_state(self) -> str:
        """The draws and counts of the episode, as exact JSON.

        Raises:
            TypeError: a `kept` attribute of another type than `_kept_form` takes.
        """
        task = self.task
        assert task.drawn is not None
        state = {
            "drawn": task.drawn.to_json(),
            "step_count": task.step_count,
            "bias": {name: sensor.get_state() for name, sensor in self.sensors.items()},
            "sensed": {name: _kept_form(value, name) for name, value in task.sensed.items()},
            "reached": self._reached,
            "kept": {name: _kept_form(getattr(task, name), name) for name in task.kept},
        }
        return json.dumps(state)

    def read_state(self, text: str, anatomy: Anatomy) -> dict[str, Any]:
        """The contents of a saved episode, `drawn` its organ; changes nothing.

        Args:
            text: from `get_state`.
            anatomy: of the episode: of a family that member's, else the task's own.
        """
        saved = json.loads(text)
        for part in ("sensed", "kept"):
            saved[part] = {name: _kept_value(form) for name, form in saved[part].items()}
        return {**saved, "drawn": self.task.setup.drawn.from_json(saved["drawn"], anatomy)}

    def set_state(self, saved: Mapping[str, Any], anatomy: Anatomy) -> None:
        """Restore the contents of a saved episode from `read_state`, with its anatomy."""
        task = self.task
        task.anatomy = anatomy
        self._take(saved["drawn"])
        task.step_count, task.sensed, self._reached = saved["step_count"], saved["sensed"], saved["reached"]
        for name, state in saved["bias"].items():
            self.sensors[name] = self.sensors[name].restored(state)
        for name, value in saved["kept"].items():
            setattr(task, name, value)


# ---- the environment's arguments --------------------------------------------------------------------------------


def make_runtime(
    task_class: type[Task],
    scene: str | None = None,
    instrument: str | None = None,
    *,
    motion: str | None = None,
    level: str | None = None,
    split: str | None = None,
    control_step: float | None = None,
    shaping: float = 0.0,
    failure_share: float = 1.0,
    **settings: Any,
) -> tuple[Simulation, TaskRuntime]:
    """Simulation and episodes of a task; the arguments that are None are the task's (`Task.setup`).

    Args:
        task_class: the task.
        scene: name or file of a scene.
        instrument: name of an arm, or its TOML file; else the scene's own.
        motion: "none", "calm" or "free": breathing of the patient (`surgsim_env.scene.motions`); else as the level,
            then the scene says.
        level: "easy", "standard", "hard" or "clinical": lesions of the organ (`surgsim_env.scene.levels`).
        split: "train" (default), "validation" or "test": members of a scene's family (`surgsim_env.scene.family`); left
            out for scenes of one organ.
        control_step: duration of a control step [s]; else the scene's.
        shaping: weight of a term for training (`training_rewards`).
        failure_share: paid share of the terms of a failure, likewise.
        settings: keyword-only parameters of the task's `__init__`.

    Raises:
        ValueError: a control step of no whole number of haptic steps, or what scene and task refuse.
    """
    setup = task_class.setup
    level = level or setup.level
    chosen = None if level is None else find_level(level)
    plain = setup.load(setup.scene if scene is None else scene)
    armed = with_instrument(plain, setup.instrument if instrument is None else instrument)
    described = with_motion(armed, motion or (chosen and chosen.motion))
    if control_step is not None:
        described = replace(described, timing=described.timing.with_control_step(control_step))
    anatomy = load_anatomy(described if chosen is None else chosen.scene(described))
    family = family_of(anatomy, split)
    simulation = Simulation(anatomy)
    task = task_class(Scenario(anatomy, simulation.instrument, chosen, family, plain), **settings)
    return simulation, TaskRuntime(task, family, shaping=shaping, failure_share=failure_share)


@cache
def training_rewards(task: type[Task], shaping: float, failure_share: float) -> tuple[Reward, ...]:
    """The reward terms of a task, changed for training.

    Args:
        task: its class; with `shaping` one with a method `potential(step)`, a number for a `ControlStep`.
        shaping: weight of a further term "shaping", paid per change of the potential; 0 for none.
        failure_share: paid share of the terms of a failure, 0 to 1.

    Raises:
        ValueError: shaping of a task without a potential, or a share beyond 0 to 1.
    """
    if not 0.0 <= failure_share <= 1.0:
        raise ValueError(f"failure_share is {failure_share!r}; it must be a number from 0 to 1")
    terms = tuple(
        replace(term, weight=failure_share * term.weight) if term.per in ("failure", "step left") else term
        for term in task.rewards
    )
    if not shaping:
        return terms
    if not hasattr(task, "potential"):
        raise ValueError(f"shaping is {shaping!r}, and {task.__name__} has no method potential(step): define it")
    return (*terms, Reward("shaping", shaping, "change", value=lambda task, step: task.potential(step)))


def setting_names(task_class: type[Task]) -> set[str]:
    """Names of `make_runtime`'s arguments beside scene and instrument."""
    parameters = [*inspect.signature(make_runtime).parameters.values()]
    parameters += inspect.signature(task_class.__init__).parameters.values()
    return {parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY}


def _scaled(sensor: ForceSensor, factor: float) -> ForceSensor:
    numbers = (sensor.noise, sensor.bias, sensor.range, sensor.drift, sensor.hysteresis)
    return ForceSensor(*(factor * number for number in numbers))


def _kept_form(value: Any, name: str) -> Any:
    """JSON form of a kept attribute; arrays and numpy's scalars in numpy's own file format, in base64.

    Raises:
        TypeError: a type whose values `_kept_value` would not give back exactly; names the attribute.
    """
    kind = type(value)
    if value is None or kind in (bool, int, float, str):
        return value
    if kind is list:
        return [_kept_form(entry, name) for entry in value]
    if kind is tuple:
        return {"tuple": _kept_form(list(value), name)}
    if kind is dict:
        return {"dict": _kept_form(list(value.items()), name)}
    if (kind is np.ndarray or isinstance(value, np.generic)) and not value.dtype.hasobject:
        buffer = io.BytesIO()
        np.save(buffer, value, allow_pickle=False)
        form = {"array" if kind is np.ndarray else "scalar": base64.b64encode(buffer.getvalue()).decode()}
        # The file has no types of other packages, no records and no zeros at the end of a text.
        if repr(_kept_value(form).dtype) == repr(value.dtype):
            return form
    raise TypeError(
        f"kept attribute {name!r} holds {reprlib.repr(value)} ({kind.__name__}); a saved state holds numbers, texts, "
        "numpy's arrays and scalars of plain types, and lists, tuples and dictionaries of these: keep such, and make "
        "the rest from them"
    )


def _kept_value(form: Any) -> Any:
    """Value of a form from `_kept_form`, of the same type and bits."""
    if isinstance(form, list):
        return [_kept_value(entry) for entry in form]
    if not isinstance(form, dict):
        return form
    ((kind, content),) = form.items()
    if kind == "tuple":
        return tuple(_kept_value(content))
    if kind == "dict":
        return dict(_kept_value(content))
    array = np.load(io.BytesIO(base64.b64decode(content)), allow_pickle=False)
    return array if kind == "array" else array[()]
