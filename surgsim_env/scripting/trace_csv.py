"""A trace as two tables: haptic rate and control rate; the same trace gives the same bytes."""

import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgsim_env.scripting.trace import Trace

POSE_COLUMNS = ("tip_x_m", "tip_y_m", "tip_z_m", "tip_qw", "tip_qx", "tip_qy", "tip_qz")
WRENCH_COLUMNS = ("force_x_N", "force_y_N", "force_z_N", "torque_x_Nm", "torque_y_Nm", "torque_z_Nm")


def write_csv(trace: Trace, path: Path) -> tuple[Path, Path]:
    """Write both tables of a trace; returns where they are.

    Raises:
        ValueError: the path does not end in ".csv".
    """
    if path.suffix != ".csv":
        raise ValueError(f'{str(path)!r} does not end in ".csv"; a second table is written beside it: name it run.csv')
    beside = path.with_name(f"{path.stem}_control.csv")
    _write(path, haptic_columns(trace), haptic_rows(trace))
    _write(beside, control_columns(trace), control_rows(trace))
    return path, beside


def haptic_columns(trace: Trace) -> list[str]:
    """Time, step, pose, depth, size of the total force, and a wrench for each tool."""
    wrenches = [f"{tool}_{column}" for tool in trace.tool_names for column in WRENCH_COLUMNS]
    return ["time_s", "step", *POSE_COLUMNS, "depth_m", "force_size_N", *wrenches]


def haptic_rows(trace: Trace) -> Iterable[list]:
    """One row a haptic step."""
    names, sizes = trace.step_names(trace.haptic_time), trace.force_size.tolist()
    for row, time in enumerate(trace.haptic_time.tolist()):
        pose = [*trace.tip_position[row].tolist(), *trace.tip_orientation[row].tolist()]
        yield [time, names[row], *pose, float(trace.depth[row]), sizes[row], *trace.wrench[row].ravel().tolist()]


def control_columns(trace: Trace) -> list[str]:
    """Time, step, each entry of observation (none of a picture) and action, reward, the info's entries by name."""
    observation = [f"observation_{index}" for index in range(_numbers(trace).shape[1])]
    action = [f"action_{index}" for index in range(trace.action.shape[1])]
    return ["time_s", "step", *observation, *action, "reward", *sorted(trace.info)]


def control_rows(trace: Trace) -> Iterable[list]:
    """One row a control step."""
    names, keys, numbers = trace.step_names(trace.control_time), sorted(trace.info), _numbers(trace)
    for row, time in enumerate(trace.control_time.tolist()):
        info = [trace.infos[row].get(key, "") for key in keys]
        yield [
            time,
            names[row],
            *numbers[row].tolist(),
            *trace.action[row].tolist(),
            float(trace.reward[row]),
            *info,
        ]


def _numbers(trace: Trace) -> NDArray[np.floating]:
    """Observations (m, n_obs); (m, 0) where they are pictures."""
    return trace.observation if trace.observation.ndim == 2 else np.zeros((len(trace.observation), 0))


def _write(path: Path, columns: list[str], rows: Iterable[list]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)
