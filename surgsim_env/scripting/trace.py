"""What came of a script: forces and poses at haptic rate, observations and rewards at control rate, the steps."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class StepInterval:
    """When a step of the script ran [s], since the episode's reset: after `start`, up to and with `end`."""

    name: str
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class Trace:
    """A run of a script; arrays cannot be written to.

    Fields:
        start: when it began [s] since the episode's reset, as all times here
        haptic_time: end of each haptic step [s]                                                          (n,)
        wrench: tissue's mean force [N], torque about the centre of mass [N m] on each tool               (n, n_tool, 6)
        tip_position: centre of the tip ball [m]                                                          (n, 3)
        tip_orientation: unit quaternion (w, x, y, z), the tip's axes in the world                        (n, 4)
        depth: how far the tip is past where the present contact began, along the approach [m]; 0 without contact  (n,)
        control_time: end of each control step [s]                                                        (m,)
        observation, action, reward: after, in and for each control step                    (m, n_obs), (m, n_act), (m,)
        infos: of each control step
        steps: when each step of the script ran
        tool_names: of the bodies that tissue feels
        terminated, truncated: whether the episode ended with the run
        failure: "" or which step failed, why, and what was reached
    """

    start: float
    haptic_time: FloatArray
    wrench: FloatArray
    tip_position: FloatArray
    tip_orientation: FloatArray
    depth: FloatArray
    control_time: FloatArray
    observation: NDArray[np.floating]
    action: NDArray[np.floating]
    reward: FloatArray
    infos: tuple[dict[str, Any], ...]
    steps: tuple[StepInterval, ...]
    tool_names: tuple[str, ...]
    terminated: bool
    truncated: bool
    failure: str

    def __post_init__(self) -> None:
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    @property
    def force(self) -> FloatArray:
        """Sum of the tissue's force over all tools at each haptic step [N], shape (n, 3)."""
        return self.wrench[:, :, :3].sum(axis=1)

    @property
    def force_size(self) -> FloatArray:
        """Size of `force` [N], shape (n,)."""
        return np.sqrt((self.force**2).sum(axis=1))

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
        """The info of the last control step; empty where there was none."""
        return self.infos[-1] if self.infos else {}

    def between(self, first: str, last: str | None = None) -> "Trace":
        """The part of the run from step `first` to the end of step `last` (or of the same), by their names.

        Raises:
            ValueError: no step has that name (says which there are), or `last` comes before `first`.
        """
        begin, end = self._index(first), self._index(first if last is None else last)
        if end < begin:
            raise ValueError(f"step {last!r} comes before {first!r}: swap them")
        start, stop = self.steps[begin].start, self.steps[end].end
        haptic, control = _within(self.haptic_time, start, stop), _within(self.control_time, start, stop)
        at_haptic_rate = ("haptic_time", "wrench", "tip_position", "tip_orientation", "depth")
        at_control_rate = ("control_time", "observation", "action", "reward", "infos")
        return replace(
            self,
            start=start,
            **{name: getattr(self, name)[haptic] for name in at_haptic_rate},
            **{name: getattr(self, name)[control] for name in at_control_rate},
            steps=self.steps[begin : end + 1],
        )

    def to_csv(self, path: str | Path) -> tuple[Path, Path]:
        """Write haptic rate to `path` and control rate beside it (`run.csv`, `run_control.csv`); both paths.

        Columns name their units; numbers are written in full, so that reading them gives the same bits.
        """
        from surgsim_env.scripting.trace_csv import write_csv

        return write_csv(self, Path(path))

    def plot(self, where: "str | Path | tuple[Axes, Axes]") -> None:
        """Draw force and depth over time, the steps marked: into a picture file, or into two axes of your own."""
        from surgsim_env.scripting.trace_plot import draw, write_picture

        if isinstance(where, str | Path):
            write_picture(self, Path(where))
        else:
            draw(self, *where)

    def step_names(self, times: FloatArray) -> list[str]:
        """The step of the script that each time [s] belongs to."""
        ends = np.array([step.end for step in self.steps])
        return [self.steps[index].name for index in np.searchsorted(ends, times - 1e-9)]

    def _index(self, name: str) -> int:
        names = [step.name for step in self.steps]
        if name not in names:
            raise ValueError(f"no step {name!r} was run; the steps are {', '.join(map(repr, names)) or 'none'}")
        return names.index(name)


def contact_depth(wrench: FloatArray, tip_position: FloatArray, approach: FloatArray) -> FloatArray:
    """How far the tip is past where the present contact began, along the approach [m]; 0 without contact, (n,).

    Args:
        wrench: on each tool at each haptic step [N, N m], shape (n, n_tool, 6).
        tip_position: [m], shape (n, 3).
        approach: unit vector, shape (3,).
    """
    touching = np.asarray(wrench.any(axis=(1, 2)))
    along = tip_position @ approach
    began = touching & ~np.concatenate([[False], touching[:-1]])
    origin = np.maximum.accumulate(np.where(began, np.arange(len(along)), 0))
    return np.where(touching, along - along[origin], 0.0)


def _within(times: FloatArray, start: float, stop: float) -> slice:
    """Which of the rising times [s] lie after start and not after stop, to rounding."""
    return slice(int(np.searchsorted(times, start + 1e-9)), int(np.searchsorted(times, stop + 1e-9)))
