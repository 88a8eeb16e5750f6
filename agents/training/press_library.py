"""A library of presses, and SurgSim/PalpateSites-v0 on it: presses are looked up instead of simulated.

`agents/press_library.py` makes libraries; `press_library_sample.npz` is a small one. Task, sensor, estimator and
rewards are the environment's own code.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.palpation.chart import Site, interpolated
from surgsim_env.palpation.healthy_map import healthy_map
from surgsim_env.palpation.press import PressResult
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.levels import DrawnOrgan, find_level
from surgsim_env.scene.load import make_scene
from surgsim_env.tasks.palpate_sites import PalpateSitesTask

# Numbers kept of a press, for each organ and site.
KEPT = ("force", "depth", "force_peak", "stopped", "duration")


@dataclass(frozen=True, eq=False)
class PressLibrary:
    """Presses of organs at all sites of a chart's grid.

    Fields:
        scene, level: of the organs
        organs: the drawn organs, as JSON                                                           (n_organ,)
        presses: force along the normal [N], depth [m], force_peak [N], stopped (0 or 1) and duration [s] of each
            press, sites row by row along the chart's second axis                                   (n_organ, n, n, 5)
    """

    scene: str
    level: str
    organs: tuple[str, ...]
    presses: FloatArray

    def save(self, path: Path) -> None:
        """Write the library atomically."""
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        np.savez_compressed(
            part, scene=self.scene, level=self.level, organs=np.array(self.organs),
            presses=self.presses.astype(np.float32),
        )  # fmt: skip
        os.replace(part, path)


def load_library(path: str | Path) -> PressLibrary:
    """Read a library.

    Raises:
        ValueError: a file that is not a library.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            organs = tuple(str(text) for text in file["organs"])
            presses = file["presses"].astype(np.float64)
            return PressLibrary(str(file["scene"]), str(file["level"]), organs, presses)
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(
            f"{path} is not a library of presses ({error}): make one with python -m agents.press_library"
        ) from None


class PressLibraryEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """SurgSim/PalpateSites-v0 with presses looked up in a library, bilinear between the sites of its grid.

    Each reset draws one of the library's organs; sensor noise and bias are drawn anew. `info` lacks the entries that
    need a simulation (`added_mass`, `workspace_limited`, `trocar_error_mm`).
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self, library: str | Path | PressLibrary, memory: bool = True, budget: int | None = None) -> None:
        """Use a library, given as such or as a path.

        Raises:
            ValueError: a file that is not a library, or a library without organs.
        """
        self.library = library if isinstance(library, PressLibrary) else load_library(library)
        if not self.library.organs:
            raise ValueError("the library holds no organ yet: wait for its first batch")
        level, scene = find_level(self.library.level), make_scene(self.library.scene)
        anatomy = load_anatomy(level.scene(scene))
        self.task = PalpateSitesTask(anatomy, level, healthy_map(scene), memory=memory, budget=budget)
        self.drawn = [DrawnOrgan.from_json(text, anatomy) for text in self.library.organs]
        self.truths = [organ.places(anatomy) for organ in self.drawn]
        bounds = self.task.bounds(None)
        low, high = bounds.low.astype(np.float32), bounds.high.astype(np.float32)
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.task.action_size,), dtype=np.float32)
        self.organ = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Draw an organ; `options={"organ": k}` selects number k.

        Raises:
            ValueError: another option, or an organ that is not in the library.
        """
        super().reset(seed=seed)
        drawn, asked = int(self.np_random.integers(len(self.drawn))), dict(options or {})
        self.organ = asked.pop("organ", drawn)
        if asked or self.organ not in range(len(self.drawn)):
            raise ValueError(
                f'reset options are {options}; the rule is {{"organ": k}} with k from 0 to {len(self.drawn) - 1}'
            )
        self.task.begin_episode(self.drawn[self.organ], self.np_random, self.truths[self.organ])
        values, saturated = self.task.observe(None, self.np_random)
        return values.astype(np.float32), self._info(
            saturated, self.task.blank_info(), dict.fromkeys(self.task.weights, 0.0)
        )

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Look up a press."""
        values = np.asarray(action, dtype=np.float64)
        self.task.begin(values)
        site = self.task.site(values)
        result = self.press(site)
        self.task.take(site, result)
        values, saturated = self.task.observe(None, self.np_random)
        verdict = self.task.judge(None, result.force_peak, "")
        info = self._info(saturated, verdict.info, verdict.rewards)
        return values.astype(np.float32), sum(verdict.rewards.values()), verdict.terminated, verdict.truncated, info

    def press(self, site: Site) -> PressResult:
        """The result of a press of this episode's organ at a site."""
        force, depth, peak, stopped, duration = interpolated(self.library.presses[self.organ], site.place).tolist()
        return PressResult(force * site.normal, depth, peak, stopped > 0.5, "", duration)

    @staticmethod
    def _info(saturated: bool, measures: dict[str, Any], rewards: dict[str, float]) -> dict[str, Any]:
        return {
            "sim_fault": "",
            "sensor_saturated": saturated,
            **measures,
            **{f"reward_{name}": value for name, value in rewards.items()},
        }
