"""What the page may ask of the physics."""

from dataclasses import dataclass

from surgsim_env.live.organ_choice import OrganChoice


@dataclass(frozen=True)
class Pause:
    """Stand still, or go on."""

    on: bool


@dataclass(frozen=True)
class Reset:
    """The same organ at rest, tips parked."""


@dataclass(frozen=True)
class Change:
    """Another organ, at rest, tips parked."""

    choice: OrganChoice


@dataclass(frozen=True)
class Record:
    """Begin or end a recording."""

    on: bool


@dataclass(frozen=True)
class Replay:
    """Play what was recorded from its start, or stop that; `given`: it came from a file, so that it starts at rest."""

    on: bool
    given: bool = False


@dataclass(frozen=True)
class End:
    """End the process."""


Request = Pause | Reset | Change | Record | Replay | End
