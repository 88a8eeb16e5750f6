"""The declaration of a task: commands, observation channels, reward terms, setup, and the tables that document them."""

import inspect
import math
import re
import reprlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.levels import DrawnOrgan
from surgsim_env.scene.load import make_scene, require_known
from surgsim_env.scene.model import Scene

# Full scale of a velocity command [m/s].
SPEED_FULL_SCALE = 0.02

Size = int | Callable[[Any], int]
Bound = float | Sequence[float] | Callable[[Any, Any], ArrayLike]
Period = Literal["step", "change", "success", "failure", "step left"]

# Periods of rewards in words, for the documentation.
PERIODS: dict[str, str] = {
    "step": "control step",
    "change": "change of the value",
    "success": "end in success",
    "failure": "end in failure",
    "step left": "control step left after a failure",
}
HEADINGS = (
    *("Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End"),
    *("Info", "Arguments", "Version History"),
)


@dataclass(frozen=True, eq=False)
class Command:
    """A named part of the action.

    Fields:
        name: an identifier; `TaskLayout.action` takes it as a keyword
        size: number of entries, or a function `(task)`; 0 leaves the command out
        scale: SI value of an entry of 1; entries lie in [-1, 1]
        unit: SI unit, "" for none
        meaning: for the table of actions
        size_text: text of the table for a size given by a function
        axes: function `(task)`, the axes of a vector as unit rows (3, 3); None for the world's
        default: function `(task)`, the SI value for `TaskLayout.action` without one; None for 0
    """

    name: str
    size: Size
    scale: float = 1.0
    unit: str = ""
    meaning: str = ""
    size_text: str = "by the scene"
    axes: Callable[[Any], FloatArray | None] | None = None
    default: Callable[[Any], ArrayLike] | None = None


@dataclass(frozen=True, eq=False)
class Channel:
    """A named part of the observation.

    Fields:
        name: an identifier; `observation_slices` has it as a key
        size: number of entries, or a function `(task)`; 0 leaves the channel out
        unit: SI unit, "" for none
        low, high: bounds: a number, a number for each entry, or a function `(task, instrument)` of these; a value
            outside is a fault. With a `sensor` left out: plus and minus its range
        read: function `(task, simulation)`, the value as `size` numbers
        meaning: for the table of observations
        sensor: 0, or the factor on noise, bias and range of the scene's force sensor, whose model the value (3 numbers)
            passes through
        felt: True if it depends on force sensing and `observe_force=False` observes it as 0; so with a `sensor`
        size_text, bounds_text, scale_text: texts of the table for size, bounds and scale given by functions
        scale: value observed as 1, in the form of a bound; required with a unit
        origin: value observed as 0, likewise
        late_bias: True if the sensor's bias is drawn after the task's `draw`, not before
        taxels: True for forces of the instrument's taxels, through their sensor model; bounds are plus and minus their
            range
    """

    name: str
    size: Size
    unit: str = ""
    low: Bound | None = None
    high: Bound | None = None
    read: Callable[[Any, Any], ArrayLike] | None = None
    meaning: str = ""
    sensor: float = 0.0
    felt: bool = False
    size_text: str = "by the scene"
    bounds_text: str = "by the scene"
    scale: Bound | None = None
    origin: Bound = 0.0
    scale_text: str = "by the scene"
    late_bias: bool = False
    taxels: bool = False

    def __post_init__(self) -> None:
        if self.scale is None:
            if self.unit:
                raise ValueError(
                    f"channel {self.name!r} in {self.unit} has no scale: give the value that is observed as 1, so that "
                    "a network reads numbers of order 1"
                )
            object.__setattr__(self, "scale", 1.0)
        if self.sensor:
            reach = self.sensor
            object.__setattr__(self, "felt", True)
            object.__setattr__(self, "low", lambda task, _: -reach * task.anatomy.scene.sensor.range)
            object.__setattr__(self, "high", lambda task, _: reach * task.anatomy.scene.sensor.range)
            object.__setattr__(self, "bounds_text", "+-range")
            if self.size != 3 or not 0.0 < self.sensor < math.inf:
                raise ValueError(
                    f"channel {self.name!r}: sensor is {self.sensor!r} with size {self.size!r}; the force sensor has "
                    "three axes and its factor is a finite number above 0: give size 3, or no sensor"
                )
        elif self.taxels:
            object.__setattr__(self, "felt", True)
            object.__setattr__(self, "low", lambda task, _: -task.anatomy.scene.instrument.taxels.range)
            object.__setattr__(self, "high", lambda task, _: task.anatomy.scene.instrument.taxels.range)
            object.__setattr__(self, "bounds_text", "+-range")
        elif self.low is None or self.high is None:
            raise ValueError(f"channel {self.name!r} has no bounds: give low and high, finite numbers or functions")

    @property
    def scale_shown(self) -> str:
        """Scale for the table of observations."""
        if isinstance(self.scale, int | float):
            return f"{self.scale:g} {self.unit}".strip()
        return self.scale_text

    @property
    def bounds_shown(self) -> str:
        """Bounds for the table of observations."""
        if isinstance(self.low, int | float) and isinstance(self.high, int | float):
            return f"+-{self.high:g}" if self.low == -self.high else f"{self.low:g} to {self.high:g}"
        return self.bounds_text


@dataclass(frozen=True)
class ControlStep:
    """State of the simulation after a control step; a reset counts as a step without force.

    Fields:
        simulation: between two control steps
        force_peak: largest contact force of its haptic steps [N]
        fault: of the simulation or the observation; "" for none
    """

    simulation: Simulation
    force_peak: float = 0.0
    fault: str = ""


@dataclass(frozen=True, eq=False)
class Reward:
    """A named reward term; it pays `weight` times an amount.

    Fields:
        name: an identifier; `info["reward_<name>"]` is the paid amount
        weight: of the term
        per: kind of the amount. "step": `value` in each control step (1 without one); "change": the change of `value`
            since the control step before, so that it cannot be earned twice; "success" and "failure": 1 in the control
            step in which the episode ends with this name (see `Task.end`); "step left": the control steps left when
            the episode ends in failure, or `value` then
        meaning: for the table of rewards
        value: function `(task, control_step)`, a finite number, best in [0, 1]
    """

    name: str
    weight: float
    per: Period
    meaning: str = ""
    value: Callable[[Any, Any], float] | None = None

    def __post_init__(self) -> None:
        if self.per == "change" and self.value is None:
            raise ValueError(f"reward {self.name!r} pays a change, but has no value that could: give `value`")
        require_known("period", self.per, PERIODS)
        weight = real_numbers(self.weight, "weight of reward", self.name)
        if weight.ndim or not np.isfinite(weight):
            raise ValueError(f"reward {self.name!r}: weight is {self.weight}; it must be a finite number")


@dataclass(frozen=True)
class Setup:
    """Scene, instrument, lesions and length of a task's episodes.

    Fields:
        scene, instrument, level: defaults of the environment's arguments; instrument None: the scene's; level None:
            the scene's own ranges
        lesion_count: number of lesions, or its least and most; None: as drawn by the level, without a level none
        episode_steps: control steps until an episode is truncated; None where the task ends it by itself
        load: function from the name or file of a scene to the scene
        drawn: class of an episode's organ, with `draw`, `to_json`, `from_json` and `compiled` as `DrawnOrgan` has
    """

    scene: str = "phantom"
    instrument: str | None = None
    level: str | None = None
    lesion_count: int | tuple[int, int] | None = None
    episode_steps: int | None = 600
    load: Callable[[str], Scene] = make_scene
    drawn: type[Any] = DrawnOrgan


def real_numbers(value: Any, owner: str, name: str) -> FloatArray:
    """Numbers of a task's declaration as float64, of their own shape.

    Raises:
        ValueError: a value that is no real number or array of these; names its owner.
    """
    try:
        numbers = np.asarray(value)
    except ValueError:  # rows of different lengths
        numbers = np.array(None)
    if numbers.dtype.kind not in "biuf" or np.ma.is_masked(value):
        raise ValueError(f"{owner} {name!r} gives {reprlib.repr(value)}; give numbers of type float")
    return numbers.astype(np.float64, copy=False)


def reward_weights(task_class: Any) -> dict[str, float]:
    """Weights of a task's reward terms, by name."""
    return {reward.name: reward.weight for reward in task_class.rewards}


# ---- tables -------------------------------------------------------------------------------------------------------


def table(heading: str, rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table; `heading` names its columns, separated by commas."""
    columns = heading.split(", ")
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def action_table(task_class: Any) -> str:
    """Commands of a task: size, meaning, full scale."""
    rows = []
    for command in task_class.commands:
        scale = f"{command.scale:g} {command.unit}".strip() if command.unit else ""
        rows.append((f"`{command.name}`", _size_shown(command), command.meaning, scale))
    return table("command, size, meaning, full scale", rows)


def observation_table(task_class: Any) -> str:
    """Channels of a task: size, meaning with unit, bounds, scale; then those that `observe_force=False` hides."""
    rows = []
    for channel in task_class.channels:
        unit = f" [{channel.unit}]" if channel.unit else ""
        rows.append(
            (
                f"`{channel.name}`",
                _size_shown(channel),
                channel.meaning + unit,
                channel.bounds_shown,
                channel.scale_shown,
            )
        )
    felt = ", ".join(f"`{channel.name}`" for channel in task_class.channels if channel.felt)
    note = f"\n\nWith `observe_force=False` these are observed as 0: {felt}." if felt else ""
    return table("channel, size, meaning, bounds, scale", rows) + SCALED + note


def reward_table(task_class: Any) -> str:
    """Reward terms of a task: weight, period, meaning."""
    rows = [(f"`{term.name}`", f"{term.weight:g}", PERIODS[term.per], term.meaning) for term in task_class.rewards]
    return table("term, weight, paid per, meaning", rows)


def documentation(task_class: Any) -> str:
    """The documentation of an environment in Gymnasium's form: the task's docstring with the declared tables.

    Sections missing in the docstring are left out, except those filled from the declaration.
    """
    summary, sections = docstring_sections(inspect.getdoc(task_class) or "")
    filled = {
        "Action Space": action_table(task_class),
        "Observation Space": observation_table(task_class),
        "Rewards": reward_table(task_class),
        "Arguments": COMMON_ARGUMENTS,
    }
    box = {"Action Space": "`Box(-1, 1, float32)`", "Observation Space": "`Box(float32)`, all bounds finite"}
    first = f"* `scene`: the name or file of a scene; default {task_class.setup.scene!r}.\n* `instrument`: likewise."
    for heading, text in filled.items():
        own = sections.get(heading) or {**box, "Arguments": first}.get(heading, "")
        sections[heading] = f"{own}\n{text}".strip() if heading == "Arguments" else f"{own}\n\n{text}".strip()
    order = sorted(sections, key=lambda heading: HEADINGS.index(heading) if heading in HEADINGS else len(HEADINGS))
    return "\n\n".join([summary, *(f"## {heading}\n{sections[heading]}" for heading in order)])


def docstring_sections(docstring: str) -> tuple[str, dict[str, str]]:
    """The summary of a docstring, and the text under each of its `## ` headings."""
    summary, *parts = re.split(r"^## (.+)$", inspect.cleandoc(docstring), flags=re.MULTILINE)
    return summary.strip(), {title.strip(): text.strip() for title, text in zip(parts[::2], parts[1::2])}


def _size_shown(part: Command | Channel) -> str:
    return part.size_text if callable(part.size) else str(part.size)


SCALED = """

Meanings and bounds are in SI units. The environment observes each value over its channel's scale, positions from the
middle of their bounds; with `scaled=False` SI units. Numbers and places of entries are the same."""

COMMON_ARGUMENTS = """* `scaled`: each value over its channel's scale, of order 1 (default); False: SI units.
* `observe_force`: False observes all channels that depend on force sensing as 0.
* `obs_mode`: "state" (default), "dict" for the channels by their names, "rgb" for the endoscope's picture,
  `Box(0, 255, (84, 84, 3), uint8)` (needs OpenGL), or "rgb_force" for a dictionary of it ("picture") and of the
  channels that depend on force sensing ("force").
* `looks`: None (default), or "train" or "test" for pictures with a random look in each episode (docs/rendering.md).
* `measure_tissue`: True measures the tissue's load in each step (`info`) also where the scene has no limits of it.
* `control_step`: duration of a control step, a multiple of 1 ms [s]; 0.05 by default. With 0.25 an untrained network's
  commands last long enough to press and to declare.
* `failure_share`: paid share of the terms of a failure, 0 to 1 (default), for training: at 1 a beginner of palpation
  learns to do nothing.
* `shaping`: weight of a term for training, 0 by default, paid per change of the task's potential (a method
  `potential(step)`, which knows the truth). It is not paid back at the end, so that an episode that ends near its goal
  pays more; scores leave it out.
* `render_mode`: None, "rgb_array" (off screen, no display needed) or "human" (a window).
* `camera`, `width`, `height`, `show_force`, `show_lesion`, `cut_away` and the other fields of
  `surgsim_env.rendering.options.RenderOptions`: what pictures show."""
