"""A surrogate of SurgSim/PalpateSites-v0 with tabulated contrasts of faces, drawn or recorded from organs.

Touch map, estimator, score and rewards of finding are the environment's; there are no forces.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from surgsim_apps.training.site_agent import OBSERVATION_SIZE, SLICES
from surgsim_env.palpation import FOUND_SHARE, MAP_SIDE, LesionEstimator, TouchMap, ospa, ospa_cutoff
from surgsim_env.scene import REFERENCE_TIP
from surgsim_env.tasks import BUDGET, BUDGET_WIDE, SUCCESS_ERROR, WIDE, PalpateSitesTask, reward_weights


@dataclass(frozen=True, eq=False)
class SurrogateFace:
    """The palpable face of one episode, with the contrast at each of its sites.

    Fields:
        map: its sites, lengths in tip radii
        tip_radius: [m]
        estimator: of the face, lengths in metres
        log_contrast: without the sensor's noise, at the map's sites                            (n n,)
        truth: the lesions [m]                                                                  (k, d)
        surface: from places [m] (j, 2), lengths along the chart's sides, to points [m] (j, d) like the lesions'
    """

    map: TouchMap
    tip_radius: float
    estimator: LesionEstimator
    log_contrast: NDArray[np.float64]
    truth: NDArray[np.float64]
    surface: Callable[[NDArray[np.float64]], NDArray[np.float64]]


class SiteSurrogate(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """SurgSim/PalpateSites-v0 with memory, without an organ; `info`: `error_mm` and `success`."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self, draw: Callable[[np.random.Generator], SurrogateFace]) -> None:
        """Draw the face of each episode with a function."""
        self.draw = draw
        self.observation_space = gym.spaces.Box(-100.0, 100.0, (OBSERVATION_SIZE,), dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Draw a face; no options are known."""
        super().reset(seed=seed)
        self.face = face = self.draw(self.np_random)
        self.cutoff = ospa_cutoff(face.tip_radius)
        self.budget = BUDGET_WIDE if face.map.extent.max() > WIDE else BUDGET
        self.sites: list[int] = []
        self.values: list[float] = []
        self.memory = np.zeros(OBSERVATION_SIZE, dtype=np.float32)
        self.memory[SLICES["face_map"]] = face.map.pressable
        self.memory[SLICES["map_cell"]] = face.map.cell
        self.memory[SLICES["chart_share"]] = face.map.extent / (face.map.cell * (MAP_SIDE - 1))
        self.memory[SLICES["contrast_noise"]] = face.estimator.noise
        self.memory[SLICES["excess_least"]] = face.estimator.excess_least
        self.memory[SLICES["lesion_radius"]] = face.estimator.lesion_radius / face.tip_radius
        self.memory[SLICES["presses_left"]] = 1.0
        self.error, self.found_share = self._judged()
        return self.memory.copy(), {"error_mm": 1000.0 * self.error}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Press at the pressable site of the map nearest to a place of the chart."""
        face = self.face
        asked = 0.5 * (np.asarray(action, dtype=np.float64) + 1.0) * face.map.extent
        squared = ((face.map.sites - asked) ** 2).sum(axis=1)
        site = int(np.argmin(np.where(face.map.pressable, squared, np.inf)))
        value = float(face.log_contrast[site] + self.np_random.normal(0.0, face.estimator.noise))
        self.sites.append(site)
        self.values.append(value)
        self.memory[SLICES["contrast_map"]][site], self.memory[SLICES["pressed_map"]][site] = value, 1.0
        self.memory[SLICES["presses_left"]] = 1.0 - len(self.sites) / self.budget
        share_before = self.found_share
        self.error, self.found_share = self._judged()
        weights = reward_weights(PalpateSitesTask)
        reward = weights["error"] * self.error / self.cutoff / self.budget
        reward += weights["found"] * (self.found_share - share_before)
        over = len(self.sites) >= self.budget
        success = over and self.error <= SUCCESS_ERROR * face.tip_radius / REFERENCE_TIP
        return self.memory.copy(), reward, over, False, {"error_mm": 1000.0 * self.error, "success": success}

    def _judged(self) -> tuple[float, float]:
        """Error of the estimate (OSPA) [m], and the share of lesions near an estimate."""
        face = self.face
        places = face.map.sites[self.sites] * face.tip_radius
        points = face.surface(face.estimator.estimate(places, np.array(self.values)).points)
        error = ospa(face.truth, points, self.cutoff)
        if len(face.truth) == 0:
            return error, float(len(points) == 0)
        distance = np.linalg.norm(face.truth[:, None] - points, axis=2)
        return error, float((distance <= FOUND_SHARE * self.cutoff).any(axis=1).mean())
