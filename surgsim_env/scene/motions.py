"""Presets of how a patient moves, from the library in `scenes/motions`: each becomes motions of a scene."""

import math
from dataclasses import dataclass, replace

import numpy as np

from msdm_core.arithmetic import matmul, norm
from surgsim_env.scene.load import fill, nearest, read_toml, scenes_folder
from surgsim_env.scene.model import CyclicMotion, Range, Scene, Vector

# The preset of a patient who holds still.
STILL = "none"
# Less of the approach than this share across the patient's axis tells no front.
ACROSS_LEAST = 0.1


@dataclass(frozen=True)
class PatientMotion:
    """A cyclic motion by the patient's directions.

    Args:
        name: as "breathing".
        caudal, anterior: displacement towards the feet and towards the front, of a cycle of size 1 [m].
        cranial_reach: distance [m] from the organ's end nearest to the head up to which it moves; infinite: all of it.
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
        """The motion in the axes of a scene: the head is where `cranial` points, the front where the probe comes from.

        Of the approach only what is perpendicular to `cranial` counts; a probe along the patient's axis shows no front,
        and the part towards it is left out.
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
    """A file of `scenes/motions`: what it describes, where its numbers come from, and the motions."""

    description: str
    source: str
    motions: tuple[PatientMotion, ...]


def list_motions() -> list[str]:
    """Names of the presets; "none" is the first."""
    return [STILL, *sorted(path.stem for path in (scenes_folder() / "motions").glob("*.toml"))]


def make_motion(name: str) -> MotionPreset:
    """The preset of a name.

    Raises:
        ValueError: an unknown name (lists the known, suggests the nearest).
    """
    known = list_motions()
    if name not in known[1:]:
        raise ValueError(f"motion {name!r} is unknown; the motions are {', '.join(known)}{nearest(str(name), known)}")
    path = scenes_folder() / "motions" / f"{name}.toml"
    return fill(MotionPreset, read_toml(path, "motion"), f"motion {name!r}")


def with_motion(scene: Scene, name: str | None) -> Scene:
    """A scene whose patient moves as a preset says; "none": holds still; None: moves as the scene says itself."""
    if name is None:
        return scene
    motions = () if name == STILL else tuple(one.within(scene) for one in make_motion(name).motions)
    return replace(scene, motions=motions)


def _vector(values: np.ndarray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
