"""The `[retract]` table of a scene: what an episode of retraction draws."""

import math
from dataclasses import dataclass

Vector = tuple[float, float, float]
Range = tuple[float, float]


@dataclass(frozen=True)
class RetractionCamera:
    """How far the endoscope of an episode may stand from the scene's, and how far it may be turned.

    Args:
        shift: it is moved evenly within a ball of this radius [m].
        turn_deg: its view is turned by up to this angle [degrees], about an axis across it.
    """

    shift: float = 0.0
    turn_deg: float = 0.0

    def __post_init__(self) -> None:
        for name in ("shift", "turn_deg"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"retract.camera.{name} is {value:g}; it must be finite and at least 0")


@dataclass(frozen=True)
class Flap:
    """The part of an organ that is lifted, where that is not the whole of it: corners of its box [m]."""

    lower: Vector
    upper: Vector

    def __post_init__(self) -> None:
        for low, high, axis in zip(self.lower, self.upper, "xyz"):
            if not -math.inf < low < high < math.inf:
                raise ValueError(f"retract.flap: it reaches from {axis} = {low:g} to {high:g} m; give low < high")


@dataclass(frozen=True)
class Retraction:
    """What a retraction draws anew in each episode: the lobe, what it hides, the tip's place.

    The lobe is a block with x along its anchored edge, y from that edge (y = 0) to the free one, and z up; it lies on a
    bed whose top is z = 0. Of an organ of another shape the same is said of its `flap`, and the organ is as it is: its
    scale and its held share are 1.

    Args:
        target_distance: range of the target's distance from the anchored edge, along y [m].
        target_along: range of its place along the edge, x [m].
        start_lower, start_upper: corners of the box in which the tip starts [m].
        target_radius: of the disc to be seen [m].
        scale: range of the factor on the whole lobe, its thickness included (cells stay cubic).
        youngs_modulus: range [Pa].
        capsule_share: share of the episodes in which the lobe has a capsule.
        capsule_stiffness: range of that capsule's modulus times thickness [N/m].
        held_share: range of the share of the anchored edge, about its middle, that is held.
        camera: how the endoscope moves.
        right_start_lower, right_start_upper: corners of the box in which the right one of two tips starts [m].
        flap: which part of the organ is lifted; None: all of it.
    """

    target_distance: Range
    target_along: Range
    start_lower: Vector
    start_upper: Vector
    target_radius: float = 0.008
    scale: Range = (1.0, 1.0)
    youngs_modulus: Range = (5000.0, 5000.0)
    capsule_share: float = 0.0
    capsule_stiffness: Range = (1.0, 1.0)
    held_share: Range = (1.0, 1.0)
    camera: RetractionCamera = RetractionCamera()
    right_start_lower: Vector | None = None
    right_start_upper: Vector | None = None
    flap: Flap | None = None

    def __post_init__(self) -> None:
        for name in ("target_distance", "target_along", "scale", "youngs_modulus", "capsule_stiffness", "held_share"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high < math.inf:
                raise ValueError(f"retract.{name} = [{low:g}, {high:g}]; the rule is 0 < low <= high, finite")
        if self.held_share[1] > 1.0:
            raise ValueError(f"retract.held_share = {list(self.held_share)}; no more than 1 can be held")
        if self.flap is not None and (self.scale != (1.0, 1.0) or self.held_share != (1.0, 1.0)):
            raise ValueError(
                f"retract: scale {list(self.scale)} and held_share {list(self.held_share)} go with a whole lobe; with "
                "retract.flap both are [1, 1]"
            )
        if not 0.0 < self.target_radius < math.inf:
            raise ValueError(f"retract.target_radius is {self.target_radius:g} m; it must be finite and above 0")
        if not 0.0 <= self.capsule_share <= 1.0:
            raise ValueError(f"retract.capsule_share is {self.capsule_share:g}; it must be from 0 to 1")
        for lower, upper in (
            (self.start_lower, self.start_upper),
            (self.right_start_lower or (), self.right_start_upper or ()),
        ):
            for low, high, axis in zip(lower, upper, "xyz"):
                if not -math.inf < low <= high < math.inf:
                    raise ValueError(f"retract: the tip starts from {axis} = {low:g} to {high:g} m; give low <= high")
