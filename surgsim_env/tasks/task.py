"""The base of all tasks: the declaration of an episode, its draw, its commands and its end."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from msdm_core.material.regions import Lesion
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.instrument import NO_TAXELS, Instrument
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.family import OrganFamily
from surgsim_env.scene.levels import Level
from surgsim_env.scene.model import Endoscope, Scene
from surgsim_env.tasks.declaration import SPEED_FULL_SCALE, Channel, Command, ControlStep, Reward, Setup
from surgsim_env.tasks.visibility import Disc

InfoValue = bool | float | str


@dataclass(frozen=True, eq=False)
class Scenario:
    """Organ and instrument of a task's episodes.

    Fields:
        anatomy: of the scene with its instrument, motion and level
        instrument: of the scene, acting on the organ
        level: of the lesions; None for the scene's own
        family: members that episodes draw from; None for a scene of one organ
        scene: as named, before instrument, motion and level
    """

    anatomy: Anatomy
    instrument: Instrument | None = None
    level: Level | None = None
    family: OrganFamily | None = None
    scene: Scene | None = None


@dataclass(frozen=True)
class Pictured:
    """Additions to the pictures of an episode: a disc, and the pose of its endoscope; None: none, the scene's."""

    target: Disc | None = None
    endoscope: Endoscope | None = None


class Task:
    """One episode after another on one anatomy; it reads the simulation and never advances it.

    A subclass declares `channels` and `rewards` (and `commands`, where the tip's velocity is not all) and draws an
    episode in `draw`. Bounds, named slices, observations, weighted rewards, saved states, documentation and the
    environment's arguments follow from the declaration (`surgsim_env.tasks.runtime`); arguments of its own are
    keyword-only parameters of `__init__`. A method `oracle(simulation)` may return the script that solves an episode.

    Class attributes:
        commands, channels, rewards: the declaration
        setup: scene, instrument, level, lesions and length of an episode
        kept: names of the attributes that a saved state holds beside the organ, the sensors and the count of steps

    Attributes:
        anatomy, limits: of the scene; of a family the member that the episode plays
        level: of the lesions; None for the scene's own
        drawn: the organ of the episode; None before the first
        lesions: of the episode; none before the first
        sensed: last readings of the channels with a sensor, by name [N, N m]
        taxel_shape: shape of the taxels' forces (`Simulation.taxels`), of 0 numbers without taxels
        step_count: control steps of the episode so far
        episode_steps: control steps until an episode is truncated; None where the task ends it by itself
    """

    commands: ClassVar[tuple[Command, ...]] = (
        Command("velocity", 3, SPEED_FULL_SCALE, "m/s", "tip velocity along x, y, z"),
    )
    channels: ClassVar[tuple[Channel, ...]] = ()
    rewards: ClassVar[tuple[Reward, ...]] = ()
    setup: ClassVar[Setup] = Setup()
    kept: ClassVar[tuple[str, ...]] = ()
    # Of the class `setup.drawn`.
    drawn: Any

    def __init_subclass__(cls, **arguments: Any) -> None:
        """Check the names of a declaration.

        Raises:
            ValueError: two commands, channels or rewards of one name.
        """
        super().__init_subclass__(**arguments)
        for part in ("commands", "channels", "rewards"):
            names = [entry.name for entry in getattr(cls, part)]
            if len(set(names)) < len(names):
                raise ValueError(f"{cls.__name__}.{part} are {', '.join(names)}; give each its own name")

    def __init__(self, scenario: Scenario) -> None:
        """Take the organ and the instrument of the episodes."""
        self.anatomy = scenario.anatomy
        self.limits = scenario.anatomy.scene.limits
        self.level = scenario.level
        self.drawn = None
        self.lesions: tuple[Lesion, ...] = ()
        self.sensed: dict[str, NDArray[np.float64]] = {
            channel.name: np.zeros(3) for channel in self.channels if channel.sensor
        }
        self.taxel_shape = NO_TAXELS if scenario.instrument is None else scenario.instrument.taxel_shape
        self.step_count = 0
        self.episode_steps = self.setup.episode_steps

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw an episode beside its organ; returns the tip's position [m] outside it, (3,), of two arms (2, 3).

        `anatomy`, `drawn` and `lesions` are those of the episode.
        """
        raise NotImplementedError(f"{type(self).__name__} must define draw(rng): it returns the tip's position [m]")

    def accepts(self, simulation: Simulation) -> bool:
        """True if the episode may begin as drawn, the simulation at rest; else another one is drawn."""
        return True

    def command(self, commands: dict[str, FloatArray], instrument: Instrument) -> None:
        """Give the instrument the commands of a control step: values in SI units, by name."""
        instrument.command_velocity(commands["velocity"])

    def update(self, step: ControlStep) -> None:
        """Take in the reset and each control step without a fault, before channels and rewards are read."""

    def end(self, step: ControlStep) -> str:
        """Reason of the episode's end in this control step; "" while it goes on. Called once for each.

        It is the name of a declared reward of success or failure, which is then paid, or "fault", "hard_force",
        "damage", "success" or "done", which need none. Failures are "fault", "hard_force", "damage" and the declared
        ones.
        """
        if step.fault:
            return "fault"
        return "hard_force" if step.force_peak > self.limits.hard_force else ""

    def info(self, step: ControlStep | None, end: str) -> dict[str, InfoValue]:
        """The task's entries of `info` after a control step, or (None, "") after a reset: the same keys and types.

        `success` and `is_success` follow from the declaration: True in an end named "success" or as a declared one.
        """
        peak = 0.0 if step is None else step.force_peak
        return {
            "force_peak": peak,
            "cost": 0.0 if step is None else max(self.limits.excess(peak), 0.0),
            "hard_limit": end == "hard_force",
        }

    @property
    def pictured(self) -> Pictured:
        """Additions to the pictures of this episode."""
        return Pictured()
