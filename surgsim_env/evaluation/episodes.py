"""Episodes of two arms run by the oracle script: the left one lifts a lobe, the right one touches what lay under it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from surgsim_env.arms.arm import Arm
from surgsim_env.evaluation.episode_figures import Episode, Episodes, StandIn
from surgsim_env.rendering.gl import NoGLError
from surgsim_env.scenes import PAIRS, make_scene
from surgsim_env.scripting.oracle import oracle_script
from surgsim_env.scripting.run import ScriptError, run_script
from surgsim_env.scripting.trace import Trace
from surgsim_env.surgical_env import SurgicalEnv
from surgsim_env.tool_bodies import CONTACT_GROUP

ENV_ID, SCENE = "SurgSim/BimanualRetract-v0", "lobe"
# Arms in place of those that cannot do the task.
LEFT, RIGHT = PAIRS["psm_pair"]
# Seen in the picture of an episode's end, beside each other.
VIEWS = ("overview", "endoscope")
# Where the environment's observation has the arms' distance.
DISTANCE_PLACE = -1

# Called with what is being done and the share of the whole that is done.
Progress = Callable[[str, float], None]


def run_episodes(sources: tuple[str, str], arms: tuple[Arm, Arm], seeds: range, tell: Progress) -> Episodes:
    """Run an episode for each seed with both arms, or with PSMs in the place of those that cannot do the task.

    Args:
        sources: the left and the right arm's name or TOML file.
        arms: what these are.
        seeds: of the episodes.
        tell: told what is being done, and why there are no pictures where there is no OpenGL.
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
        env = gym.make(ENV_ID, scene=SCENE, instrument="+".join(able))
    except ValueError as error:
        return replace(ran, left_out=" ".join(str(error).split()))
    runs, pictures = [], {}
    for number, seed in enumerate(seeds):
        tell(f"episode {number + 1} of {len(seeds)}", number / len(seeds))
        runs.append(run_episode(env, seed))
        if number == 0:
            how = "in success" if runs[0].success else "without success"
            pictures = _picture(env, f"How the episode of seed {seed} ended: {how}", tell)
    env.close()
    tell("episodes done", 1.0)
    return replace(ran, runs=tuple(runs), pictures=pictures)


def run_episode(env: gym.Env, seed: int) -> Episode:
    """One episode of the oracle script; the same seed gives the same numbers."""
    try:
        env.reset(seed=seed)
    except ValueError as error:
        return Episode(seed, False, failure=f"it could not begin: {error}")
    try:
        trace = run_script(env, oracle_script(env))
    except ScriptError as error:
        trace = error.trace
    return measured(trace, seed)


def measured(trace: Trace, seed: int) -> Episode:
    """The figures of an episode that a script ran from its reset."""
    info = trace.info
    success = bool(info.get("success"))
    if not info:
        return Episode(seed, success, failure=trace.failure or "the script did nothing")
    return Episode(
        seed=seed,
        success=success,
        duration=trace.duration,
        grip_peak=info["grip_force_peak"],
        grip_mean=info["grip_force_mean"],
        pull_peak=info["pull_force_peak"],
        touch_force=info["touch_force"],
        arm_distance=float(trace.observation[:, DISTANCE_PLACE].min()),
        collision_peak=max(one["collision_force"] for one in trace.infos),
        slips=info["slips"],
        failure="" if success else trace.failure or "the script came to its end without success",
    )


def has_pads(arm: Arm) -> bool:
    """Whether an arm's jaw has two fingers with flat pads: boxes that tissue feels."""
    model = arm.model
    bodies = [int(model.jnt_bodyid[model.joint(name).id]) for name in arm.description.jaw]
    box = (model.geom_type == int(mujoco.mjtGeom.mjGEOM_BOX)) & (model.geom_group == CONTACT_GROUP)
    return len(bodies) == 2 and all(bool(box[model.geom_bodyid == body].any()) for body in bodies)


def _picture(env: gym.Env, caption: str, tell: Progress) -> dict[str, NDArray[np.uint8]]:
    """The views of this moment beside each other by their caption; none where there is no OpenGL."""
    inner = env.unwrapped
    assert isinstance(inner, SurgicalEnv)
    try:
        return {caption: np.concatenate([inner.renderer.rgb(view) for view in VIEWS], axis=1)}
    except NoGLError as error:
        tell(f"no picture of an episode: {error}", 0.0)
        return {}
