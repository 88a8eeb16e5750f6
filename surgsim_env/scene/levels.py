"""Difficulty levels of palpation: hidden lesions as shares of a scene's ranges, and their draw."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.material.regions import Capsule, Lesion
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.load import make_material, require_known
from surgsim_env.scene.model import LesionDraw, Range, Scene

# Least gap between lesions' balls under a tip of radius REFERENCE_TIP [m], in proportion for other tips: nearer
# lesions are felt as one.
LESION_GAP = 0.006
REFERENCE_TIP = 0.008
# Draws of one lesion apart from the others, and draws of all lesions, before giving up.
PLACES_MOST = 20
TRIES_MOST = 200
# Thickness of a drawn capsule [m]; only its modulus times thickness matters, 5 to 20 N/m: that of the scene `liver`
# is 20 N/m, which adds some 7 % to an indentation, as a human one does (Roan 2010, doi 10.1115/1.4002369).
CAPSULE_THICKNESS = 2e-5
CAPSULE_STIFFNESS = (5.0, 20.0)
# Factor on the substeps of a scene with another law of tissue: strained tissue and the fast part of a relaxation
# are stiffer than tissue at rest.
TISSUE_SUBSTEPS = 2


@dataclass(frozen=True)
class Level:
    """Difficulty level. A share f of a scene's range [low, high] is low + f (high - low); f may lie outside [0, 1].

    Args:
        name: its key in LEVELS.
        lesion_count_weights: probabilities of 0, 1, 2, ... lesions.
        radius, cover, modulus_ratio: shares of the scene's `[lesion]` ranges, from and to.
        background: range of the factor on the healthy tissue's modulus; lesions keep their ratio to it.
        capsule_share: probability that an organ without a capsule gets one, drawn from CAPSULE_STIFFNESS.
        sensor_noise, sensor_bias: factors on the scene's force sensor.
        sensor_drift: largest drift of the force sensor, as a share of its range in a second.
        sensor_hysteresis: half the width of its loop, as a share of its range.
        tissue: material of the library with the law of healthy tissue; modulus and density stay the scene's; None:
            the scene's law.
        motion: preset of the patient's motion, unless the environment's arguments name one; None: the scene's motions.
        map_error: standard deviation of the healthy map's offset from the organ along each side of the chart [m]; each
            episode draws one.
        joint_errors: True for the errors of joints that an arm's file states.
    """

    name: str
    lesion_count_weights: tuple[float, ...]
    radius: Range
    cover: Range
    modulus_ratio: Range
    background: Range
    capsule_share: float
    sensor_noise: float
    sensor_bias: float
    sensor_drift: float = 0.0
    sensor_hysteresis: float = 0.0
    tissue: str | None = None
    motion: str | None = None
    map_error: float = 0.0
    joint_errors: bool = False

    def scene(self, scene: Scene) -> Scene:
        """Scene at this level: with its sensor and tissue, and mass scaling for stiffer tissue.

        Raises:
            ValueError: the scene has no [lesion] table, or the level's share of one of its ranges is invalid.
        """
        self.lesion_draw(scene)
        own = scene.sensor
        sensor = replace(
            own,
            noise=own.noise * self.sensor_noise,
            bias=own.bias * self.sensor_bias,
            drift=own.drift + self.sensor_drift * own.range,
            hysteresis=own.hysteresis + self.sensor_hysteresis * own.range,
        )
        healthy, instrument = self.healthy(scene), scene.instrument
        if instrument.taxels is not None:
            taxels = replace(instrument.taxels, noise=instrument.taxels.noise * self.sensor_noise)
            instrument = replace(instrument, taxels=taxels)
        instrument = replace(instrument, joint_errors=instrument.joint_errors or self.joint_errors)
        return replace(healthy, sensor=sensor, instrument=instrument, timing=replace(healthy.timing, mass_scaling=True))

    def healthy(self, scene: Scene) -> Scene:
        """Scene with this level's healthy tissue, before an operation."""
        if self.tissue is None:
            return scene
        law, own = make_material(self.tissue).material, scene.material
        if (law.stiffening, law.relaxation) == (own.stiffening, own.relaxation):
            return scene
        timing = replace(scene.timing, substep_count=TISSUE_SUBSTEPS * scene.timing.substep_count)
        material = replace(own, stiffening=law.stiffening, relaxation=law.relaxation)
        return replace(scene, material=material, timing=timing)

    def lesion_draw(self, scene: Scene) -> LesionDraw:
        """Lesion ranges of a scene at this level."""
        draw = scene.lesion
        if draw is None:
            raise ValueError(
                f"scene {scene.name!r} has no [lesion] table, so that level {self.name!r} has nothing to hide in it: "
                "add one, or take a scene that has it, such as 'phantom'"
            )
        shares = self._shares(draw)
        for name, (low, high) in shares.items():
            least = 1.0 if name == "modulus_ratio" else 0.0
            if not low > least:
                raise ValueError(
                    f"level {self.name!r} of scene {scene.name!r} draws lesion.{name} from [{low:g}, {high:g}], which "
                    f"must lie above {least:g}: narrow lesion.{name} = {list(getattr(draw, name))} of the scene"
                )
        return replace(draw, **shares)

    def ranges(self, draw: LesionDraw) -> LesionDraw:
        """Lesion ranges with this level's shares."""
        return replace(draw, **self._shares(draw))

    def _shares(self, draw: LesionDraw) -> dict[str, tuple[float, float]]:
        return {name: _share(getattr(draw, name), getattr(self, name)) for name in ("radius", "cover", "modulus_ratio")}

    def draw(self, anatomy: Anatomy, rng: np.random.Generator, *, lesion_count: int | None = None) -> "DrawnOrgan":
        """Draw an organ.

        Args:
            anatomy: of a scene from `scene`.
            rng: source of random numbers.
            lesion_count: number of lesions; None: drawn.

        Raises:
            ValueError: no room for the lesions in TRIES_MOST draws.
        """
        weights = self.lesion_count_weights
        count = int(rng.choice(len(weights), p=weights)) if lesion_count is None else lesion_count
        background = float(rng.uniform(*self.background))
        capsule = 0.0
        if anatomy.scene.capsule is None and rng.random() < self.capsule_share:
            capsule = float(rng.uniform(*CAPSULE_STIFFNESS))
        lesions = _draw_lesions(anatomy, self.lesion_draw(anatomy.scene), rng, count, background)
        return DrawnOrgan(lesions, background, capsule)


@dataclass(frozen=True)
class DrawnOrgan:
    """Organ of an episode, drawn at random.

    Args:
        lesions: spheres.
        background: factor on the modulus of the healthy tissue and its own capsule.
        capsule_stiffness: modulus times thickness of a capsule beside the scene's own [N/m], 0 for none.
    """

    lesions: tuple[Lesion, ...]
    background: float = 1.0
    capsule_stiffness: float = 0.0

    @classmethod
    def draw(
        cls,
        anatomy: Anatomy,
        rng: np.random.Generator,
        level: Level | None = None,
        lesion_count: int | tuple[int, int] | None = None,
    ) -> "DrawnOrgan":
        """Draw the organ of an episode.

        Args:
            anatomy: of a scene made by the level's `scene`.
            rng: source of random numbers.
            level: of the lesions; None for the scene's own ranges.
            lesion_count: number of lesions, or its least and most; None: drawn by the level, without a level none.

        Raises:
            ValueError: lesions of a scene without a [lesion] table, or TRIES_MOST draws find no room for them.
        """
        count = int(rng.integers(*lesion_count, endpoint=True)) if isinstance(lesion_count, tuple) else lesion_count
        if level is not None:
            return level.draw(anatomy, rng, lesion_count=count)
        return cls(_draw_lesions(anatomy, anatomy.scene.lesion, rng, count or 0, 1.0))

    def compiled(self, anatomy: Anatomy) -> OrganModel:
        """Compile the organ on an anatomy."""
        specification = anatomy.specification(self.lesions, modulus_factor=self.background)
        if self.capsule_stiffness > 0.0:
            membrane = Capsule(self.capsule_stiffness / CAPSULE_THICKNESS, CAPSULE_THICKNESS)
            specification = replace(specification, capsule=membrane)
        return anatomy.compiled(specification)

    def places(self, anatomy: Anatomy) -> FloatArray:
        """Points of the palpable face nearest to the lesions' centres [m], shape (n_lesion, 3)."""
        points = [anatomy.face.project(np.asarray(lesion.centre))[0] for lesion in self.lesions]
        return np.array(points).reshape(-1, 3)

    def to_json(self) -> str:
        """Exact JSON of the draw."""
        lesions = [[*lesion.centre, lesion.radius, lesion.material.youngs_modulus] for lesion in self.lesions]  # type: ignore[misc, union-attr]
        # A whole number in a user's own draw is written as a float, as it is read.
        numbers = {"background": float(self.background), "capsule_stiffness": float(self.capsule_stiffness)}
        return json.dumps({"lesions": [list(map(float, row)) for row in lesions], **numbers})

    @classmethod
    def from_json(cls, text: str, anatomy: Anatomy) -> "DrawnOrgan":
        """Read the JSON of `to_json` for the same anatomy."""
        saved = json.loads(text)
        lesions = [
            anatomy.lesion_of_modulus(row[:3], row[3], row[4], f"lesion {number}")
            for number, row in enumerate(saved["lesions"], start=1)
        ]
        return cls(tuple(lesions), saved["background"], saved["capsule_stiffness"])


def _draw_lesions(
    anatomy: Anatomy, ranges: LesionDraw | None, rng: np.random.Generator, count: int, background: float
) -> tuple[Lesion, ...]:
    """Draw lesions apart from each other, in tissue of a modulus factor."""
    gap = LESION_GAP * anatomy.scene.instrument.tip_radius / REFERENCE_TIP
    for _ in range(TRIES_MOST):
        lesions: list[Lesion] = []
        for _ in range(count):
            for _ in range(PLACES_MOST):
                lesion = anatomy.random_lesion(rng, ranges, modulus_factor=background)
                if _apart(lesion, lesions, gap):
                    lesions.append(replace(lesion, name=f"lesion {len(lesions) + 1}"))
                    break
            else:
                break
        if len(lesions) == count:
            return tuple(lesions)
    raise ValueError(
        f"scene {anatomy.scene.name!r}: {count} lesions found no room beside each other in {TRIES_MOST} draws: use "
        "smaller or fewer lesions, or a larger palpable face"
    )


def _share(bounds: Range, share: Range) -> Range:
    low, high = bounds
    return low + share[0] * (high - low), low + share[1] * (high - low)


def _apart(lesion: Lesion, others: Sequence[Lesion], gap: float) -> bool:
    """True if a ball keeps a gap [m] from all others."""
    return all(
        math.dist(lesion.centre, other.centre) >= lesion.radius + other.radius + gap  # type: ignore[arg-type, operator]
        for other in others
    )


# Ranges: normal liver by elastography 6.63 +- 1.65 kPa, +-25 % from one person to the next, HCC and metastases 8 times
# that, malignant lesions at large 3 times (doi 10.1177/8756479317733713, 10.1186/s43055-020-00186-2), adenomas twice
# (PMID 26299323); sensors of minimally invasive tools 5 to 50 mN.
# "clinical": stiffening and relaxation as identified on pig liver (scenes/materials), a ventilated patient
# (scenes/motions); drift, hysteresis and the map's error are chosen, of the order of data sheets of miniature strain
# gauge sensors and of surface registrations in liver surgery, without a source for the numbers.
LEVELS: Mapping[str, Level] = {
    level.name: level
    for level in (
        Level("easy", (0.0, 1.0), (0.5, 1.0), (0.0, 0.5), (0.5, 1.0), (0.9, 1.1), 0.0, 1.0, 1.0),
        Level("standard", (0.1, 0.5, 0.25, 0.15), (0.0, 1.0), (0.0, 1.0), (0.0, 1.0), (0.7, 1.3), 0.5, 2.0, 1.0),
        Level("hard", (0.15, 0.3, 0.3, 0.25), (-0.3, 0.2), (-0.3, 0.5), (0.0, 0.75), (0.7, 1.3), 0.5, 3.0, 2.0),
        Level(
            "clinical",
            (0.1, 0.5, 0.25, 0.15),
            (0.0, 1.0),
            (0.0, 1.0),
            (0.0, 1.0),
            (0.7, 1.3),
            0.5,
            2.0,
            1.0,
            sensor_drift=2e-4,
            sensor_hysteresis=0.005,
            tissue="pig_liver_ex_vivo_relaxing",
            motion="calm",
            map_error=0.004,
            joint_errors=True,
        ),
    )
}


def find_level(name: str) -> Level:
    """Level of a name.

    Raises:
        ValueError: an unknown name; lists the known ones, suggests the nearest.
    """
    require_known("level", name, LEVELS)
    return LEVELS[name]
