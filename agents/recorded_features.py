"""What a data set holds of each moment of an environment, in SI units: state, action, wrench on the tip, pictures."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from agents.lerobot_format import Feature
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.envs.palpate_sites_env import PalpateSitesEnv
from surgsim_env.instruments.arm.pair import SIDES, Pair

Reading = Callable[[gym.Env], NDArray]

STATE, WRENCH, PICTURES = "observation.state", "observation.meta.force_torque", "observation.images."
WRENCH_NAMES = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")
WORLD = "world: the scene's axes, fixed to the patient's table"


def tip_wrench(simulation: Simulation) -> NDArray[np.float32]:
    """Force of the tissue on the instrument [N] and its torque about the tip [N m], on the world's axes, shape (6,).

    It is the simulation's own, the mean of the last haptic step on all tools of the instrument, without the errors of a
    force sensor: force sum_i F_i, torque sum_i (T_i + (c_i - tip) x F_i), where the tools' torques T_i are about their
    centres of mass c_i. Two arms have 12 numbers, the left arm's first.
    """
    instrument = simulation.instrument
    if isinstance(instrument, Pair):
        arms = [(instrument.tools_of(side), instrument.arms[side].tip_position) for side in SIDES]
    else:
        arms = [(np.arange(instrument.tool_count), instrument.tip_position)]
    wrench, centre = simulation.contact_wrench, instrument.shapes.tool_centre
    parts = []
    for tools, tip in arms:
        forces = wrench[tools, :3]
        torque = (wrench[tools, 3:] + np.cross(centre[tools] - tip, forces)).sum(axis=0)
        parts += [forces.sum(axis=0), torque]
    return np.concatenate(parts).astype(np.float32)


def readings(cameras: Sequence[str] = ()) -> dict[str, Reading]:
    """Functions of an environment that read what a data set holds of a moment beside the observation, by feature."""
    return {
        STATE: lambda env: env.unwrapped.task_observation,  # type: ignore[attr-defined]
        WRENCH: lambda env: tip_wrench(env.unwrapped.simulation),  # type: ignore[attr-defined]
        **{
            PICTURES + camera: lambda env, camera=camera: env.unwrapped.renderer.rgb(camera)  # type: ignore[attr-defined]
            for camera in cameras
        },
    }


def features(env: gym.Env, cameras: Sequence[str] = (), *, width: int = 0, height: int = 0) -> list[Feature]:
    """The features of a data set of an environment, with units, frames and meanings.

    Args:
        env: one of this project, wrapped or not.
        cameras: whose pictures it holds.
        width, height: of the pictures [pixels].

    Raises:
        ValueError: an environment whose steps do not last one control step.
    """
    inner: Any = env.unwrapped
    task, simulation = inner.task, inner.simulation
    if isinstance(inner, PalpateSitesEnv):
        raise ValueError(
            f"a step of {type(inner).__name__} is a whole press, and frames of a data set are one control step apart: "
            "record SurgSim/Palpate-v0"
        )
    channels = {channel.name: channel for channel in task.channels}
    shown = task.observation_slices
    state = [(name, channels[name]) for name, part in shown.items() for _ in range(part.start, part.stop)]
    commands = {command.name: command for command in task.commands}
    moves = [commands[name] for name, part in task.action_slices.items() for _ in range(part.start, part.stop)]
    origin, scale = task.scales(simulation.instrument)
    arms = SIDES if isinstance(simulation.instrument, Pair) else ("",)
    wrench = tuple(f"{side}_{name}" if side else name for side in arms for name in WRENCH_NAMES)
    rotated = getattr(task, "frame", None) is not None
    return [
        Feature(
            "action", "float32", inner.action_space.shape,
            tuple(_numbered(task.action_slices)),
            {
                "units": "share of the full command, from -1 to 1, as env.step takes it",
                "full_command": [command.scale for command in moves],
                "full_command_units": [command.unit for command in moves],
                "frame": "the axes of the palpable face" if rotated else WORLD,
                "meaning": _meanings(commands, task.action_slices),
            },
        ),
        Feature(
            STATE, "float32", (len(state),),
            tuple(_numbered(shown)),
            {
                "units": [channel.unit for _, channel in state],
                "frame": f"{WORLD}; where a meaning says so, the axes of the palpable face",
                "meaning": _meanings(channels, shown),
                "observed_as": "(value - origin) / scale is what the environment observes with scaled=True",
                "origin": origin.tolist(),
                "scale": scale.tolist(),
            },
        ),
        Feature(
            WRENCH, "float32", (len(wrench),), wrench,
            {
                "sensor": "none: the simulation's own, without bias, noise and range",
                "units": ["N", "N", "N", "N m", "N m", "N m"] * len(arms),
                "frame": f"{WORLD}; torque about the tip",
                "meaning": "of the tissue on the instrument, mean of the last haptic step",
            },
        ),
        *(
            Feature(
                PICTURES + camera, "video", (height, width, 3), ("height", "width", "channels"),
                {
                    "video.height": height, "video.width": width, "video.channels": 3,
                    "video.codec": "h264", "video.pix_fmt": "yuv420p", "video.fps": inner.metadata["render_fps"],
                    "video.is_depth_map": False, "has_audio": False,
                },
            )
            for camera in cameras
        ),
        Feature("next.reward", "float32", (1,), info={"meaning": "reward of this step"}),
        Feature("next.done", "bool", (1,), info={"meaning": "this step is the last of the episode"}),
        Feature("next.success", "bool", (1,), info={"meaning": "the task is solved after this step"}),
    ]  # fmt: skip


def _numbered(slices: Mapping[str, slice]) -> list[str]:
    """Names of the entries: x, y, z of three."""
    named = []
    for name, part in slices.items():
        size = part.stop - part.start
        ends = [""] if size == 1 else ["_x", "_y", "_z"] if size == 3 else [f"_{index}" for index in range(size)]
        named += [name + end for end in ends]
    return named


def _meanings(parts: Mapping[str, Any], slices: Mapping[str, slice]) -> str:
    return "; ".join(f"{name}: {parts[name].meaning}" for name in slices)
