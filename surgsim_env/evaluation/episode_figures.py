"""Scripted episodes of two arms in figures: what is told of each, the medians, and in words what was run."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgsim_env.arms.port import Port

# Farther than this the arms' distance is not looked at [m].
DISTANCE_MOST = 0.05


@dataclass(frozen=True)
class Episode:
    """One episode of an oracle script; NaN where nothing was measured.

    Fields:
        seed: of the environment
        success: whether it came to its success
        duration: from the reset to its end [s]
        grip_peak, grip_mean: of the weaker pad's force on the tissue [N]; the mean while it held
        pull_peak: largest pull of the left jaw in any haptic step [N]
        touch_force: of the right tip on what lies under the lobe, at the end [N]
        arm_distance: smallest distance between the arms at the end of any control step [m], at most 0.05
        collision_peak: largest force between the arms at the end of any control step [N]
        slips: how often the hold began to slip, or was lost
        failure: "" or which step of the script failed, why, and what was reached
    """

    seed: int
    success: bool
    duration: float = math.nan
    grip_peak: float = math.nan
    grip_mean: float = math.nan
    pull_peak: float = math.nan
    touch_force: float = math.nan
    arm_distance: float = math.nan
    collision_peak: float = math.nan
    slips: float = math.nan
    failure: str = ""

    @property
    def success_time(self) -> float:
        """From the reset to the success [s]; NaN without one."""
        return self.duration if self.success else math.nan

    @property
    def reason(self) -> str:
        """Why it failed, without what the step was asked and where the tip was."""
        return re.split(r": [A-Z]\w*\(|; tip at ", self.failure)[0]


class StandIn(NamedTuple):
    """An arm in the place of one that was given: on which side, for which, and what that one lacks."""

    side: str
    arm: str
    given: str
    lacks: str


@dataclass(frozen=True)
class Episodes:
    """Scripted episodes and what they were run with.

    Fields:
        scene: the lobe's scene
        left, right: names of the arms that were used
        ports: where these entered, the left one's first
        stand_ins: arms in the place of those that were given
        left_out: why no episode was run; "" where some were
        runs: the episodes
        pictures: RGB images (height, width, 3) uint8 of how an episode ended, by caption
    """

    scene: str
    left: str
    right: str
    ports: tuple[Port, ...]
    stand_ins: tuple[StandIn, ...] = ()
    left_out: str = ""
    runs: tuple[Episode, ...] = ()
    pictures: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)


class Figure(NamedTuple):
    """A column of the table: a field of Episode, its heading, the scale from SI, digits, and what it means."""

    field: str
    title: str
    scale: float
    digits: int
    definition: str

    def text(self, value: float) -> str:
        """A value in SI as the table shows it; a dash for NaN."""
        if not math.isfinite(value):
            return "–"
        shown = f"{value * self.scale:.{self.digits}f}"
        return f"≥{shown}" if self.field == "arm_distance" and value >= DISTANCE_MOST else shown


FIGURES = (
    Figure("success_time", "time to success [s]", 1.0, 2, "Simulated time from the reset to the success: for 0.5 s the "
           "left jaw holds, the lobe leaves 80 % of the target uncovered, the right tip presses it with 0.3 to 1 N."),
    Figure("grip_peak", "peak grip [N]", 1.0, 2, "Largest normal force of the weaker of the two pads on the lobe."),
    Figure("grip_mean", "mean grip [N]", 1.0, 2, "Its mean over the control steps in which the jaw held the lobe."),
    Figure("pull_peak", "peak pull [N]", 1.0, 2, "Largest force of both fingers together on the lobe, in any "
           "millisecond."),
    Figure("touch_force", "touch at the end [N]", 1.0, 2, "Force between the right arm and what lies under the lobe, "
           "when the episode ends."),
    Figure("arm_distance", "least distance of the arms [mm]", 1e3, 1, "Smallest distance between the two arms' outer "
           "shapes at the end of any control step; what is beyond 50 mm is not measured."),
    Figure("collision_peak", "peak force between the arms [N]", 1.0, 2, "Largest force with which the arms press each "
           "other, at the end of any control step; above 2 N the episode is over."),
    Figure("slips", "slips", 1.0, 0, "How often the held lobe began to slip between the pads, or was lost."),
)  # fmt: skip


def median_of(runs: Sequence[Episode], figure: Figure) -> float:
    """The median of a figure over the episodes that have it; NaN where none has."""
    values = np.array([getattr(one, figure.field) for one in runs], dtype=np.float64)
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def clause(episodes: Episodes | None, organ: str) -> str:
    """What a report's first paragraph says of the episodes; "" where none were run."""
    if episodes is None or not episodes.runs:
        return ""
    runs = episodes.runs
    count, time = sum(one.success for one in runs), median_of(runs, FIGURES[0])
    pulls = [one.pull_peak for one in runs if math.isfinite(one.pull_peak)]
    others = ["this organ"] if episodes.scene != organ else []
    others += ["these ports", *(f"this {one.side} arm" for one in episodes.stand_ins)]
    not_these = others[0] if len(others) == 1 else f"{', '.join(others[:-1])} or {others[-1]}"
    took = f" in {time:.1f} s (median)" if count else ""
    pulled = f", with pulls up to {max(pulls):.2f} N" if pulls else ""
    return (
        f"Run by a script on the scene {episodes.scene} (not {not_these}), {episodes.left} lifts a lobe and "
        f"{episodes.right} touches what lies under it in {count} of {len(runs)} episodes{took}{pulled}."
    )


def what_was_run(episodes: Episodes, organ: str) -> list[str]:
    """In paragraphs: which arms, scene and ports, and what that says of the patient's organ."""
    instead = [
        f"{one.arm} takes the place of {one.given} on the {one.side}: the arm that was given has no {one.lacks}."
        for one in episodes.stand_ins
    ]
    if episodes.left_out:
        return [f"No episodes were run: {episodes.left_out}.", *instead]
    places = " and ".join(f"({', '.join(f'{1e3 * one:.0f}' for one in port.point)}) mm" for port in episodes.ports)
    seeds = [one.seed for one in episodes.runs]
    which = f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"
    return [
        *instead,
        f"A script that knows where everything is lifts a lobe of soft tissue with the left arm, {episodes.left}, and "
        f"touches with the right one, {episodes.right}, a target that lay hidden under it "
        f"(SurgSim/BimanualRetract-v0, {which}; each draws another lobe).",
        f"This is the scene {episodes.scene}, not {organ}, and its own two ports, at {places}, not those above: forces "
        "and times are of a lobe, and say nothing of this organ's reach."
        if organ != episodes.scene
        else f"The ports are the scene's own two, at {places}, not those above.",
    ]


def plain_episodes(episodes: Episodes | None) -> dict[str, Any]:
    """The entries of summary.json: `episodes`, a table each in SI units, and `episodes_of`, what they were run with."""
    if episodes is None:
        return {"episodes": [], "episodes_of": None}
    ran = {
        "environment": "SurgSim/BimanualRetract-v0",
        "scene": episodes.scene,
        "left": episodes.left,
        "right": episodes.right,
        "ports": [asdict(port) for port in episodes.ports],
        "stand_ins": [one._asdict() for one in episodes.stand_ins],
        "left_out": episodes.left_out,
        "successes": sum(one.success for one in episodes.runs),
        "medians": {one.field: median_of(episodes.runs, one) for one in FIGURES},
    }
    rows = [{**asdict(one), "success_time": one.success_time} for one in episodes.runs]
    return {"episodes": rows, "episodes_of": ran}
