"""Where a scene's organ is held: boxes, balls and beds whose nodes are fixed."""

from dataclasses import dataclass

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """An axis-aligned box: lower and upper corner [m]."""

    lower: Vector
    upper: Vector


@dataclass(frozen=True)
class Ball:
    """A ball: centre [m] and radius [m]."""

    centre: Vector
    radius: float


@dataclass(frozen=True)
class Bed:
    """What an organ lies on: the deepest share of it along a direction, such as 0.15 along the approach."""

    direction: Vector
    share: float

    def __post_init__(self) -> None:
        if not any(self.direction) or not 0.0 < self.share < 1.0:
            raise ValueError(f"bed: direction {self.direction}, share {self.share}; give a direction and 0 < share < 1")


@dataclass(frozen=True)
class Anchor:
    """Where something holds the organ: every node of its surface (or, for a box, every node) inside is fixed."""

    name: str
    box: Box | None = None
    ball: Ball | None = None
    bed: Bed | None = None

    def __post_init__(self) -> None:
        if sum(part is not None for part in (self.box, self.ball, self.bed)) != 1:
            raise ValueError(f"anchor {self.name!r}: give one of a box, a ball and a bed")
