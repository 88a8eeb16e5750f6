"""Recorded faces for the surrogate of SurgSim/PalpateSites-v0: contrasts of presses in real episodes.

Organs, of a family each of another shape, are drawn by the environment and pressed once at every other row and column
of their touch maps (`agents/record_faces.py`); between these sites contrasts are interpolated. Scores are computed on
the environment itself, never on a recording.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

from msdm_core.mesh import FloatArray
from msdm_core.mesh_files import checked_content
from surgsim_apps.training.site_surrogate import SurrogateFace
from surgsim_env.coupling import ForceReading
from surgsim_env.palpation import LESIONS_MOST, MAP_SIDE, ORGAN_MAP_SPREAD, LesionEstimator, TouchMap, interpolated
from surgsim_env.tasks import PalpateSitesTask

# Episode k of a recording is reset with this seed plus k; the benchmark's evaluation seeds are others.
FIRST_SEED = 6_000_000
# Organs side by side.
LANES = 16
# Step between pressed rows and columns of the touch map.
SITE_STEP = 2
# Sites of the recorded surface on each side of the chart.
SURFACE_SIDE = 49
# Pressed sites for an interpolated contrast, and the smoothing of the cubic spline.
NEIGHBOURS, SMOOTHING = 30, 1e-4


@dataclass(frozen=True, eq=False)
class RecordedFaces:
    """Faces of organs; called with a generator, it draws one of them.

    Fields:
        extent: of the charts [m]                                                               (n_face, 2)
        cell: of the touch maps [m]                                                             (n_face,)
        pressable: mask of the touch maps' pressable sites                                      (n_face, n n)
        log_contrast: at these sites, without the sensor's noise; 0 elsewhere                   (n_face, n n)
        surface: points of the face over a square grid of the chart [m]                         (n_face, m, m, 3)
        truth: points of the face nearest to the lesions [m], filled up with NaN                (n_face, k, 3)
        tip_radius, lesion_radius: [m]                                                          (n_face,)
        noise, map_spread: of the estimator                                                     (n_face,)
    """

    extent: FloatArray
    cell: FloatArray
    pressable: NDArray[np.bool_]
    log_contrast: FloatArray
    surface: FloatArray
    truth: FloatArray
    tip_radius: FloatArray
    lesion_radius: FloatArray
    noise: FloatArray
    map_spread: FloatArray

    def __len__(self) -> int:
        """Number of faces."""
        return len(self.extent)

    def __call__(self, rng: np.random.Generator) -> SurrogateFace:
        """Draw a face."""
        return self.faces[int(rng.integers(len(self)))]

    @cached_property
    def faces(self) -> list[SurrogateFace]:
        """All faces."""
        return [self._face(number) for number in range(len(self))]

    def _face(self, number: int) -> SurrogateFace:
        tip, extent, truth = float(self.tip_radius[number]), self.extent[number], self.truth[number]
        return SurrogateFace(
            TouchMap(extent / tip, float(self.cell[number]) / tip, self.pressable[number]),
            tip,
            LesionEstimator(
                extent,
                lesion_radius=float(self.lesion_radius[number]),
                noise=float(self.noise[number]),
                map_spread=float(self.map_spread[number]),
            ),
            self.log_contrast[number],
            truth[np.isfinite(truth).all(axis=1)],
            partial(_on_surface, self.surface[number], extent),
        )

    def save(self, path: Path) -> None:
        """Write the recording, numbers in single precision."""
        path.parent.mkdir(parents=True, exist_ok=True)
        values = {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}
        single = {
            name: value.astype(np.float32) if value.dtype == np.float64 else value for name, value in values.items()
        }
        np.savez_compressed(path, **single)


def _on_surface(surface: FloatArray, extent: FloatArray, points: FloatArray) -> FloatArray:
    """Points of the surface [m] (k, 3) at places [m] (k, 2), lengths along the chart's sides."""
    return interpolated(surface, 2.0 * points / extent - 1.0)


def load_faces(path: str | Path) -> RecordedFaces:
    """Read a recording of `agents.record_faces`."""
    with np.load(checked_content(Path(path)), allow_pickle=False) as file:
        arrays = {field.name: file[field.name] for field in fields(RecordedFaces)}
    return RecordedFaces(
        **{name: value.astype(np.float64) if value.dtype == np.float32 else value for name, value in arrays.items()}
    )


# ---- recording -------------------------------------------------------------------------------------------------------


def record_faces(
    scene: str, split: str | None, level: str, count: int, progress: Callable[[int], object] = lambda done: None
) -> RecordedFaces:
    """Record `count` faces at least, in batches of LANES.

    Args:
        scene: by name or path.
        split: of a family; the environment's own if None.
        level: of difficulty.
        count: of faces.
        progress: called with the number of faces after each batch.

    Raises:
        ValueError: a split for a scene without a family.
        RuntimeError: a press with a fault or beyond the hard limit (names the seed and the site).
    """
    # The budget ends no episode before all sites were pressed.
    settings: dict[str, Any] = {"scene": scene, "level": level, "budget": MAP_SIDE**2}
    envs = gym.make_vec(
        "SurgSim/PalpateSites-v0", num_envs=LANES, vectorization_mode="vector_entry_point", autoreset_mode="Disabled",
        dtype="float32", **(settings | ({"split": split} if split else {})),
    )  # fmt: skip
    faces: list[dict[str, Any]] = []
    while len(faces) < count:
        faces += _record_batch(envs, [FIRST_SEED + len(faces) + lane for lane in range(LANES)])
        progress(len(faces))
    envs.close()
    return RecordedFaces(**{name: np.stack([face[name] for face in faces]) for name in faces[0]})


def _record_batch(envs: gym.vector.VectorEnv, seeds: list[int]) -> list[dict[str, Any]]:
    """The arrays of `RecordedFaces` for one episode of each environment."""
    lanes: Any = envs.unwrapped
    envs.reset(seed=seeds)  # type: ignore[arg-type]
    tasks: list[PalpateSitesTask] = [env.unwrapped.task for env in lanes.envs]
    readings = [task.reading for task in tasks]
    todo = []
    for task in tasks:
        # Contrast without the sensor; the estimator keeps its noise.
        ideal = replace(task.reading.sensor, noise=0.0, bias=0.0, drift=0.0, hysteresis=0.0)
        task.reading = ForceReading(ideal)
        pressed = ((task.charted.touch_map.numbers - MAP_SIDE // 2) % SITE_STEP == 0).all(axis=1)
        todo.append(np.flatnonzero(task.charted.touch_map.pressable & pressed))
    for press in range(max(map(len, todo))):
        over = np.array([press >= len(sites) for sites in todo])
        actions = [
            task.charted.touch_map.places[sites[min(press, len(sites) - 1)]]
            for task, sites in zip(tasks, todo, strict=True)
        ]
        lanes.pause(over)
        _, _, terminated, _, infos = envs.step(np.clip(actions, -1.0, 1.0).astype(np.float32))
        if terminated.any():
            lane = int(np.argmax(terminated))
            raise RuntimeError(
                f"episode {seeds[lane]}, site {todo[lane][press]}: the press ended it, by a fault "
                f"({infos['sim_fault'][lane]!r}) or the hard limit; record a scene whose presses end in neither"
            )
    # The next reset draws from the scene's sensor.
    for task, reading in zip(tasks, readings, strict=True):
        task.reading = reading
    return [_recorded(task) for task in tasks]


def _recorded(task: PalpateSitesTask) -> dict[str, Any]:
    charted, touch_map = task.charted, task.charted.touch_map
    contrast = np.zeros(MAP_SIDE**2)
    spline = RBFInterpolator(
        task.felt.places / charted.tip_radius, task.felt.log_contrasts, kernel="cubic", neighbors=NEIGHBOURS,
        smoothing=SMOOTHING,
    )  # fmt: skip
    contrast[touch_map.pressable] = spline(touch_map.sites[touch_map.pressable] / charted.tip_radius)
    axis = np.linspace(-1.0, 1.0, SURFACE_SIDE)
    truth = np.full((LESIONS_MOST, 3), np.nan)
    truth[: len(task.truth)] = task.truth
    return {
        "extent": touch_map.extent,
        "cell": np.float64(touch_map.cell),
        "pressable": touch_map.pressable,
        "log_contrast": contrast,
        "surface": charted.surface(np.stack(np.meshgrid(axis, axis), axis=-1)),
        "truth": truth,
        "tip_radius": np.float64(charted.tip_radius),
        "lesion_radius": np.float64(task.estimator.lesion_radius),
        "noise": np.float64(task.estimator.noise),
        "map_spread": np.float64(0.0 if task.anatomy.scene.mesh.block is not None else ORGAN_MAP_SPREAD),
    }
