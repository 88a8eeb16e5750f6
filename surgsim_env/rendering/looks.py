"""Looks of a picture: what random looks draw of camera, light, colours, vessels, gloss and noise, and their ranges.

A look changes pictures and nothing of the simulation. Ranges of training and evaluation share no hue and no spacing of
vessels, and their looks come from different streams of random numbers.
"""

import colorsys
import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.rendering.cameras import Camera, cross
from surgsim_env.scene.palpable_surface import tangent_axes

Range = tuple[float, float]
Bands = tuple[Range, ...]

# Of the seeds that belong to looks, among those that follow from an episode's (`SeedSequence.spawn_key`).
LOOK_STREAM = 0x4C_6F_6F_6B
# Seeds of textures and of noise lie below.
SEEDS_MOST = 2**31


@dataclass(frozen=True)
class LookRanges:
    """Ranges from which looks are drawn evenly; each is (low, high), those called `bands` are several of these.

    Fields:
        stream: which random numbers draw the looks; ranges of another purpose need another number
        camera_shift: how far the camera is moved, as a share of its distance from what it looks at
        camera_turn: how far its view is turned, about a random axis across it [degrees]
        camera_roll: rotation of the picture, to either side [degrees]
        fov_factor: factor on the vertical field of view
        light_tilt: how far the lamps are turned from where they are [degrees]
        light_strength: factor on lamps and headlight, drawn for each
        warmth: added to red and taken from blue of the light, as a share
        tissue_hue_bands, drape_hue_bands, target_hue_bands: [degrees], of the colour wheel
        tissue_saturation, tissue_value: of the tissue's colour
        drape_saturation, drape_value: of the drape's and the supports'
        instrument_brightness: factor on the instrument's colours
        vessel_bands: vessels crossed on a metre of surface [1/m]
        vessel_strength: how much darker vessels are than tissue, 0 to 1
        vessel_width: share of the surface that they take, about
        gloss: strength of the tissue's highlights
        sharpness: narrowness of its highlights
        exposure: factor on the picture
        noise: standard deviation of a pixel's noise, as a share of full scale

    Raises:
        ValueError: a range that is not finite or whose ends are in the wrong order, a share outside [0, 1] (names it).
    """

    stream: int = 2
    camera_shift: Range = (0.0, 0.05)
    camera_turn: Range = (0.0, 2.0)
    camera_roll: Range = (-5.0, 5.0)
    fov_factor: Range = (0.76, 0.92)
    light_tilt: Range = (0.0, 25.0)
    light_strength: Range = (0.7, 1.35)
    warmth: Range = (-0.12, 0.18)
    tissue_hue_bands: Bands = ((-22.0, 22.0),)
    drape_hue_bands: Bands = ((150.0, 260.0),)
    target_hue_bands: Bands = ((90.0, 150.0),)
    tissue_saturation: Range = (0.55, 0.85)
    tissue_value: Range = (0.35, 0.62)
    drape_saturation: Range = (0.25, 0.75)
    drape_value: Range = (0.2, 0.5)
    instrument_brightness: Range = (0.7, 1.1)
    vessel_bands: Bands = ((60.0, 300.0),)
    vessel_strength: Range = (0.0, 0.6)
    vessel_width: Range = (0.1, 0.3)
    gloss: Range = (0.1, 1.0)
    sharpness: Range = (0.4, 0.95)
    exposure: Range = (0.8, 1.2)
    noise: Range = (0.0, 0.03)

    def __post_init__(self) -> None:
        if isinstance(self.stream, bool) or not isinstance(self.stream, int) or self.stream < 0:
            raise ValueError(f"stream is {self.stream!r}; it must be a whole number from 0")
        for name in [one.name for one in fields(self) if one.name != "stream"]:
            given = getattr(self, name)
            for low, high in given if name.endswith("_bands") else (given,):
                if not (math.isfinite(low) and math.isfinite(high) and low <= high):
                    raise ValueError(f"{name} holds ({low}, {high}); both must be finite, the lower one first")
                least, most = LIMITS.get(name, (-math.inf, math.inf))
                if low < least or high > most:
                    raise ValueError(f"{name} holds ({low}, {high}); it must lie within {least:g} and {most:g}")


# Limits of ranges: shares, factors that must not be 0, and angles that leave a picture.
LIMITS: dict[str, Range] = {
    "camera_shift": (0.0, 0.5),
    "camera_turn": (0.0, 45.0),
    "camera_roll": (-180.0, 180.0),
    "fov_factor": (0.1, 2.0),
    "light_tilt": (0.0, 60.0),
    "light_strength": (0.0, 3.0),
    "warmth": (-0.5, 0.5),
    "instrument_brightness": (0.0, 2.0),
    "vessel_bands": (20.0, 600.0),
    "exposure": (0.1, 3.0),
    **dict.fromkeys(
        (
            *("tissue_saturation", "tissue_value", "drape_saturation", "drape_value"),
            *("vessel_strength", "vessel_width", "gloss", "sharpness", "noise"),
        ),
        (0.0, 1.0),
    ),
}

# Limits of a look's numbers.
LOOK_LIMITS: dict[str, Range] = {
    "shift": (-0.5, 0.5),
    "turn": (-45.0, 45.0),
    "roll": (-180.0, 180.0),
    "light_turn": (-2.0, 2.0),
    **dict.fromkeys(("lamp", "head"), (0.0, 5.0)),
    **dict.fromkeys(("tissue", "drape", "target"), (0.0, 1.0)),
    "instrument": LIMITS["instrument_brightness"],
    "vessel_density": LIMITS["vessel_bands"],
    "seed": (0, SEEDS_MOST - 1),
    **{
        name: LIMITS[name]
        for name in ("fov_factor", "vessel_strength", "vessel_width", "gloss", "sharpness", "exposure", "noise")
    },
}

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
    """One look; numbers alone.

    Fields:
        shift: of the camera along its right, up and way back, as shares of its distance from its target    (3,)
        turn: of the view to the right and up [degrees]                                                     (2,)
        roll: of the picture [degrees]
        fov_factor: factor on the field of view
        light_turn: of the lamps along two axes across the approach, tangents of angles                     (2,)
        lamp, head: factors on lamps and headlight for red, green and blue                                  (3,) each
        tissue, drape, target: colours
        instrument: factor on its colours
        vessel_density, vessel_strength, vessel_width: as in LookRanges
        gloss, sharpness: of the tissue's highlights
        exposure, noise: as in LookRanges
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

    def __post_init__(self) -> None:
        for name, (least, most) in LOOK_LIMITS.items():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if not ((value >= least) & (value <= most)).all():
                raise ValueError(f"{name} is {value.tolist()}; it must lie within {least:g} and {most:g}")

    def seen_from(self, camera: Camera) -> Camera:
        """A camera moved, turned and zoomed as the look has it."""
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
        """The unit direction (3,) of a lamp's light turned as the look has it, where instruments come along `down`."""
        across, along = tangent_axes(down)
        turned = direction + self.light_turn[0] * across + self.light_turn[1] * along
        return turned / np.linalg.norm(turned)

    def exposed(self, frame: NDArray[np.uint8], moment: int) -> NDArray[np.uint8]:
        """A picture (height, width, 3) with exposure and the noise of a moment, which has its own random numbers."""
        values = frame.astype(np.float32) * np.float32(self.exposure)
        if self.noise > 0.0:
            numbers = np.random.Generator(np.random.Philox(key=self.seed, counter=[0, 0, 0, moment]))
            values += np.float32(255.0 * self.noise) * numbers.standard_normal(frame.shape, dtype=np.float32)
        return np.clip(np.rint(values), 0.0, 255.0).astype(np.uint8)


def find_look_ranges(given: "str | LookRanges") -> LookRanges:
    """The ranges of a split by its name, or those given.

    Raises:
        ValueError: an unknown split (lists the known).
    """
    if isinstance(given, LookRanges):
        return given
    if given not in LOOK_SPLITS:
        raise ValueError(f"looks is {given!r}; it must be None, {', '.join(map(repr, LOOK_SPLITS))} or a LookRanges")
    return LOOK_SPLITS[given]


def look_generator(ranges: LookRanges, seed: int) -> np.random.Generator:
    """The random numbers of the looks of ranges, for an environment's seed; no environment draws from them."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(LOOK_STREAM, ranges.stream)))


def draw_look(ranges: LookRanges, rng: np.random.Generator) -> Look:
    """Draw a look from ranges."""

    def one(limits: Range) -> float:
        return float(rng.uniform(*limits))

    def among(bands: Bands) -> float:
        # A wider band is drawn more often.
        place = rng.uniform(0.0, sum(high - low for low, high in bands))
        for low, high in bands:
            if place <= high - low:
                return low + float(place)
            place -= high - low
        return bands[-1][1]

    way = rng.normal(size=3)
    shift = way / np.linalg.norm(way) * one(ranges.camera_shift)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    turn = one(ranges.camera_turn) * np.array([math.cos(angle), math.sin(angle)])
    roll, fov = one(ranges.camera_roll), one(ranges.fov_factor)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    light = math.tan(math.radians(one(ranges.light_tilt))) * np.array([math.cos(angle), math.sin(angle)])
    warm = one(ranges.warmth)
    white = np.array([1.0 + warm, 1.0, 1.0 - warm])
    lamp, head = one(ranges.light_strength) * white, one(ranges.light_strength) * white
    tissue = _colour(among(ranges.tissue_hue_bands), one(ranges.tissue_saturation), one(ranges.tissue_value))
    drape = _colour(among(ranges.drape_hue_bands), one(ranges.drape_saturation), one(ranges.drape_value))
    target = _colour(among(ranges.target_hue_bands), 0.73, 0.75)
    return Look(
        shift=_triple(shift),
        turn=(float(turn[0]), float(turn[1])),
        roll=roll,
        fov_factor=fov,
        light_turn=(float(light[0]), float(light[1])),
        lamp=_triple(lamp),
        head=_triple(head),
        tissue=tissue,
        drape=drape,
        target=target,
        instrument=one(ranges.instrument_brightness),
        vessel_density=among(ranges.vessel_bands),
        vessel_strength=one(ranges.vessel_strength),
        vessel_width=one(ranges.vessel_width),
        gloss=one(ranges.gloss),
        sharpness=one(ranges.sharpness),
        exposure=one(ranges.exposure),
        noise=one(ranges.noise),
        seed=int(rng.integers(SEEDS_MOST)),
    )


def _colour(hue: float, saturation: float, value: float) -> Colour:
    return colorsys.hsv_to_rgb((hue / 360.0) % 1.0, saturation, value)


def _triple(values: FloatArray) -> Colour:
    first, second, third = values.tolist()
    return first, second, third
