"""Chart of a palpable face, a grid of sites across the approach, and the healthy organ's stiffness at the sites."""

import contextlib
import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.arithmetic import matmul, norm
from msdm_core.mesh.tet_mesh import FloatArray, protect_arrays, read_only
from msdm_core.mesh_files.mesh_file import checked_content
from surgsim_env.coupling.lane_group import LaneGroup
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.palpation.site_press import SitePress, in_threads, press_in_lanes, press_phases
from surgsim_env.scene.anatomy import Anatomy, load_anatomy, with_added_mass, with_substeps
from surgsim_env.scene.digest import PHYSICS_VERSION, content_digest
from surgsim_env.scene.family import CACHED_MOST
from surgsim_env.scene.load import scenes_folder, with_instrument
from surgsim_env.scene.model import Scene
from surgsim_env.scene.palpable_surface import PalpableFace, tangent_axes
from surgsim_env.step_progress import StepProgress

# Fewest and most sites on a side of the grid; an odd number has a site in the middle.
SITES_FEWEST, SITES_MOST = 13, 25
# Sites on a side of the touch map, the same for all organs, and their distance in tip radii; larger on a face beyond
# that many.
MAP_SIDE, MAP_CELL = 41, 0.4
# Subdivisions of a cell of the grid in the table of surface points.
POINTS_BETWEEN = 2
# Tolerance of the margin [m]: rounding puts the chart's border slightly inside it.
ROUNDING = 1e-9
# Number of vectorised organs by precision.
LANES = {np.float64: 8, np.float32: 16}
# Largest added share of mass of the organ of a patient's map.
MASS_SHARE = 0.025
# Version of a map's contents.
MAP_VERSION = 2
# Division of a map's cells for taxels: within a cell of the grid the mesh moves the centre of pressure as lesions do.
TAXEL_BETWEEN = 2
# Environment variable with the cache's folder.
FOLDER_VARIABLE = "SURGSIM_CACHE"


@dataclass(frozen=True, eq=False)
class Chart:
    """Rectangle across the approach around all pressable places of a face.

    Fields:
        across, along: unit vectors of the plane, the chart's first and second axis                       (3,)
        lower, upper: corners of the rectangle on these axes [m]                                          (2,)
        side_count: sites on each side of its grid, the outermost on the rectangle's border
    """

    across: FloatArray
    along: FloatArray
    lower: FloatArray
    upper: FloatArray
    side_count: int

    def __post_init__(self) -> None:
        protect_arrays(self)

    @property
    def extent(self) -> FloatArray:
        """Lengths of its sides [m] (2,)."""
        return self.upper - self.lower

    def place(self, point: ArrayLike) -> FloatArray:
        """Place (..., 2) of a point (..., 3) [m] on the chart: -1 to 1 along each axis inside it."""
        return 2.0 * (self.along_axes(point) - self.lower) / self.extent - 1.0

    def along_axes(self, vector: ArrayLike) -> FloatArray:
        """Parts (..., 2) of a vector (..., 3) along the chart's axes."""
        values = np.asarray(vector, dtype=np.float64)
        return np.stack([matmul(values, self.across), matmul(values, self.along)], axis=-1)

    def plane_point(self, place: ArrayLike) -> FloatArray:
        """Point of the plane [m] (..., 2) at a place (..., 2) of the chart, the inverse of `place`."""
        return self.lower + 0.5 * (np.asarray(place, dtype=np.float64) + 1.0) * self.extent

    @property
    def sites(self) -> FloatArray:
        """Places of all sites, shape (side_count**2, 2), in the order of their numbers."""
        return _grid(self.side_count)


def _grid(side_count: int) -> FloatArray:
    """Places of a square grid over a chart, row by row along its second axis, (side_count**2, 2)."""
    axis = np.linspace(-1.0, 1.0, side_count)
    columns, rows = np.meshgrid(axis, axis)
    return np.column_stack([columns.ravel(), rows.ravel()])


def make_chart(face: PalpableFace, tip_radius: float) -> Chart:
    """Chart of a face: the bounding rectangle less the margin, with sites about half a tip's radius [m] apart.

    Raises:
        ValueError: the margin leaves nothing of the face.
    """
    across, along = tangent_axes(face.approach)
    corners = face.points[face.triangles].reshape(-1, 3)
    plane = np.column_stack([matmul(corners, across), matmul(corners, along)])
    lower, upper = plane.min(axis=0) + face.margin, plane.max(axis=0) - face.margin
    if not (upper > lower).all():
        raise ValueError(
            f"palpation.face_margin of {face.margin * 1000:.3g} mm leaves nothing of a palpable face of "
            f"{' x '.join(f'{side * 1000:.3g}' for side in np.ptp(plane, axis=0))} mm: make it smaller"
        )
    count = round(float((upper - lower).max()) / (0.5 * tip_radius)) + 1
    count = min(max(count + (count + 1) % 2, SITES_FEWEST), SITES_MOST)
    return Chart(across, along, lower, upper, count)


@dataclass(frozen=True, eq=False)
class TouchMap:
    """Square of MAP_SIDE x MAP_SIDE sites over the middle of a chart, the same size for all organs.

    Fields:
        extent: of the chart [m]                                                        (2,)
        cell: distance between neighbouring sites [m], MAP_CELL tip radii if they span the chart
        pressable: True for pressable sites, row by row along the chart's second axis   (MAP_SIDE**2,)
    """

    extent: FloatArray
    cell: float
    pressable: NDArray[np.bool_]

    def __post_init__(self) -> None:
        protect_arrays(self)

    @property
    def axes(self) -> tuple[FloatArray, FloatArray]:
        """Coordinates of columns and rows, lengths along the chart's sides [m], (MAP_SIDE,) each.

        A column or row up to half a cell beyond the chart lies on its border.
        """
        steps = (np.arange(MAP_SIDE) - MAP_SIDE // 2) * self.cell
        first, second = (_onto(0.5 * side + steps, side, 0.5 * self.cell) for side in self.extent)
        return first, second

    @cached_property
    def sites(self) -> FloatArray:
        """Lengths of all sites along the chart's sides [m], row by row, shape (MAP_SIDE**2, 2)."""
        return read_only(np.stack(np.meshgrid(*self.axes), axis=-1).reshape(-1, 2))

    @cached_property
    def places(self) -> FloatArray:
        """Places of all sites on the chart (MAP_SIDE**2, 2), -1 to 1 inside it."""
        return read_only(2.0 * self.sites / self.extent - 1.0)

    @cached_property
    def numbers(self) -> NDArray[np.intp]:
        """Column and row of each site (MAP_SIDE**2, 2)."""
        return read_only(np.stack(np.divmod(np.arange(MAP_SIDE * MAP_SIDE), MAP_SIDE)[::-1], axis=-1))

    @cached_property
    def rows_and_columns(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Numbers of the rows and of the columns with a pressable site, ascending."""
        face = self.pressable.reshape(MAP_SIDE, MAP_SIDE)
        return read_only(np.flatnonzero(face.any(axis=1))), read_only(np.flatnonzero(face.any(axis=0)))

    def nearest(self, places: ArrayLike) -> NDArray[np.intp]:
        """Number of the site nearest to each place (..., 2) of the chart; -1 beyond the square."""
        steps = 0.5 * np.asarray(places, dtype=np.float64) * self.extent / self.cell + MAP_SIDE // 2
        cell = np.floor(steps + 0.5).astype(np.intp)
        inside = ((cell >= 0) & (cell < MAP_SIDE)).all(axis=-1)
        return np.where(inside, cell[..., 1] * MAP_SIDE + cell[..., 0], -1)


def _onto(values: FloatArray, length: float, reach: float) -> FloatArray:
    """Values with those at most `reach` outside [0, length] moved onto its ends."""
    inside = np.clip(values, 0.0, length)
    return np.where(np.abs(values - inside) <= reach + ROUNDING, inside, values)


@dataclass(frozen=True, eq=False)
class Site:
    """Pressable place.

    Fields:
        place: on the chart                                     (2,)
        point, normal: on the surface [m], and outward unit     (3,)
        moved: distance along the chart from the requested place [m]
    """

    place: FloatArray
    point: FloatArray
    normal: FloatArray
    moved: float


@dataclass(frozen=True, eq=False)
class ChartedFace:
    """The palpable face of an anatomy, and its chart."""

    anatomy: Anatomy
    chart: Chart

    @property
    def face(self) -> PalpableFace:
        """The palpable face."""
        return self.anatomy.face

    @property
    def tip_radius(self) -> float:
        """Radius of the pressing tip [m]."""
        return self.anatomy.scene.instrument.tip_radius

    def site(self, place: ArrayLike) -> Site:
        """Site at a place of the chart (2,), or the grid's nearest site if the place is not pressable.

        A place is not pressable beyond the face, nearer to its rim than its margin, over too thin tissue, and under a
        ligament or another support (`Anatomy.is_covered`).
        """
        target = np.asarray(place, dtype=np.float64)
        surface = self._pressable(target)
        if surface is not None:
            return Site(target, *surface, moved=0.0)
        places, points, normals = self._allowed
        distance = norm(0.5 * (places - target) * self.chart.extent, axis=1)
        best = int(np.argmin(distance))
        return Site(places[best], points[best], normals[best], float(distance[best]))

    def grid_sites(self, between: int = 1) -> list[Site]:
        """Sites of the chart's grid with its cells divided by `between`, each moved to a pressable place."""
        return [self.site(place) for place in _grid(between * (self.chart.side_count - 1) + 1)]

    def _pressable(self, place: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Surface point [m] and normal at a place of the chart (2,), (3,) each; None if it is not pressable."""
        u, v = self.chart.plane_point(place).tolist()
        site = self.face.site(u, v, slack=ROUNDING)
        return None if site is None or self.anatomy.is_covered(site[0]) else site

    @cached_property
    def _allowed(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Places (n, 2), surface points [m] and normals (n, 3) of the grid's pressable sites.

        Raises:
            ValueError: there is none.
        """
        allowed = [(place, *site) for place in self.chart.sites if (site := self._pressable(place)) is not None]
        if not allowed:
            raise ValueError(
                "no site of the palpable face may be pressed: lower palpation.face_margin or thickness_smallest, or "
                "move the anchors"
            )
        places, points, normals = (read_only(np.array(values)) for values in zip(*allowed, strict=True))
        return places, points, normals

    @cached_property
    def touch_map(self) -> TouchMap:
        """Sites of observations."""
        extent = self.chart.extent
        plain = TouchMap(extent, self.cell, np.ones(MAP_SIDE * MAP_SIDE, dtype=np.bool_))
        on_chart = (np.abs(plain.places) <= 1.0 + ROUNDING).all(axis=1)
        allowed = [self._pressable(place) is not None for place in plain.places]
        return TouchMap(extent, plain.cell, np.array(allowed) & on_chart)

    @property
    def cell(self) -> float:
        """Distance between neighbouring sites of the touch map [m]."""
        return max(MAP_CELL * self.tip_radius, float(self.chart.extent.max()) / (MAP_SIDE - 1))

    def surface(self, places: ArrayLike) -> FloatArray:
        """Surface points [m] (..., 3) at places of the chart (..., 2), interpolated in a table of projected points.

        Beyond the face, the table has the nearest point on it.
        """
        return interpolated(self._surface, places)

    @cached_property
    def _surface(self) -> FloatArray:
        side = POINTS_BETWEEN * (self.chart.side_count - 1) + 1
        axis = np.linspace(-1.0, 1.0, side)
        places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        dropped = [self.face.drop(*self.chart.plane_point(place).tolist()) for place in places]
        known = np.array([index for index, point in enumerate(dropped) if point is not None])
        points = np.array([dropped[index][0] for index in known])  # type: ignore[index]
        nearest = [int(np.argmin(np.square(places[known] - place).sum(axis=1))) for place in places]
        return read_only(points[nearest].reshape(side, side, 3))


def interpolated(values: FloatArray, places: ArrayLike) -> FloatArray:
    """Bilinear interpolation of a square grid over a chart (m, m, ...), rows along its second axis, at places (..., 2).

    Places beyond the chart take the values of its border.
    """
    side = len(values)
    steps = np.clip(0.5 * (np.asarray(places, dtype=np.float64) + 1.0), 0.0, 1.0) * (side - 1)
    low = np.minimum(steps.astype(np.intp), side - 2)
    share = steps - low
    column, row = low[..., 0], low[..., 1]
    trailing = (...,) + (None,) * (values.ndim - 2)
    s, t = share[..., 0][trailing], share[..., 1][trailing]
    lower = (1.0 - s) * values[row, column] + s * values[row, column + 1]
    upper = (1.0 - s) * values[row + 1, column] + s * values[row + 1, column + 1]
    return (1.0 - t) * lower + t * upper


@dataclass(frozen=True, eq=False)
class HealthyMap:
    """Presses on healthy tissue of nominal modulus, on a square grid over the chart.

    Fields:
        grid: stiffness [N/m], and centre of pressure from the tip's pole along the chart's axes [m]     (m, m, 3)
    """

    grid: FloatArray

    def __post_init__(self) -> None:
        protect_arrays(self)

    def stiffness(self, places: ArrayLike) -> FloatArray:
        """At places of the chart (..., 2) [N/m], shape (...)."""
        return interpolated(self.grid[:, :, 0], places)

    def centre(self, places: ArrayLike) -> FloatArray:
        """Centre of pressure from the tip's pole at places of the chart (..., 2), along its axes [m], (..., 2)."""
        return interpolated(self.grid[:, :, 1:], places)


@lru_cache(maxsize=CACHED_MOST + 8)
def charted_face(anatomy: Anatomy) -> ChartedFace:
    """Palpable face of an anatomy with its chart, cached."""
    return ChartedFace(anatomy, make_chart(anatomy.face, anatomy.scene.instrument.tip_radius))


def healthy_map(scene: Scene) -> HealthyMap:
    """Healthy map of a scene, from beside its file or the cache on disk, or by pressing its healthy organ at each site.

    `surgsim organ` writes it beside a patient's scene (`healthy_file`). A map of another organ, instrument or version
    is renewed in the same way, as is that of a family's template; other scenes without a map are pressed as they are,
    with progress on standard error: 5 s of processor time for `phantom`, 90 s for `phantom_wide`. The cache is the
    folder named by SURGSIM_CACHE, else the user's cache folder; if it is not writable, each process computes the map.

    Raises:
        ValueError: a press on healthy tissue that ended in a fault or measured no force (states its place).
    """
    return healthy_map_of(load_anatomy(with_instrument(scene, "probe")))


def healthy_file(scene_file: Path) -> Path:
    """Path of the healthy map beside a scene file."""
    return scene_file.with_name(f"{scene_file.stem}_healthy.npz")


def write_healthy_map(scene: Scene, path: Path, progress: StepProgress) -> None:
    """Press the healthy organ of a scene at each site of the chart's grid, and write its map to an npz file.

    Organs advance `quickened` in float32, with twice as many lanes.

    Raises:
        ValueError: as in `healthy_map`.
    """
    anatomy = load_anatomy(with_instrument(scene, "probe"))
    grid = _pressed(quickened(anatomy, progress), progress, np.float32)
    np.savez_compressed(path, digest=np.array(map_digest(anatomy)), grid=grid)


def quickened(anatomy: Anatomy, progress: StepProgress) -> Anatomy:
    """Anatomy with up to MASS_SHARE of added mass, and the fewest substeps for it.

    Static forces do not depend on masses. On the liver of OpenHELP 2 in place of 6 substeps change no stiffness by more
    than 8e-4 of itself, on its left kidney 4 in place of 8 by 3e-4, on members of `liver_family` and `kidney_family` 2
    in place of 5 and 3 in place of 7 by 2.4e-4.
    """
    with progress.step("choosing the step of the healthy organ"):
        return with_added_mass(with_substeps(anatomy, [anatomy.organ()]), lambda scaled: [scaled.organ()], MASS_SHARE)


@lru_cache(maxsize=8)
def healthy_map_of(anatomy: Anatomy, between: int = 1) -> HealthyMap:
    """`healthy_map` of a loaded anatomy with the scene's probe, with the cells of its grid divided by `between`."""
    scene, digest = anatomy.scene, map_digest(anatomy)
    beside = healthy_file(scene.folder / f"{scene.name}.toml")
    grid = _shipped(beside, digest) if between == 1 else None
    if grid is not None:
        return HealthyMap(grid)
    # Like the members of its family: their maps start from this map.
    is_quick = scene.family is not None or beside.is_file()
    path = cache_folder() / f"healthy-{digest}{'-quick' * is_quick}-{between}.npy"
    if path.is_file():
        return HealthyMap(np.load(path, allow_pickle=False))
    with StepProgress.on_stderr() as progress:
        quick, dtype = (quickened(anatomy, progress), np.float32) if is_quick else (anatomy, np.float64)
        grid = _pressed(quick, progress, dtype, between)
    keep_map(path, grid)
    return HealthyMap(grid)


def _shipped(path: Path, digest: str) -> FloatArray | None:
    """Map beside a scene file; None if it is missing, or of another organ or version."""
    if not path.is_file():
        return None
    with np.load(checked_content(path), allow_pickle=False) as archive:
        return archive["grid"] if str(archive["digest"]) == digest else None


def _pressed(anatomy: Anatomy, progress: StepProgress, dtype: type, between: int = 1) -> FloatArray:
    """Press the healthy organ at each site of the chart's grid; `HealthyMap.grid`, shape (m, m, 3).

    A coarser grid would alias the mesh, with 3 % changes of force within a cell, into a slope of the organ.
    """
    charted = charted_face(anatomy)
    grid = charted.grid_sites(between)
    # Unpressable places are moved to others of the grid.
    sites = {site.place.tobytes(): site for site in grid}
    presses = press_sites(anatomy, list(sites.values()), progress, dtype)
    values = dict(zip(sites, presses, strict=True))
    return as_map(np.array([values[site.place.tobytes()] for site in grid]))


def as_map(rows: FloatArray) -> FloatArray:
    """Values of all sites of a square grid (m m, k) as a map (m, m, k)."""
    side = math.isqrt(len(rows))
    return rows.reshape(side, side, -1)


def press_sites(
    anatomy: Anatomy, sites: Sequence[Site], progress: StepProgress, dtype: type = np.float64, name: str = ""
) -> FloatArray:
    """Presses on the healthy organ of an anatomy at sites, in lanes: rows of `HealthyMap.grid`, (n_site, 3).

    The progress shows `name`.

    Raises:
        ValueError: a press that ended in a fault or measured no force (states its place).
    """
    phases, lanes, chart = press_phases(anatomy.scene), LANES[dtype], charted_face(anatomy).chart
    batches = [sites[first : first + lanes] for first in range(0, len(sites), lanes)]

    def group() -> LaneGroup:
        return LaneGroup([Simulation(anatomy) for _ in range(lanes)], dtype)

    def press(own: LaneGroup, number: int) -> list[FloatArray]:
        batch = batches[number]
        pairs = zip(own.simulations, batch, strict=False)
        presses = [SitePress(simulation, site.point, site.normal) for simulation, site in pairs]
        press_in_lanes(own, presses, phases)
        advance(len(batch))
        return [np.append(_stiffness(anatomy, press), chart.along_axes(press.centre)) for press in presses]

    with progress.step(f"pressing the healthy organ {name}".strip(), len(sites)) as advance:
        rows = in_threads(group, press, len(batches))
    return np.array([row for batch in rows for row in batch])


def _stiffness(anatomy: Anatomy, press: SitePress) -> float:
    """Stiffness of a press on healthy tissue [N/m]."""
    result = press.result()
    force = float(matmul(result.force, press.normal))
    if result.fault or not force > 0.0:
        raise ValueError(
            f"scene {anatomy.scene.name!r}: a press on healthy tissue at {press.point.tolist()} m measured "
            f"{force:g} N {result.fault}: check palpation.press_depth and the palpable face"
        )
    return force / result.depth


def map_digest(anatomy: Anatomy) -> str:
    """Hash of a map's inputs: the scene without its lesions, the instrument's file, the physics' version."""
    scene = anatomy.scene
    parts = (
        *(scene.material, scene.capsule, scene.damping, scene.contact, scene.instrument, scene.timing),
        # The limits of a press.
        *(scene.limits.soft_force, scene.limits.hard_force),
        *(scene.palpation, scene.stiffness_rule, scene.gravity, scene.supports),
        tuple(region for region in scene.regions if not region.lesion),
        tuple(anchor for anchor in scene.anchors if anchor.is_elastic),
    )
    instrument = (scenes_folder() / "instruments" / scene.instrument.model).read_bytes()
    version = (PHYSICS_VERSION, MAP_VERSION)
    return content_digest(anatomy.mesh.points, anatomy.mesh.tets, anatomy.anchors, parts, instrument, version)


def cache_folder() -> Path:
    """Folder of the cache."""
    folder = os.environ.get(FOLDER_VARIABLE)
    return Path(folder or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "surgsim")


def keep_map(path: Path, grid: FloatArray) -> None:
    """Write a map atomically; a read-only folder is ignored."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            np.save(Path(folder, path.name), grid, allow_pickle=False)
            os.replace(Path(folder, path.name), path)
