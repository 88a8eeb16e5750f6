"""What an environment asks of a task: its spaces, its draw, its commands, what it observes and how it judges."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from msdm_core.kernels import OrganModel
from msdm_core.mesh import FloatArray
from msdm_core.regions import Lesion
from surgsim_env.instrument import Instrument
from surgsim_env.scenes import Endoscope
from surgsim_env.simulation import Simulation
from surgsim_env.visibility import Disc

InfoValue = bool | float | str


@dataclass(frozen=True, eq=False)
class Start:
    """What an episode begins with: the organ as it was drawn, and where the tip is [m] (3,)."""

    organ: OrganModel
    tip_position: FloatArray


@dataclass(frozen=True)
class Verdict:
    """The judgement of a control step: how it ends, its weighted reward terms, and what `info` says of it."""

    terminated: bool
    truncated: bool
    rewards: dict[str, float]
    info: dict[str, InfoValue]


@dataclass(frozen=True, eq=False)
class Bounds:
    """Lower and upper bounds of the observation, shape (n_observation,) each; all finite."""

    low: FloatArray
    high: FloatArray


class Task(Protocol):
    """One episode after another on one anatomy; it reads the simulation and never advances it.

    An environment calls `reset` (again where `accepts` says no), then for each control step `command`, `begin`, and
    when the simulation has advanced, `observe` and `judge`.

    Fields:
        action_size: entries of an action, each in [-1, 1]
        weights: of its reward terms, by name
        force_limit: a control step ends with the haptic step whose contact force passes this, and the episode too [N]
        pull_limit: likewise with the pull of a jaw; infinite where nothing tears [N]
        lesions: hidden in the organ in this episode
        target: a disc that pictures show, None for none
        endoscope: where the endoscope stands in this episode; None: as the scene says
    """

    action_size: int
    weights: Mapping[str, float]

    @property
    def force_limit(self) -> float: ...  # noqa: D102

    @property
    def pull_limit(self) -> float: ...  # noqa: D102

    @property
    def lesions(self) -> tuple[Lesion, ...]: ...  # noqa: D102

    @property
    def target(self) -> Disc | None: ...  # noqa: D102

    @property
    def endoscope(self) -> Endoscope | None: ...  # noqa: D102

    def bounds(self, instrument: Instrument) -> Bounds:
        """Bounds of the observation with an instrument; leaving them is a fault."""
        ...

    def reset(self, rng: np.random.Generator) -> Start:
        """Draw an episode."""
        ...

    def accepts(self, simulation: Simulation) -> bool:
        """Whether the episode may begin as drawn; the simulation is at rest."""
        ...

    def command(self, action: FloatArray, instrument: Instrument) -> None:
        """Give the instrument the commands that an action holds (action_size,)."""
        ...

    def begin(self, action: FloatArray) -> None:
        """Begin a control step: count it and note what the action says beside its commands."""
        ...

    def observe(self, simulation: Simulation, rng: np.random.Generator) -> tuple[FloatArray, bool]:
        """The observation, and whether the sensor saturated."""
        ...

    def judge(self, simulation: Simulation, force_peak: float, fault: str) -> Verdict:
        """End a control step.

        Args:
            simulation: as the step left it.
            force_peak: largest contact force of its haptic steps [N].
            fault: what the simulation came to, or an empty string.
        """
        ...

    def blank_info(self) -> dict[str, InfoValue]:
        """The info of a reset: the same keys and types as a verdict's."""
        ...

    def get_state(self) -> str:
        """All that the task drew and counted, as exact JSON."""
        ...

    def set_state(self, text: str) -> OrganModel:
        """Restore what `get_state` gave; returns the organ of that episode."""
        ...
