"""Stiffness of a scene's healthy organ over its chart, the reference of contrast, cached on disk."""

import hashlib
import os
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

import msdm_core
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.lane_group import LaneGroup
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.palpation.chart import ChartedFace, interpolated, make_chart
from surgsim_env.palpation.press import SitePress, press_in_lanes, press_phases
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import scenes_folder, with_instrument
from surgsim_env.scene.model import Scene

# Organs that are pressed side by side.
LANES = 8
# Environment variable with the cache's folder.
FOLDER_VARIABLE = "SURGSIM_CACHE"


@dataclass(frozen=True, eq=False)
class HealthyMap:
    """Stiffness of presses on healthy tissue of nominal modulus [N/m], on a square grid over the chart (m, m)."""

    grid: FloatArray

    def stiffness(self, places: ArrayLike) -> FloatArray:
        """At places of the chart (..., 2) [N/m], shape (...)."""
        return interpolated(self.grid, places)


@lru_cache(maxsize=8)
def charted_face(anatomy: Anatomy) -> ChartedFace:
    """The palpable face of an anatomy with its chart; the same anatomy gives the same object."""
    return ChartedFace(anatomy.face, make_chart(anatomy.face, anatomy.scene.instrument.tip_radius))


def healthy_map(scene: Scene) -> HealthyMap:
    """The map of a scene, from its cache on disk or by pressing its healthy organ at every site of the chart's grid.

    Pressing takes 5 s of processor time for `phantom` and 90 s for `phantom_wide`. The cache is the folder named by
    SURGSIM_CACHE, else the user's cache folder; if it is not writable, each process computes the map.

    Raises:
        ValueError: a press on healthy tissue that ended in a fault or measured no force (says where).
    """
    return _healthy_map(load_anatomy(with_instrument(scene, "probe")))


@lru_cache(maxsize=8)
def _healthy_map(anatomy: Anatomy) -> HealthyMap:
    folder = _folder()
    if folder is None:
        return HealthyMap(_pressed(anatomy))
    path = folder / f"healthy-{_digest(anatomy)}.npy"
    try:
        grid = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        grid = _pressed(anatomy)
        _keep(path, grid)
    return HealthyMap(grid)


def _pressed(anatomy: Anatomy) -> FloatArray:
    """Press the healthy organ at each site of the chart's grid; stiffness [N/m], shape (m, m).

    A coarser grid would alias the mesh, which changes the force by some 3 % within a cell, into a slope of the organ.
    """
    charted, phases = charted_face(anatomy), press_phases(anatomy.scene)
    every = [charted.site(place) for place in charted.chart.sites]
    # Places that may not be pressed are moved to others of the grid.
    sites = list({site.place.tobytes(): site for site in every}.values())
    simulations = [Simulation(anatomy) for _ in range(LANES)]
    group = LaneGroup(simulations)
    stiffness: dict[bytes, float] = {}
    for first in range(0, len(sites), LANES):
        chosen = range(first, min(first + LANES, len(sites)))
        presses = [SitePress(simulations[n - first], sites[n].point, sites[n].normal) for n in chosen]
        press_in_lanes(group, [*presses, *[None] * (LANES - len(presses))], phases)
        for site, press in zip(sites[first : chosen.stop], presses, strict=True):
            result = press.result()
            force = float(result.force @ press.normal)
            if result.fault or not force > 0.0:
                raise ValueError(
                    f"scene {anatomy.scene.name!r}: a press on healthy tissue at {press.point.tolist()} m measured "
                    f"{force:g} N {result.fault}: check palpation.press_depth and the palpable face"
                )
            stiffness[site.place.tobytes()] = force / result.depth
    values = [stiffness[site.place.tobytes()] for site in every]
    return np.array(values).reshape(charted.chart.side_count, -1)


def _digest(anatomy: Anatomy) -> str:
    """Hash of everything that determines the map, including the source of the organ and of the press."""
    scene = anatomy.scene
    digest = hashlib.blake2b(digest_size=12)
    for array in (anatomy.mesh.points, anatomy.mesh.tets, anatomy.anchors):
        digest.update(np.ascontiguousarray(array).data)
    parts = (
        *(scene.material, scene.capsule, scene.damping, scene.contact, scene.instrument, scene.timing, scene.limits),
        *(scene.palpation, scene.stiffness_rule, scene.gravity, scene.supports, scene.support_law),
        tuple(region for region in scene.regions if not region.lesion),
    )
    digest.update(repr(parts).encode())
    core, here = Path(msdm_core.__file__).parent, Path(__file__)
    package = here.parents[1]
    press = [here.with_name(f"{name}.py") for name in ("chart", "press")]
    press += [package / "instruments" / "instrument.py", package / "scene" / "palpable_surface.py"]
    press += [scenes_folder() / "instruments" / scene.instrument.model]
    for path in (*sorted(core.rglob("*.py")), *sorted(package.rglob("*kernels.py")), *press, here):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _folder() -> Path | None:
    """The cache's folder; None for an account without a home."""
    named = os.environ.get(FOLDER_VARIABLE)
    if named:
        return Path(named)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "surgsim"
    except RuntimeError:
        return None


def _keep(path: Path, grid: FloatArray) -> None:
    """Write the map atomically; a folder that is not writable is ignored."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix="part-") as folder:
            part = Path(folder, path.name)
            np.save(part, grid, allow_pickle=False)
            os.replace(part, path)
    except OSError:
        return
