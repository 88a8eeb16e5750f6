"""Record of a run: forces and poses at haptic rate, observations at control rate, steps; tables and plot."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import matmul
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.envs.surgical_env import Observation
from surgsim_env.scripting.observations import selected_observations

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class StepInterval:
    """Time of a step of the script since the episode's reset [s]: after `start`, up to and with `end`."""

    name: str
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class Trace:
    """Record of a script's run.

    Fields:
        start: its beginning since the episode's reset [s], as all times here
        haptic_time: end of each haptic step [s]                                                          (n,)
        wrench: tissue's mean force [N], torque about the centre of mass [N m] on each tool               (n, n_tool, 6)
        taxels: force on each taxel, `Simulation.taxels` [N]                            (n, n_patch, rows, columns, 3)
        tip_position: centre of the tip ball [m]                                                          (n, 3)
        tip_orientation: unit quaternion (w, x, y, z), the tip's axes in the world                        (n, 4)
        depth: of the tip past the beginning of the current contact, along the approach [m]; 0 without contact  (n,)
        control_time: end of each control step [s]                                                        (m,)
        observation, action, reward: after, in and for each control step                    (m, n_obs), (m, n_act), (m,)
            dictionary observations give a dictionary of arrays (m, ...)
        infos: of each control step
        steps: intervals of the script's steps
        tool_names: of the bodies in contact with tissue
        terminated, truncated: True if the episode ended with the run
        failure: "", or the failed step, the reason and the state of the run
    """

    start: float
    haptic_time: FloatArray
    wrench: FloatArray
    taxels: FloatArray
    tip_position: FloatArray
    tip_orientation: FloatArray
    depth: FloatArray
    control_time: FloatArray
    observation: Observation
    action: NDArray[np.floating]
    reward: FloatArray
    infos: tuple[dict[str, Any], ...]
    steps: tuple[StepInterval, ...]
    tool_names: tuple[str, ...]
    terminated: bool
    truncated: bool
    failure: str

    @property
    def force(self) -> FloatArray:
        """Sum of the tissue's force over all tools at each haptic step [N], shape (n, 3)."""
        return self.wrench[:, :, :3].sum(axis=1)

    @property
    def force_size(self) -> FloatArray:
        """Size of `force` [N], shape (n,)."""
        return np.sqrt(np.square(self.force).sum(axis=1))

    @property
    def peak_force(self) -> float:
        """Largest contact force of any haptic step [N]; 0 without one."""
        return float(self.force_size.max(initial=0.0))

    @property
    def duration(self) -> float:
        """Simulated time of the run [s]."""
        return float(self.haptic_time[-1] - self.start) if len(self.haptic_time) else 0.0

    @property
    def info(self) -> dict[str, Any]:
        """Info of the last control step; empty if there was none."""
        return self.infos[-1] if self.infos else {}

    def between(self, first: str, last: str | None = None) -> Trace:
        """Part of the run from step `first` to the end of step `last` (or of the same), by their names.

        Raises:
            ValueError: no step has that name (lists the names).
        """
        begin, end = self._index(first), self._index(first if last is None else last)
        start, stop = self.steps[begin].start, self.steps[end].end
        haptic, control = _within(self.haptic_time, start, stop), _within(self.control_time, start, stop)
        at_haptic_rate = ("haptic_time", "wrench", "taxels", "tip_position", "tip_orientation", "depth")
        at_control_rate = ("control_time", "observation", "action", "reward", "infos")
        return replace(
            self,
            start=start,
            **{name: getattr(self, name)[haptic] for name in at_haptic_rate},
            **{name: selected_observations(getattr(self, name), control) for name in at_control_rate},
            steps=self.steps[begin : end + 1],
        )

    def to_csv(self, path: str | Path) -> tuple[Path, Path]:
        """Write haptic rate to `path`, control rate beside it (`run.csv`, `run_control.csv`); return both paths.

        Columns name their units; numbers are written exactly.
        """
        path = Path(path)
        beside = path.with_name(f"{path.stem}_control.csv")
        _write(path, _haptic_rows(self))
        _write(beside, _control_rows(self))
        return path, beside

    def plot(self, path: str | Path) -> None:
        """Plot force and depth over time, with the steps marked, in a picture file."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(10.0, 5.6), dpi=110, facecolor="white", layout="constrained")
        _draw(self, *figure.subplots(2, 1, sharex=True, height_ratios=(1.25, 1.0)))
        figure.savefig(path)

    def step_names(self, times: FloatArray) -> list[str]:
        """Name of the script's step at each time [s]."""
        ends = np.array([step.end for step in self.steps])
        return [self.steps[index].name for index in np.searchsorted(ends, times - 1e-9)]

    def _index(self, name: str) -> int:
        names = [step.name for step in self.steps]
        if name not in names:
            raise ValueError(f"no step {name!r} was run; the steps are {', '.join(map(repr, names)) or 'none'}")
        return names.index(name)


def contact_depth(wrench: FloatArray, tip_position: FloatArray, approach: FloatArray) -> FloatArray:
    """Depth of the tip past the beginning of the current contact, along the approach [m]; 0 without contact, (n,).

    Args:
        wrench: on each tool at each haptic step [N, N m], shape (n, n_tool, 6).
        tip_position: [m], shape (n, 3).
        approach: unit vector, shape (3,).
    """
    touching = np.asarray(wrench.any(axis=(1, 2)))
    along = matmul(tip_position, approach)
    starts = touching & ~np.concatenate([[False], touching[:-1]])
    origin = np.maximum.accumulate(np.where(starts, np.arange(len(along)), 0))
    return np.where(touching, along - along[origin], 0.0)


def _within(times: FloatArray, start: float, stop: float) -> slice:
    """Slice of the increasing times [s] after `start` and not after `stop`, to rounding."""
    return slice(int(np.searchsorted(times, start + 1e-9)), int(np.searchsorted(times, stop + 1e-9)))


# ---- tables --------------------------------------------------------------------------------------------------------

POSE_COLUMNS = ("tip_x_m", "tip_y_m", "tip_z_m", "tip_qw", "tip_qx", "tip_qy", "tip_qz")
TAXEL_AXES = ("along_row", "along_column", "normal")
WRENCH_COLUMNS = ("force_x_N", "force_y_N", "force_z_N", "torque_x_Nm", "torque_y_Nm", "torque_z_Nm")


def _haptic_rows(trace: Trace) -> Iterator[list]:
    """Names of the columns, then a row for each haptic step."""
    wrenches = [f"{tool}_{column}" for tool in trace.tool_names for column in WRENCH_COLUMNS]
    taxels = [
        f"taxel_{'_'.join(map(str, place))}_{axis}_N"
        for place in np.ndindex(trace.taxels.shape[1:4])
        for axis in TAXEL_AXES
    ]
    yield ["time_s", "step", *POSE_COLUMNS, "depth_m", "force_size_N", *wrenches, *taxels]
    names, sizes = trace.step_names(trace.haptic_time), trace.force_size.tolist()
    for row, time in enumerate(trace.haptic_time.tolist()):
        pose = [*trace.tip_position[row].tolist(), *trace.tip_orientation[row].tolist()]
        forces = [*trace.wrench[row].ravel().tolist(), *trace.taxels[row].ravel().tolist()]
        yield [time, names[row], *pose, float(trace.depth[row]), sizes[row], *forces]


def _control_rows(trace: Trace) -> Iterator[list]:
    """Names of the columns, then a row for each control step; pictures are left out."""
    observed = trace.observation if isinstance(trace.observation, dict) else {"": trace.observation}
    parts = {"observation" + f"_{name}" * bool(name): part for name, part in observed.items() if part.ndim == 2}
    parts["action"] = trace.action
    entries = [f"{part}_{index}" for part, values in parts.items() for index in range(values.shape[1])]
    names, keys = trace.step_names(trace.control_time), sorted(trace.info)
    yield ["time_s", "step", *entries, "reward", *keys]
    for row, time in enumerate(trace.control_time.tolist()):
        values = [*(value for part in parts.values() for value in part[row].tolist()), float(trace.reward[row])]
        yield [time, names[row], *values, *(trace.infos[row].get(key, "") for key in keys)]


def _write(path: Path, rows: Iterator[list]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


# ---- picture -------------------------------------------------------------------------------------------------------

FORCE, DEPTH, INK, BAND = "#b5322a", "#2b5f8a", "#20242c", "#eef1f5"
# Share of the run's time below which a step's name is turned.
NARROW = 0.12


def _draw(trace: Trace, force: Axes, below: Axes) -> None:
    """Plot forces [N] above, depth [mm] or the visible share [%] of a retraction's target below; steps as bands."""
    if "visible" in trace.info:
        ends = trace.control_time
        _draw_retraction(trace, force, below)
    else:
        ends = trace.haptic_time
        force.plot(trace.haptic_time, trace.force_size, color=FORCE, linewidth=1.3)
        force.set_ylabel("contact force [N]")
        force.set_ylim(0.0, max(1.15 * trace.peak_force, 0.01))
        below.plot(trace.haptic_time, trace.depth * 1e3, color=DEPTH, linewidth=1.3)
        below.axhline(0.0, color=INK, linewidth=0.6, linestyle=":")
        below.set_ylabel("depth past contact [mm]")
    below.set_xlabel("time since the reset [s]")
    if len(ends):
        below.set_xlim(trace.start, float(ends[-1]))
    _mark_steps(trace, force, below)
    if trace.failure:
        force.set_xlabel(trace.failure, color=FORCE, fontsize=8, wrap=True)


def _draw_retraction(trace: Trace, force: Axes, seen: Axes) -> None:
    """Plot the jaw's grip and pull [N], and the visible share of the target [%]."""
    grip, pull, share = (
        np.array([info[name] for info in trace.infos]) for name in ("grip_force", "pull_force", "visible")
    )
    force.plot(trace.control_time, grip, color=DEPTH, linewidth=1.3, label="grip, the weaker pad")
    force.plot(trace.control_time, pull, color=FORCE, linewidth=1.3, label="pull")
    force.set_ylabel("force [N]")
    force.set_ylim(0.0, 1.15 * max(float(grip.max()), float(pull.max()), 0.01))
    force.legend(loc="upper left", frameon=False)
    seen.plot(trace.control_time, 100.0 * share, color=INK, linewidth=1.3)
    seen.set_ylabel("target seen [%]")
    seen.set_ylim(-3.0, 103.0)


def _mark_steps(trace: Trace, force: Axes, depth: Axes) -> None:
    for index, step in enumerate(trace.steps):
        for axes in (force, depth):
            axes.axvspan(step.start, step.end, facecolor=BAND if index % 2 else "white", edgecolor="none", zorder=0)
        narrow = step.end - step.start < NARROW * trace.duration
        force.annotate(
            step.name,
            ((step.start + step.end) / 2.0, 1.0),
            xycoords=force.get_xaxis_transform(),
            xytext=(0.0, 4.0),
            textcoords="offset points",
            rotation=60.0 if narrow else 0.0,
            rotation_mode="anchor",
            horizontalalignment="left" if narrow else "center",
            verticalalignment="bottom",
            color=INK,
            fontsize=9,
            annotation_clip=False,
        )
