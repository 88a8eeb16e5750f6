"""Scripted episodes of two arms: the left one lifts a lobe, the right one touches what lies under it.

The oracle script runs them; each is reported in figures, with their medians and in words what was run.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from surgsim_env.arm_study.results import Tell
from surgsim_env.envs.surgical_env import SurgicalEnv
from surgsim_env.instruments.arm.arm import Arm
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP
from surgsim_env.rendering.gl import NoGLError
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import PAIRS, Port
from surgsim_env.scripting.oracle import oracle_script
from surgsim_env.scripting.run import ScriptError, run_script
from surgsim_env.scripting.trace import Trace

ENV_ID, SCENE = "SurgSim/BimanualRetract-v0", "lobe"
# Arms that replace those that cannot do the task.
LEFT, RIGHT = PAIRS["psm_pair"]
# Cameras whose pictures show the end of an episode, side by side.
VIEWS = ("overview", "endoscope")
# Larger distances between the arms are not measured [m].
DISTANCE_MOST = 0.05


@dataclass(frozen=True)
class ArmsEpisode:
    """One episode of an oracle script; NaN where nothing was measured.

    Fields:
        seed: of the environment
        success: whether the task succeeded
        duration: from the reset to its end [s]
        grip_peak, grip_mean: of the weaker pad's force on the tissue [N]; the mean while it held
        pull_peak: largest pull of the left jaw in any haptic step [N]
        touch_force: of the right tip on what lies under the lobe, at the end [N]
        arm_distance: smallest distance between the arms at the end of any control step [m], at most 0.05
        collision_peak: largest force between the arms at the end of any control step [N]
        slips: number of times that the hold began to slip or was lost
        failure: "" or which step of the script failed, why, and the state then
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
        """Why it failed, without the step's arguments and the position of the tip."""
        return re.split(r": [A-Z]\w*\(|; tip at ", self.failure)[0]


class StandIn(NamedTuple):
    """An arm that replaces a given one: its side, its name, the given arm, and what that one lacks."""

    side: str
    arm: str
    given: str
    lacks: str


@dataclass(frozen=True)
class Episodes:
    """Scripted episodes with their scene, arms and ports.

    Fields:
        scene: the lobe's scene
        left, right: names of the arms that were used
        ports: where these entered, the left one's first
        stand_ins: arms that replace given ones
        left_out: why no episode was run; "" where some were
        runs: the episodes
        pictures: RGB images (height, width, 3) uint8 of the end of an episode, by caption
    """

    scene: str
    left: str
    right: str
    ports: tuple[Port, ...]
    stand_ins: tuple[StandIn, ...] = ()
    left_out: str = ""
    runs: tuple[ArmsEpisode, ...] = ()
    pictures: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)


class Measure(NamedTuple):
    """A column of the table: a field of ArmsEpisode, its heading, the scale from SI, digits, and its definition."""

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


MEASURES = (
    Measure("success_time", "time to success [s]", 1.0, 2,
            "Simulated time from the reset to the success: for 0.5 s the left jaw holds, the lobe leaves 80 % of the "
            "target uncovered, the right tip presses it with 0.3 to 1 N."),
    Measure("grip_peak", "peak grip [N]", 1.0, 2, "Largest normal force of the weaker of the two pads on the lobe."),
    Measure("grip_mean", "mean grip [N]", 1.0, 2, "Its mean over the control steps in which the jaw held the lobe."),
    Measure("pull_peak", "peak pull [N]", 1.0, 2,
            "Largest force of both fingers together on the lobe, in any millisecond."),
    Measure("touch_force", "touch at the end [N]", 1.0, 2,
            "Force between the right arm and what lies under the lobe, when the episode ends."),
    Measure("arm_distance", "least distance of the arms [mm]", 1e3, 1,
            "Smallest distance between the two arms' outer shapes at the end of any control step; distances beyond "
            "50 mm are not measured."),
    Measure("collision_peak", "peak force between the arms [N]", 1.0, 2,
            "Largest force with which the arms press each other, at the end of any control step; above 2 N the episode "
            "is over."),
    Measure("slips", "slips", 1.0, 0, "How often the held lobe began to slip between the pads, or was lost."),
)  # fmt: skip


def median_of(runs: Sequence[ArmsEpisode], measure: Measure) -> float:
    """The median of a figure over the episodes that have it; NaN where none has."""
    values = np.array([getattr(one, measure.field) for one in runs], dtype=np.float64)
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def clause(episodes: Episodes | None) -> str:
    """The episodes in a sentence for a report's first paragraph; "" where none were run."""
    if episodes is None or not episodes.runs:
        return ""
    runs = episodes.runs
    count, time = sum(one.success for one in runs), median_of(runs, MEASURES[0])
    took = f" in {time:.1f} s (median)" if count else ""
    return (
        f"Run by a script on the scene {episodes.scene} and its own ports, {episodes.left} lifts a lobe and "
        f"{episodes.right} touches what lies under it in {count} of {len(runs)} episodes{took}."
    )


def what_was_run(episodes: Episodes, organ: str) -> list[str]:
    """In paragraphs: arms, scene and ports of the episodes, and how they relate to the patient's organ."""
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
        "and times are those of a lobe, not of this organ."
        if organ != episodes.scene
        else f"The ports are the scene's own two, at {places}, not those above.",
    ]


def plain_episodes(episodes: Episodes | None) -> dict[str, Any]:
    """Entries of summary.json: `episodes`, a table each in SI units, and `episodes_of`, scene, arms and ports."""
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
        "medians": {one.field: median_of(episodes.runs, one) for one in MEASURES},
    }
    rows = [{**asdict(one), "success_time": one.success_time} for one in episodes.runs]
    return {"episodes": rows, "episodes_of": ran}


def run_episodes(sources: tuple[str, str], arms: tuple[Arm, Arm], seeds: range, tell: Tell) -> Episodes:
    """Run an episode for each seed with both arms; a PSM replaces an arm that cannot do the task.

    Args:
        sources: the left and the right arm's name or TOML file.
        arms: these arms.
        seeds: of the episodes.
        tell: called with the current work, and with the reason if there are no pictures.
    """
    left, right = (arm.description.name for arm in arms)
    able = [str(Path(source).resolve()) if Path(source).suffix == ".toml" else source for source in sources]
    stand_ins = []
    if not has_pads(arms[0]):
        stand_ins.append(StandIn("left", LEFT, left, "jaw with flat pads to hold tissue with"))
        able[0], left = LEFT, LEFT
    if arms[1].description.tip.ball is None:
        stand_ins.append(StandIn("right", RIGHT, right, "ball at its tip to touch with"))
        able[1], right = RIGHT, RIGHT
    ran = Episodes(SCENE, left, right, make_scene(SCENE).ports, tuple(stand_ins))
    try:
        env = gym.make(ENV_ID, scene=SCENE, instrument="+".join(able), scaled=False)
    except ValueError as error:
        return replace(ran, left_out=" ".join(str(error).split()))
    runs, pictures = [], {}
    for number, seed in enumerate(seeds):
        tell(f"episode {number + 1} of {len(seeds)}", number / len(seeds))
        runs.append(run_episode(env, seed))
        if number == 0:
            how = "in success" if runs[0].success else "without success"
            inner = env.unwrapped
            assert isinstance(inner, SurgicalEnv)
            try:
                views = np.concatenate([inner.renderer.rgb(view) for view in VIEWS], axis=1)
                pictures = {f"How the episode of seed {seed} ended: {how}": views}
            except NoGLError as error:
                tell(f"no picture of an episode: {error}", 0.0)
    env.close()
    tell("episodes done", 1.0)
    return replace(ran, runs=tuple(runs), pictures=pictures)


def run_episode(env: gym.Env, seed: int) -> ArmsEpisode:
    """Run one episode of the oracle script; the same seed gives the same numbers."""
    try:
        env.reset(seed=seed)
    except ValueError as error:
        return ArmsEpisode(seed, False, failure=f"it could not begin: {error}")
    try:
        trace = run_script(env, oracle_script(env))
    except ScriptError as error:
        trace = error.trace
    return measured(trace, seed, env.unwrapped.observation_slices["arm_distance"])  # type: ignore[attr-defined]


def measured(trace: Trace, seed: int, distance: slice) -> ArmsEpisode:
    """The figures of an episode that a script ran from its reset; `distance` is the arms' in its observations."""
    info = trace.info
    success = bool(info.get("success"))
    if not info:
        return ArmsEpisode(seed, success, failure=trace.failure or "the script did nothing")
    return ArmsEpisode(
        seed=seed,
        success=success,
        duration=trace.duration,
        grip_peak=info["grip_force_peak"],
        grip_mean=info["grip_force_mean"],
        pull_peak=info["pull_force_peak"],
        touch_force=info["touch_force"],
        arm_distance=float(trace.observation[:, distance].min()),
        collision_peak=max(one["collision_force"] for one in trace.infos),
        slips=info["slips"],
        failure="" if success else trace.failure or "the script ended without success",
    )


def has_pads(arm: Arm) -> bool:
    """Whether an arm's jaw has two fingers with flat pads: boxes that are in contact with tissue."""
    model = arm.model
    bodies = [int(model.jnt_bodyid[model.joint(name).id]) for name in arm.description.jaw]
    box = (model.geom_type == int(mujoco.mjtGeom.mjGEOM_BOX)) & (model.geom_group == CONTACT_GROUP)
    return len(bodies) == 2 and all(bool(box[model.geom_bodyid == body].any()) for body in bodies)
