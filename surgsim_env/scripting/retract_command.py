"""`surgsim retract`: an oracle script retracts a lobe; its forces, pictures and measures are written."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from surgsim_env.out_folder import writable_folder
from surgsim_env.rendering.gl import NoGLError
from surgsim_env.scripting.oracle import oracle_script
from surgsim_env.scripting.run import ScriptError, run_script
from surgsim_env.scripting.trace import Trace
from surgsim_env.surgical_env import SurgicalEnv

TRACE_NAME, PLOT_NAME, PICTURE_NAME, SUMMARY_NAME = "trace.csv", "forces.png", "retraction.png", "summary.json"
# Seen in the picture before and after.
VIEWS = ("overview", "endoscope")


@dataclass(frozen=True)
class Request:
    """What is asked for: a scene, an instrument (the scene's own if None), whether two arms, a seed, a folder."""

    scene: str
    instrument: str | None
    bimanual: bool
    seed: int
    out: Path


def retract(request: Request, console: Console) -> bool:
    """Run one scripted retraction, print how it went and write its files; whether it succeeded.

    Raises:
        ValueError: one line about what is asked for and cannot be.
    """
    if request.seed < 0:
        raise ValueError(f"--seed is {request.seed}; it must be a whole number of at least 0")
    if request.bimanual and request.instrument is not None:
        raise ValueError("--instrument: a bimanual retraction has the two arms of its scene; leave one of both out")
    env_id = "SurgSim/BimanualRetract-v0" if request.bimanual else "SurgSim/Retract-v0"
    settings: dict[str, Any] = {} if request.instrument is None else {"instrument": request.instrument}
    env = gym.make(env_id, scene=request.scene, **settings)
    folder = writable_folder(request.out, (TRACE_NAME, PLOT_NAME, PICTURE_NAME, SUMMARY_NAME))
    env.reset(seed=request.seed)
    before = _pictures(env, console)
    try:
        trace = run_script(env, oracle_script(env))
    except ScriptError as error:
        trace = error.trace
    written = [path.name for path in trace.to_csv(folder / TRACE_NAME)] + [PLOT_NAME, SUMMARY_NAME]
    trace.plot(folder / PLOT_NAME)
    if before is not None:
        _write_picture(folder / PICTURE_NAME, before, _pictures(env, console))
        written.append(PICTURE_NAME)
    summary = _summary(trace, env_id, request)
    (folder / SUMMARY_NAME).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    env.close()
    success = bool(summary["success"])
    console.print(_verdict(trace, success), highlight=False)
    console.print(f"written: {folder}/{{{','.join(written)}}}", highlight=False, soft_wrap=True)
    return success


def _pictures(env: gym.Env, console: Console) -> NDArray[np.uint8] | None:
    """The views beside each other, None where this machine cannot draw (which is said)."""
    inner = env.unwrapped
    assert isinstance(inner, SurgicalEnv)
    try:
        return np.concatenate([inner.renderer.rgb(view) for view in VIEWS], axis=1)
    except NoGLError as error:
        console.print(f"no pictures: {error}", highlight=False)
        return None


def _write_picture(path: Path, before: NDArray[np.uint8], after: NDArray[np.uint8] | None) -> None:
    from PIL import Image

    rows = [before] if after is None else [before, after]
    Image.fromarray(np.concatenate(rows, axis=0)).save(path)


def _summary(trace: Trace, env_id: str, request: Request) -> dict[str, Any]:
    """The last info of the episode with what ran, as JSON holds it."""
    info = {name: value for name, value in trace.info.items() if not name.startswith("reward_")}
    ran = {"environment": env_id, "scene": request.scene, "instrument": request.instrument, "seed": request.seed}
    steps = [{"name": step.name, "start": step.start, "end": step.end} for step in trace.steps]
    return {
        **ran,
        "duration": trace.duration,
        "return": float(trace.reward.sum()),
        "failure": trace.failure,
        "steps": steps,
        **info,
    }


def _verdict(trace: Trace, success: bool) -> str:
    info = trace.info
    if not success:
        return f"not retracted: {trace.failure or 'the time was up'}"
    return (
        f"retracted in {trace.duration:.1f} s: {100.0 * info.get('uncovered', info['visible']):.0f} % of the target "
        f"{'left uncovered' if 'uncovered' in info else 'seen'}, grip up to "
        f"{info['grip_force_peak']:.2f} N, pull up to {info['pull_force_peak']:.2f} N, {info['slips']:.0f} slips"
    )
