"""Presets of a patient's motion, from the library in `scenes/motions`."""

import math
from dataclasses import dataclass, replace

import numpy as np

from msdm_core.arithmetic import matmul, norm
from surgsim_env.scene.load import file_names, fill, read_toml, require_known, scenes_folder
from surgsim_env.scene.model import CyclicMotion, Range, Scene, Vector

# Preset without motion.
STILL = "none"
# Smallest share of the approach across the patient's axis that defines the front.
ACROSS_LEAST = 0.1


@dataclass(frozen=True)
class PatientMotion:
    """Cyclic motion in the patient's directions.

    Args:
        name: as "breathing".
        caudal, anterior: displacement towards the feet and towards the front, of a cycle of size 1 [m].
        cranial_reach: length of the moving part from the organ's end nearest to the head [m]; infinite: all of it.
        period, rise, fall, size, variation, stops_in_apnoea: as of a `CyclicMotion`.
    """

    name: str
    caudal: float
    anterior: float
    period: Range
    rise: float
    fall: float
    size: Range = (1.0, 1.0)
    variation: float = 0.0
    cranial_reach: float = math.inf
    stops_in_apnoea: bool = False

    def within(self, scene: Scene) -> CyclicMotion:
        """Motion in the axes of a scene: `cranial` points to the head, the probe comes from the front.

        Only the part of the approach normal to `cranial` counts; a probe along the patient's axis defines no front, and
        the anterior part of the motion is left out.
        """
        cranial = np.array(scene.cranial) / norm(scene.cranial)
        approach = np.array(scene.instrument.approach) / norm(scene.instrument.approach)
        front = matmul(approach, cranial) * cranial - approach
        across = float(norm(front))
        front = front / across if across > ACROSS_LEAST else np.zeros(3)
        x, y, z = (self.anterior * front - self.caudal * cranial).tolist()
        return CyclicMotion(
            self.name,
            (x, y, z),
            self.period,
            self.rise,
            self.fall,
            self.size,
            self.variation,
            reach=self.cranial_reach,
            side=_vector(cranial) if math.isfinite(self.cranial_reach) else None,
            stops_in_apnoea=self.stops_in_apnoea,
        )


@dataclass(frozen=True)
class MotionPreset:
    """File of `scenes/motions`: a description, the source of its numbers, and the motions."""

    description: str
    source: str
    motions: tuple[PatientMotion, ...]


def list_motions() -> list[str]:
    """Names of the presets; "none" is the first."""
    return [STILL, *file_names("motions")]


def make_motion(name: str) -> MotionPreset:
    """Preset of a name.

    Raises:
        ValueError: an unknown name (lists the known ones, suggests the nearest).
    """
    require_known("motion", name, list_motions())
    path = scenes_folder() / "motions" / f"{name}.toml"
    return fill(MotionPreset, read_toml(path, "motion"), f"motion {name!r}")


def with_motion(scene: Scene, name: str | None) -> Scene:
    """Scene with a preset of the patient's motion; "none": without motion; None: with its own."""
    if name is None:
        return scene
    motions = () if name == STILL else tuple(motion.within(scene) for motion in make_motion(name).motions)
    return replace(scene, motions=motions)


def _vector(values: np.ndarray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
