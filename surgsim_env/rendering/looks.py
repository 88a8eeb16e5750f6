"""Domain randomisation of pictures: a look's camera, light, colours, vessels, gloss and noise, and their ranges.

A look changes pictures alone, not the simulation. Ranges of training and evaluation share no hue and no spacing of
vessels, and their looks come from different streams of random numbers.
"""

import colorsys
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.rendering.cameras import Camera, cross
from surgsim_env.scene.load import require_known
from surgsim_env.scene.palpable_surface import tangent_axes

Range = tuple[float, float]
Bands = tuple[Range, ...]

# Spawn key (`SeedSequence.spawn_key`) of the looks' random numbers, apart from those of the episode.
LOOK_STREAM = 0x4C_6F_6F_6B
# Upper bound of the seeds of textures and noise.
SEEDS_MOST = 2**31


# Camera: shift as a share of its distance from its target, turn about a random axis across the view [degrees], roll
# of the picture [degrees], factor on the vertical field of view.
CAMERA_SHIFT, CAMERA_TURN, CAMERA_ROLL, FOV_FACTOR = (0.0, 0.05), (0.0, 2.0), (-5.0, 5.0), (0.76, 0.92)
# Light: tilt of the lamps [degrees], factors on lamps and headlight, share added to red and taken from blue.
LIGHT_TILT, LIGHT_STRENGTH, WARMTH = (0.0, 25.0), (0.7, 1.35), (-0.12, 0.18)
# Saturation and value of the colours of tissue, and of drape and supports.
TISSUE_COLOUR, DRAPE_COLOUR = ((0.55, 0.85), (0.35, 0.62)), ((0.25, 0.75), (0.2, 0.5))
INSTRUMENT_BRIGHTNESS = (0.7, 1.1)
# Vessels: darkness relative to tissue, and approximate share of the surface.
VESSEL_STRENGTH, VESSEL_WIDTH = (0.0, 0.6), (0.1, 0.3)
# The tissue's highlights: strength and narrowness.
GLOSS, SHARPNESS = (0.1, 1.0), (0.4, 0.95)
# Factor on the picture, and standard deviation of a pixel's noise as a share of full scale.
EXPOSURE, NOISE = (0.8, 1.2), (0.0, 0.03)


@dataclass(frozen=True)
class LookRanges:
    """Ranges of a split that differ from those of the other split; several (low, high) each.

    Fields:
        stream: number of the split's stream of random numbers
        tissue_hue_bands, drape_hue_bands, target_hue_bands: [degrees], of the colour wheel
        vessel_bands: vessels crossed on a metre of surface [1/m]
    """

    stream: int
    tissue_hue_bands: Bands
    drape_hue_bands: Bands
    target_hue_bands: Bands
    vessel_bands: Bands


# Hues and vessel spacings of evaluation lie between and beyond those of training.
TRAIN = LookRanges(
    stream=0,
    tissue_hue_bands=((-18.0, -6.0), (2.0, 14.0)),
    drape_hue_bands=((165.0, 195.0), (215.0, 245.0)),
    target_hue_bands=((96.0, 116.0), (128.0, 144.0)),
    vessel_bands=((70.0, 120.0), (170.0, 260.0)),
)
TEST = LookRanges(
    stream=1,
    tissue_hue_bands=((-24.0, -18.5), (-5.5, 1.5), (14.5, 20.0)),
    drape_hue_bands=((150.0, 164.0), (196.0, 214.0), (246.0, 260.0)),
    target_hue_bands=((90.0, 95.5), (116.5, 127.5), (144.5, 150.0)),
    vessel_bands=((50.0, 69.0), (121.0, 169.0), (261.0, 320.0)),
)
LOOK_SPLITS = {"train": TRAIN, "test": TEST}

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Look:
    """Parameters of a picture's appearance.

    Fields:
        shift: of the camera along its right, up and way back, as shares of its distance from its target    (3,)
        turn: of the view to the right and up [degrees]                                                     (2,)
        roll: of the picture [degrees]
        fov_factor: factor on the field of view
        light_turn: of the lamps along two axes across the approach, tangents of angles                     (2,)
        lamp, head: factors on lamps and headlight for red, green and blue                                  (3,) each
        tissue, drape, target: colours
        instrument: factor on its colours
        vessel_density, vessel_strength, vessel_width: crossed on a metre [1/m], darkness, share of the surface
        gloss, sharpness: of the tissue's highlights
        exposure, noise: factor on the picture, and a pixel's standard deviation as a share of full scale
        seed: of the vessels and the noise
    """

    shift: Colour
    turn: tuple[float, float]
    roll: float
    fov_factor: float
    light_turn: tuple[float, float]
    lamp: Colour
    head: Colour
    tissue: Colour
    drape: Colour
    target: Colour
    instrument: float
    vessel_density: float
    vessel_strength: float
    vessel_width: float
    gloss: float
    sharpness: float
    exposure: float
    noise: float
    seed: int

    def seen_from(self, camera: Camera) -> Camera:
        """Camera shifted, turned and zoomed by the look."""
        distance = float(np.linalg.norm(camera.target - camera.position))
        position = camera.position + distance * (camera.rotation @ np.array(self.shift))
        right, up = (math.tan(math.radians(angle)) * distance for angle in self.turn)
        target = camera.target + right * camera.rotation[:, 0] + up * camera.rotation[:, 1]
        view = (target - position) / np.linalg.norm(target - position)
        # Rodrigues: `up` turned about the view.
        angle = math.radians(self.roll)
        across, along = cross(view, camera.up), view * (view @ camera.up)
        turned = (camera.up - along) * math.cos(angle) + across * math.sin(angle) + along
        rotation = Camera.looking(position, target, turned, camera.fov).rotation
        return Camera(position, target, camera.up, rotation, camera.fov * self.fov_factor)

    def lit(self, direction: FloatArray, down: FloatArray) -> FloatArray:
        """Unit direction (3,) of a lamp's light tilted by the look; `down` is the approach of instruments."""
        across, along = tangent_axes(down)
        turned = direction + self.light_turn[0] * across + self.light_turn[1] * along
        return turned / np.linalg.norm(turned)

    def exposed(self, frame: NDArray[np.uint8], moment: int) -> NDArray[np.uint8]:
        """Picture (height, width, 3) with exposure and noise; each moment has its own random numbers."""
        values = frame.astype(np.float32) * np.float32(self.exposure)
        if self.noise > 0.0:
            numbers = np.random.Generator(np.random.Philox(key=self.seed, counter=[0, 0, 0, moment]))
            values += np.float32(255.0 * self.noise) * numbers.standard_normal(frame.shape, dtype=np.float32)
        return np.clip(np.rint(values), 0.0, 255.0).astype(np.uint8)


def find_look_ranges(split: str) -> LookRanges:
    """Ranges of a split by its name.

    Raises:
        ValueError: an unknown split (lists the known ones).
    """
    require_known("look", split, LOOK_SPLITS)
    return LOOK_SPLITS[split]


def look_generator(ranges: LookRanges, seed: int) -> np.random.Generator:
    """Random numbers of a split's looks for an environment's seed, apart from the environment's own."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(LOOK_STREAM, ranges.stream)))


def draw_look(ranges: LookRanges, rng: np.random.Generator) -> Look:
    """Draw a look from ranges."""

    def uniform(limits: Range) -> float:
        return float(rng.uniform(*limits))

    def from_bands(bands: Bands) -> float:
        # Uniform over the union of the bands.
        place = rng.uniform(0.0, sum(high - low for low, high in bands))
        for low, high in bands:
            if place <= high - low:
                return low + float(place)
            place -= high - low
        return bands[-1][1]

    direction = rng.normal(size=3)
    shift = direction / np.linalg.norm(direction) * uniform(CAMERA_SHIFT)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    turn = uniform(CAMERA_TURN) * np.array([math.cos(angle), math.sin(angle)])
    roll, fov_factor = uniform(CAMERA_ROLL), uniform(FOV_FACTOR)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    light = math.tan(math.radians(uniform(LIGHT_TILT))) * np.array([math.cos(angle), math.sin(angle)])
    warm = uniform(WARMTH)
    white = np.array([1.0 + warm, 1.0, 1.0 - warm])
    lamp, head = uniform(LIGHT_STRENGTH) * white, uniform(LIGHT_STRENGTH) * white
    tissue = _colour(from_bands(ranges.tissue_hue_bands), *map(uniform, TISSUE_COLOUR))
    drape = _colour(from_bands(ranges.drape_hue_bands), *map(uniform, DRAPE_COLOUR))
    target = _colour(from_bands(ranges.target_hue_bands), 0.73, 0.75)
    return Look(
        shift=_triple(shift),
        turn=(float(turn[0]), float(turn[1])),
        roll=roll,
        fov_factor=fov_factor,
        light_turn=(float(light[0]), float(light[1])),
        lamp=_triple(lamp),
        head=_triple(head),
        tissue=tissue,
        drape=drape,
        target=target,
        instrument=uniform(INSTRUMENT_BRIGHTNESS),
        vessel_density=from_bands(ranges.vessel_bands),
        vessel_strength=uniform(VESSEL_STRENGTH),
        vessel_width=uniform(VESSEL_WIDTH),
        gloss=uniform(GLOSS),
        sharpness=uniform(SHARPNESS),
        exposure=uniform(EXPOSURE),
        noise=uniform(NOISE),
        seed=int(rng.integers(SEEDS_MOST)),
    )


def _colour(hue: float, saturation: float, value: float) -> Colour:
    return colorsys.hsv_to_rgb((hue / 360.0) % 1.0, saturation, value)


def _triple(values: FloatArray) -> Colour:
    first, second, third = values.tolist()
    return first, second, third
