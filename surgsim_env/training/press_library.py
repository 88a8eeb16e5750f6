"""A library of presses: organs drawn as SurgSim/PalpateSites-v0 draws them, each pressed at every site of a grid.

Hours of simulation, done once (`agents/make_press_library.py`); training then looks presses up (`PressLibraryEnv`):
task, sensor, estimator and rewards are the environment's own code. A stopped run continues where it ended, and a
library can be used while it grows; press_library_sample.npz beside this file is a small one. Scores are computed on the
environment itself, never on the library.
"""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.lane_group import LaneGroup
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.palpation.chart import Site, charted_face, healthy_map, interpolated
from surgsim_env.palpation.press import PressResult, SitePress, press_in_lanes, press_phases
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.levels import DrawnOrgan, find_level
from surgsim_env.scene.load import make_scene
from surgsim_env.tasks.palpate_sites import PalpateSitesTask

# Organ k of a library is drawn from this seed plus k; the benchmark's evaluation seeds begin at 1 000 000.
FIRST_SEED = 3_000_000
# Organs that are pressed side by side.
LANES = 16
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
            f"{path} is not a library of presses ({error}): make one with python -m agents.make_press_library"
        ) from None


# ---- making one -----------------------------------------------------------------------------------------------------


def press_organs(anatomy: Anatomy, drawn: list[DrawnOrgan], group: LaneGroup) -> FloatArray:
    """Press organs side by side at every site; shape (n_organ, n, n, 5). No more organs than the group has lanes.

    Raises:
        RuntimeError: a press ended in a fault (says where).
    """
    charted, phases = charted_face(anatomy), press_phases(anatomy.scene)
    side = charted.chart.side_count
    simulations = group.simulations[: len(drawn)]
    kept = np.zeros((len(drawn), side * side, len(KEPT)))
    for simulation, organ in zip(simulations, drawn, strict=True):
        simulation.reset(organ.compiled(anatomy), simulation.instrument.parked)
    for number, place in enumerate(charted.chart.sites):
        site = charted.site(place)
        presses = [SitePress(simulation, site.point, site.normal) for simulation in simulations]
        press_in_lanes(group, [*presses, *[None] * (len(group.simulations) - len(presses))], phases)
        for index, press in enumerate(presses):
            result = press.result()
            if result.fault:
                raise RuntimeError(f"organ {drawn[index].to_json()}, site {number}: {result.fault}")
            force = float(result.force @ site.normal)
            kept[index, number] = force, result.depth, result.force_peak, result.stopped, result.duration
    return kept.reshape(len(drawn), side, side, len(KEPT))


def make_library(
    path: Path, scene: str, level: str, organ_count: int, *, dtype: type = np.float32, lanes: int = LANES
) -> PressLibrary:
    """Press organs in batches until a library has `organ_count`; each batch is saved when it is complete.

    In float32 forces are within 0.5 % of the environment's, a tenth of the sensor's noise; a batch has `lanes` organs.

    Raises:
        ValueError: the file at `path` is of another scene or level.
    """
    chosen, plain = find_level(level), make_scene(scene)
    healthy_map(plain)
    anatomy = load_anatomy(chosen.scene(plain))
    side = charted_face(anatomy).chart.side_count
    library = PressLibrary(scene, level, (), np.zeros((0, side, side, len(KEPT))))
    if path.exists():
        library = load_library(path)
        if (library.scene, library.level) != (scene, level):
            raise ValueError(
                f"{path} holds presses of scene {library.scene!r}, level {library.level!r}, not of {scene!r}, "
                f"{level!r}: give another --out"
            )
    group = LaneGroup([Simulation(anatomy) for _ in range(lanes)], dtype, lanes)
    start, before = time.monotonic(), len(library.organs)
    while (done := len(library.organs)) < organ_count:
        numbers = range(done, min(done + lanes, organ_count))
        drawn = [chosen.draw(anatomy, np.random.default_rng(FIRST_SEED + number)) for number in numbers]
        presses = np.concatenate([library.presses, press_organs(anatomy, drawn, group)])
        library = PressLibrary(scene, level, (*library.organs, *[organ.to_json() for organ in drawn]), presses)
        library.save(path)
        spent, made = time.monotonic() - start, len(library.organs) - before
        left = spent / made * (organ_count - len(library.organs))
        print(f"{len(library.organs)} of {organ_count} organs, {spent:.0f} s, {left:.0f} s to go", flush=True)
    return library


# ---- learning on one -------------------------------------------------------------------------------------------------


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
        low, high = (side.astype(np.float32) for side in self.task.bounds(None))
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
            saturated, self.task.info(None, ""), dict.fromkeys(self.task.weights, 0.0)
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
