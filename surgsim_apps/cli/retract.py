"""`surgsim retract`: a scripted retraction of a lobe, with trace, forces, pictures and summary."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from surgsim_apps.cli.values import AnyPath, MaybeText, SceneName
from surgsim_apps.reports.output_folder import output_folder
from surgsim_env.envs import SurgicalEnv
from surgsim_env.rendering import NoGLError
from surgsim_env.scripting import ScriptError, Trace, oracle_script, run_script

TRACE_NAME, PLOT_NAME, PICTURE_NAME, SUMMARY_NAME = "trace.csv", "forces.png", "retraction.png", "summary.json"
NAMES = (TRACE_NAME, PLOT_NAME, PICTURE_NAME, SUMMARY_NAME)
# Cameras of the picture.
VIEWS = ("overview", "endoscope")


@dataclass(frozen=True)
class Retract:
    """Run an oracle script: grasp a lobe and fold it back to expose a target; with two arms, touch the target.

    Writes trace.csv, trace_control.csv, forces.png, retraction.png (before and after) and summary.json. Exit status 1
    on failure.
    """

    scene: SceneName = "lobe"
    """A shipped scene (see `surgsim scenes`) or a scene file of your own (TOML)."""
    instrument: MaybeText = None
    """An arm with a jaw, such as psm_retractor, or a TOML file; default: the scene's own."""
    bimanual: bool = False
    """Two arms: the left one lifts the lobe, the right one reaches under it and touches the target."""
    seed: int = 0
    """Seed of the episode."""
    out: AnyPath = Path("runs/retract")
    """Folder for the results."""

    def run(self, console: Console) -> int:
        """Run one scripted retraction, print its result and write its files; 0 if it succeeded, 1 otherwise.

        Raises:
            ValueError: an impossible option, in one line.
        """
        from PIL import Image

        if self.seed < 0:
            raise ValueError(f"--seed is {self.seed}; it must be a whole number of at least 0")
        if self.bimanual and self.instrument is not None:
            raise ValueError("--instrument: a bimanual retraction has the two arms of its scene; give only one of both")
        env_id = "SurgSim/BimanualRetract-v0" if self.bimanual else "SurgSim/Retract-v0"
        settings: dict[str, Any] = {} if self.instrument is None else {"instrument": self.instrument}
        with output_folder(self.out, NAMES) as files:
            env = gym.make(env_id, scene=self.scene, **settings)
            env.reset(seed=self.seed)
            before = _pictures(env, console)
            try:
                trace = run_script(env, oracle_script(env))
            except ScriptError as error:
                trace = error.trace
            written = [path.name for path in trace.to_csv(files / TRACE_NAME)] + [PLOT_NAME, SUMMARY_NAME]
            trace.plot(files / PLOT_NAME)
            if before is not None:
                after = _pictures(env, console)
                rows = [before] if after is None else [before, after]
                Image.fromarray(np.concatenate(rows, axis=0)).save(files / PICTURE_NAME)
                written.append(PICTURE_NAME)
            ran = {"environment": env_id, "scene": self.scene, "instrument": self.instrument, "seed": self.seed}
            summary = {**ran, **_summary(trace)}
            (files / SUMMARY_NAME).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        env.close()
        success = bool(summary["success"])
        console.print(_verdict(trace, success), highlight=False)
        console.print(f"written: {files.path}/{{{','.join(written)}}}", highlight=False, soft_wrap=True)
        return 0 if success else 1


def _pictures(env: gym.Env, console: Console) -> NDArray[np.uint8] | None:
    """The views side by side; None, with a message, without OpenGL."""
    inner = env.unwrapped
    assert isinstance(inner, SurgicalEnv)
    try:
        return np.concatenate([inner.renderer.rgb(view) for view in VIEWS], axis=1)
    except NoGLError as error:
        console.print(f"no pictures: {error}", highlight=False)
        return None


def _summary(trace: Trace) -> dict[str, Any]:
    """The episode's duration, return and steps, and the last info, for JSON."""
    return {
        "duration": trace.duration,
        "return": float(trace.reward.sum()),
        "failure": trace.failure,
        "steps": [{"name": step.name, "start": step.start, "end": step.end} for step in trace.steps],
        **{name: value for name, value in trace.info.items() if not name.startswith("reward_")},
    }


def _verdict(trace: Trace, success: bool) -> str:
    info = trace.info
    if not success:
        return f"not retracted: {trace.failure or 'the episode ran out of time'}"
    return (
        f"retracted in {trace.duration:.1f} s: {100.0 * info.get('uncovered', info['visible']):.0f} % of the target "
        f"{'left uncovered' if 'uncovered' in info else 'seen'}, grip up to "
        f"{info['grip_force_peak']:.2f} N, pull up to {info['pull_force_peak']:.2f} N, {info['slips']:.0f} slips"
    )
