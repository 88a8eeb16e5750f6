"""A scene's organ at haptic rate on this machine: a little added mass, then coarser cells."""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console
from scipy.spatial import KDTree

from msdm_core.errors import MeshError
from msdm_core.material import Material
from msdm_core.mesh import FloatArray, TetMesh, outward_facing, surface_carriers
from msdm_core.meshing import RegionShare, mesh_surface, tag_tets
from surgsim_apps.live.organ_choice import OrganChoice, chosen_organ
from surgsim_env.coupling import Simulation
from surgsim_env.palpation import press
from surgsim_env.scene import (
    Anatomy,
    Scene,
    anatomy_of,
    contact_radius,
    load_anatomy,
    with_added_mass,
)

# Largest processor time of a press over its simulated time; the remainder is for hand, pictures and jitter.
LOAD_MOST = 0.6
# Largest share of added mass. Steep tissue that does not relax keeps its substeps: on fewer a liver chatters.
MASS_SHARE = 0.03
# Power of the cells' edge with which the load falls about: 2 by the nodes of the face, the others by substeps. Least
# factor on the edge from one try to the next, and largest of all.
LOAD_POWER, GROWTH_LEAST, GROWTH_MOST = 4.0, 1.1, 2.0
# Depth of the finest of the coarser cells in contact radii: with 1 a spleen and a kidney have a sixth more nodes, and
# presses the same scatter; without it the largest error doubles.
FINE_DEPTH = 0.5
# A lattice's cells over the edges of its boundary: 1.08 on a liver, a spleen and a kidney.
CELL_PER_EDGE = 1.08
# Number of presses, every other of which has its error printed, and largest error without a warning.
SITES, FORCE_ERROR_MOST = 10, 0.10


@dataclass(frozen=True, eq=False)
class LiveOrgan:
    """Anatomy for a hand in real time.

    Fields:
        anatomy: the scene's, with mass scaling, on its own mesh or on coarser cells
        load: processor time of a press over its simulated time; 0 if it was not measured
        force_error: of presses on coarser cells, relative to the scene's mesh, at other places than those for the
            modulus; empty on that mesh
        node_count: of the scene's mesh
    """

    anatomy: Anatomy
    load: float
    force_error: FloatArray
    node_count: int

    @property
    def faults(self) -> tuple[str, ...]:
        """Remarks on a force error above FORCE_ERROR_MOST, and on a load above LOAD_MOST; empty without."""
        faults = []
        if (np.abs(self.force_error) > FORCE_ERROR_MOST).any():
            faults.append(
                f"forces differ from those on the scene's mesh by more than {FORCE_ERROR_MOST:.0%}: measure with "
                "surgsim palpate, or use a faster machine"
            )
        if self.load > LOAD_MOST:
            faults.append(f"steps may be late: a press takes more than {LOAD_MOST:.0%} of real time on this machine")
        return tuple(faults)

    @property
    def text(self) -> str:
        """Mesh, substeps, load and force error in a sentence."""
        scene, mesh = self.anatomy.scene, self.anatomy.mesh
        text = f"{scene.name}: {mesh.node_count} nodes, {scene.timing.substep_count} substeps"
        if self.load:
            text += f", a press takes {self.load:.0%} of real time"
        if not len(self.force_error):
            return text
        median, most = np.median(self.force_error), np.abs(self.force_error).max()
        return (
            f"{text}; for 1 kHz cells of {self.anatomy.palpable_cell * 1e3:.2g} mm in place of the scene's "
            f"{self.node_count} nodes: forces of {len(self.force_error)} presses differ by {median:+.0%} (median), by "
            f"{most:.0%} at most"
        )


def live_anatomy(scene: Scene, lesions: str, console: Console) -> Anatomy:
    """Anatomy of `live_organ` with a choice of lesions; prints its text and warns of its faults."""
    console.print(f"{scene.name}: meshing, and compiling if that was not done before ...", highlight=False)
    organ = live_organ(scene, OrganChoice(lesions=lesions))
    console.print(organ.text, highlight=False, soft_wrap=True)
    for fault in organ.faults:
        warnings.warn(fault, UserWarning, stacklevel=2)
    return organ.anatomy


def press_sites(anatomy: Anatomy, sites: FloatArray) -> tuple[FloatArray, float]:
    """Forces [N] (n,) of healthy presses at the points of the face nearest to sites [m] (n, 3), and their load.

    The load is the median processor time of this thread over the simulated time.
    """
    places = [anatomy.face.project(site) for site in sites]
    simulation, (point, normal) = Simulation(anatomy), places[0]
    simulation.reset(anatomy.organ(), point + 2.0 * anatomy.scene.instrument.tip_radius * normal)
    forces, loads = np.zeros(len(sites)), np.zeros(len(sites))
    for number, (point, normal) in enumerate(places):
        begin = time.thread_time()
        result = press(simulation, point, normal)
        loads[number] = (time.thread_time() - begin) / result.duration
        forces[number] = result.force
    return forces, float(np.median(loads))


def live_organ(
    scene: Scene,
    choice: OrganChoice,
    measure: Callable[[Anatomy, FloatArray], tuple[FloatArray, float]] = press_sites,
) -> LiveOrgan:
    """The scene's organ with the finest cells whose presses take at most LOAD_MOST of real time.

    The cells of the scene are tried first, with mass scaling (which also covers the stiffer organs of the sliders) and
    the fewest substeps for a little added mass; then coarser ones (`coarser_anatomy`), as long as the organ's parts
    allow them, and tissue softer by what these add to a press. The organ of a retraction keeps its cells.

    Args:
        scene: to be seen or felt.
        choice: the organ that must be stable.
        measure: forces [N] (n,) and load of healthy presses at points [m] (n, 3).

    Raises:
        ValueError: a scene without a valid mesh or a place to press.
    """
    steep = scene.material.stiffening is not None and scene.material.relaxation is None

    def scaled(anatomy: Anatomy) -> Anatomy:
        if steep:
            timing = replace(scene.timing, mass_scaling=True)
            return replace(anatomy, scene=replace(anatomy.scene, timing=timing))
        return with_added_mass(anatomy, lambda case: [chosen_organ(case, choice)], MASS_SHARE)

    if scene.retract is not None:
        anatomy = scaled(load_anatomy(scene))
        return LiveOrgan(anatomy, 0.0, np.zeros(0), anatomy.mesh.node_count)
    # The probe presses the organ of any instrument, at rest.
    fine = load_anatomy(replace(scene, instrument=replace(scene.instrument, model="probe.xml"), motions=()))
    rng = np.random.default_rng(0)
    sites = np.array([fine.face.random_point(rng, scene.palpation.face_margin)[0] for _ in range(SITES)])
    growth, anatomy, error = 1.0, scaled(fine), np.zeros(0)
    exact, load = measure(anatomy, sites)
    forces = exact
    while load > LOAD_MOST and growth < GROWTH_MOST:
        growth = min(growth * max((load / LOAD_MOST) ** (1.0 / LOAD_POWER), GROWTH_LEAST), GROWTH_MOST)
        try:
            anatomy = scaled(coarser_anatomy(fine, growth))
        except ValueError:
            break
        forces, load = measure(anatomy, sites)
    if anatomy.mesh is not fine.mesh:
        # Half of the sites choose the modulus, the others have the error.
        stiffer = float(np.median(forces[::2] / exact[::2]))
        anatomy = scaled(replace(anatomy, scene=_softer(anatomy.scene, stiffer)))
        error = measure(anatomy, sites[1::2])[0] / exact[1::2] - 1.0
    own = replace(anatomy.scene, instrument=scene.instrument, motions=scene.motions)
    return LiveOrgan(replace(anatomy, scene=own), load, error, fine.mesh.node_count)


def coarser_anatomy(fine: Anatomy, growth: float) -> Anatomy:
    """The anatomy on a lattice in the boundary of its mesh, of cells `growth` times as large, twice that elsewhere.

    Without the scene's fine surface, if that does not fit these cells.

    Raises:
        MeshError: a part or a region too thin for the cells.
    """
    scene, mesh = fine.scene, fine.mesh
    tip, palpation = scene.instrument.tip_radius, scene.palpation
    cell = growth * CELL_PER_EDGE * fine.palpable_cell
    points, triangles = mesh.points, mesh.boundary_triangles
    coarse = mesh_surface(
        points,
        triangles,
        cell_size=cell,
        coarse_cell_size=2.0 * cell,
        fine_triangles=outward_facing(points, triangles, scene.instrument.approach, palpation.face_angle_deg),
        fine_depth=FINE_DEPTH * contact_radius(tip, palpation.press_depth),
    )
    tags = {mesh.region_tag(region.name): region.name for region in scene.regions}
    if tags:
        # A region takes the tets nearest to its own, until it has its volume.
        owner = KDTree(coarse.points[coarse.tets].mean(axis=1)).query(points[mesh.tets].mean(axis=1))[1]
        volumes = {tag: np.where(mesh.region == tag, mesh.volumes, 0.0) for tag in tags}
        shares = [
            RegionShare(
                tag, name, np.bincount(owner, volumes[tag], coarse.tet_count) / coarse.volumes, volumes[tag].sum()
            )
            for tag, name in tags.items()
        ]
        coarse = TetMesh(coarse.points, coarse.tets, tag_tets(coarse, max(tags) + 1, shares), tags)
    anatomy = anatomy_of(scene, coarse)
    if anatomy.fine_surface is None:
        return anatomy
    try:
        surface_carriers(anatomy.fine_surface[0], coarse)
    except MeshError:
        # A vertex beyond the reach of the larger cells: the boundary of the tets is drawn.
        return anatomy_of(replace(scene, mesh=replace(scene.mesh, fine_surface=None)), coarse)
    return anatomy


def _softer(scene: Scene, stiffer: float) -> Scene:
    """The scene with the moduli of tissue, regions and capsule divided by a factor."""

    def softer(material: Material) -> Material:
        return replace(material, youngs_modulus=material.youngs_modulus / stiffer)

    capsule = scene.capsule
    return replace(
        scene,
        material=softer(scene.material),
        regions=tuple(replace(region, material=softer(region.material)) for region in scene.regions),
        capsule=capsule and replace(capsule, youngs_modulus=capsule.youngs_modulus / stiffer),
    )
