"""Episodes as a data set of LeRobot (format v3.0), written by LeRobot itself: states, actions, wrenches, pictures.

Beside LeRobot's files lies meta/surgsim.json: the origin of the episodes, and the seed of each.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from agents.envhub.env import NAMES, describe_task
from surgsim_apps.reports.output_folder import new_folder
from surgsim_env.envs import PalpateSitesEnv
from surgsim_env.instruments import SIDES, Pair

STATE, WRENCH = NAMES.values()
WRENCH_NAMES = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")
WORLD = "world: the scene's axes, fixed to the patient's table"
PROVENANCE = "meta/surgsim.json"


def write_dataset(
    folder: Path, env: gym.Env, episodes: Iterable[Any], *, cameras: list[str], recorded: Mapping[str, Any]
) -> LeRobotDataset:
    """Write episodes one by one as a data set in a new folder, which is removed after an error.

    Args:
        folder: a new one.
        env: of the episodes.
        episodes: of `agents.record_demonstrations.record` with the readings of `agents.envhub.env.observe`.
        cameras: of the pictures in the readings.
        recorded: origin of the episodes, for meta/surgsim.json.

    Raises:
        ValueError: an existing folder, or a broken number of frames a second.
    """
    if folder.exists():
        raise ValueError(f"{folder} is there already: name a new folder")
    inner: Any = env.unwrapped
    step = inner.scene.timing.control_step
    rate = round(1.0 / step)
    if abs(rate * step - 1.0) > 1e-9:
        raise ValueError(
            f"the control step of {inner.scene.name} is {step:g} s; a data set has a whole number of frames a second: "
            "set timing.haptic_steps_per_control of the scene, as to 50 for 20 frames a second"
        )
    # Pictures have a size from the first reset on.
    env.reset(seed=0)
    task, seeds = describe_task(env), []
    with new_folder(folder):
        dataset = LeRobotDataset.create(
            folder.name,
            rate,
            features(env, cameras),
            root=folder,
            robot_type=Path(inner.scene.instrument.model).stem,
        )
        for episode in episodes:
            for frame in _frames(episode):
                dataset.add_frame({**frame, "task": task})
            dataset.save_episode()
            seeds.append(episode.seed)
        dataset.finalize()
        (folder / PROVENANCE).write_text(json.dumps({**recorded, "seeds": seeds}, indent=1) + "\n", encoding="utf-8")
    return dataset


def _frames(episode: Any) -> Iterable[dict[str, Any]]:
    """The reading before each action and the reward after it."""
    for index, action in enumerate(episode.actions):
        seen = episode.readings[index]
        yield {
            "action": action,
            **{lerobot_name: seen[name] for name, lerobot_name in NAMES.items()},
            **{f"observation.images.{camera}": picture for camera, picture in seen.get("pixels", {}).items()},
            "next.reward": np.array([episode.rewards[index]], dtype=np.float32),
            "next.done": np.array([index + 1 == len(episode.actions)]),
            "next.success": np.array([bool(episode.infos[index + 1].get("success", False))]),
        }


def features(env: gym.Env, cameras: Iterable[str] = ()) -> dict[str, dict[str, Any]]:
    """The features of a data set of an environment, with units, frames and meanings.

    Raises:
        ValueError: an environment with longer steps than a control step.
    """
    inner: Any = env.unwrapped
    task, instrument = inner.task, inner.simulation.instrument
    if isinstance(inner, PalpateSitesEnv):
        raise ValueError(
            f"a step of {type(inner).__name__} is a whole press, and frames of a data set are one control step apart: "
            "record SurgSim/Palpate-v0"
        )
    channels = {channel.name: channel for channel in task.channels}
    commands = {command.name: command for command in task.commands}
    origin, scale = inner.layout.scales(instrument)
    arms = SIDES if isinstance(instrument, Pair) else ("",)
    state = _numbered(inner.layout.observation_slices)
    action = _numbered(inner.layout.action_slices)
    wrench = [f"{side}_{name}" if side else name for side in arms for name in WRENCH_NAMES]
    table = {
        "action": {
            **_numbers(list(action)),
            "units": "share of the full command, from -1 to 1, as env.step takes it",
            "full_command": [commands[name].scale for name in action.values()],
            "full_command_units": [commands[name].unit for name in action.values()],
            "frame": WORLD if getattr(task, "frame", None) is None else "the axes of the palpable face",
            "meaning": _meanings(commands, inner.layout.action_slices),
        },
        STATE: {
            **_numbers(list(state)),
            "units": [channels[name].unit for name in state.values()],
            "frame": f"{WORLD}; where a meaning says so, the axes of the palpable face",
            "meaning": _meanings(channels, inner.layout.observation_slices),
            "observed_as": "(value - origin) / scale is what the environment observes with scaled=True",
            "origin": origin.tolist(),
            "scale": scale.tolist(),
        },
        WRENCH: {
            **_numbers(wrench),
            "sensor": "none: the simulation's own, without bias, noise and range",
            "units": ["N", "N", "N", "N m", "N m", "N m"] * len(arms),
            "frame": f"{WORLD}; torque about the tip",
            "meaning": "of the tissue on the instrument, mean of the last haptic step",
        },
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None, "meaning": "reward of this step"},
        "next.done": {"dtype": "bool", "shape": (1,), "names": None, "meaning": "last step of the episode"},
        "next.success": {"dtype": "bool", "shape": (1,), "names": None, "meaning": "solved after this step"},
    }
    for camera in cameras:
        options = inner.renderer.options
        table[f"observation.images.{camera}"] = {
            "dtype": "video",
            "shape": (options.height, options.width, 3),
            "names": ["height", "width", "channels"],
        }
    return table


def _numbers(names: list[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (len(names),), "names": names}


def _numbered(slices: Mapping[str, slice]) -> dict[str, str]:
    """Names of the entries (x, y, z of three), each with the name of its part."""
    entries = {}
    for name, part in slices.items():
        size = part.stop - part.start
        ends = [""] if size == 1 else ["_x", "_y", "_z"] if size == 3 else [f"_{index}" for index in range(size)]
        entries |= {name + end: name for end in ends}
    return entries


def _meanings(parts: Mapping[str, Any], slices: Mapping[str, slice]) -> str:
    return "; ".join(f"{name}: {parts[name].meaning}" for name in slices)
