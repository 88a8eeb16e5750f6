"""How stiff a scene's healthy organ feels over its chart: what a press's stiffness is compared with."""

import hashlib
import os
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

import msdm_core
from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy, load_anatomy
from surgsim_env.lane_group import LaneGroup
from surgsim_env.palpation.chart import make_chart
from surgsim_env.palpation.charted_face import ChartedFace, interpolated
from surgsim_env.palpation.site_press import SitePress, press_in_lanes, press_phases
from surgsim_env.scene_files import scenes_folder
from surgsim_env.scenes import Scene, with_instrument
from surgsim_env.simulation import Simulation

# Organs that are pressed side by side.
LANES = 8
# Names the folder of the cache.
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

    That takes `phantom` some 5 s of processor time and `phantom_wide` 90 s, once: the map is kept in the folder that
    SURGSIM_CACHE names, else in the user's cache folder; where that cannot be written each process makes it anew.

    Raises:
        ValueError: a press on healthy tissue that came to a fault or felt nothing (says where).
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

    A coarser grid would take the mesh, which changes the force by some 3 % within a cell, for a slope of the organ.
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
                    f"scene {anatomy.scene.name!r}: a press on healthy tissue at {press.point.tolist()} m felt "
                    f"{force:g} N {result.fault}: check palpation.press_depth and the palpable face"
                )
            stiffness[site.place.tobytes()] = force / result.depth
    values = [stiffness[site.place.tobytes()] for site in every]
    return np.array(values).reshape(charted.chart.side_count, -1)


def _digest(anatomy: Anatomy) -> str:
    """Of all that the map follows from, the code of the organ and of the press included."""
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
    press = [here.with_name(f"{name}.py") for name in ("chart", "charted_face", "scan", "site_press")]
    press += [here.parents[1] / f"{name}.py" for name in ("instrument", "palpable_face")]
    press += [scenes_folder() / "instruments" / scene.instrument.model]
    for path in (*sorted(core.glob("*.py")), *sorted(here.parents[1].glob("*kernels.py")), *press, here):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _folder() -> Path | None:
    """Where maps are kept; None for an account without a home."""
    named = os.environ.get(FOLDER_VARIABLE)
    if named:
        return Path(named)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "surgsim"
    except RuntimeError:
        return None


def _keep(path: Path, grid: FloatArray) -> None:
    """Write the map whole or not at all; a folder that cannot be written costs time, nothing else."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix="part-") as folder:
            part = Path(folder, path.name)
            np.save(part, grid, allow_pickle=False)
            os.replace(part, path)
    except OSError:
        return
