"""The anatomy of a scene: its organ's mesh, anchored nodes and palpable face, and organs compiled with lesions."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.arithmetic import cos, matmul, norm
from msdm_core.errors import OrganError
from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.material.regions import Lesion, Material
from msdm_core.mesh.geodesic import NearestTriangle, SurfaceDistance
from msdm_core.mesh.ordering import in_sweep_order
from msdm_core.mesh.quality import surface_cell
from msdm_core.mesh.surface import node_normals, triangles_facing
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh, mesh_surface
from msdm_core.organ.compile import OrganSpec, compile_organ
from msdm_core.organ.foundation import Foundation
from msdm_core.organ.motion import Motion
from msdm_core.organ.stability import scale_mass, stable_dt
from msdm_core.organ.support import SupportLaw
from surgsim_env.scene.model import Anchor, LesionDraw, Scene, scaled_step, substeps_needed
from surgsim_env.scene.palpable_surface import PalpableFace, find_palpable_face, warn_of_coarse_cells

# Tolerance of a drawn lesion's cover [m].
COVER_TOLERANCE = 1e-4
# Distance from a fixed node, in tip radii, within which the node dominates a press.
SUPPORT_TIP_RADII = 2.0
# Largest share of an organ's mass that may be added to save substeps, and the smallest number of substeps.
ADDED_MASS_SHARE, SUBSTEPS_FEWEST = 0.01, 2
# Largest number of organ substeps in a haptic step: more would take hours.
SUBSTEPS_MOST = 200
# Rounding error of the cosine between a surface's normal and a direction.
SIDE_ROUNDING = 1e-9


# Vertices [m] (n_vertex, 3) and outward triangles (n_triangle, 3).
Surface = tuple[FloatArray, IntArray]
# Map from points of the scene's organ [m] (n, 3) to points of a member of its family [m] (n, 3).
Deformation = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class MemberName:
    """Member of a family: its split, one of `model.SPLITS`, and its number in it from 0 on."""

    split: str
    number: int

    def __str__(self) -> str:
        return f"{self.split} {self.number}"


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Scene with its mesh, anchored nodes (n_anchor,), palpable face and elastic foundations.

    A member of a family (`scene.family`) also has its name, the scene's own organ and the deformation from that.
    """

    scene: Scene
    mesh: TetMesh
    anchors: IntArray
    face: PalpableFace
    foundations: tuple[Foundation, ...] = ()
    member: MemberName | None = None
    template: "Anatomy | None" = None
    deformation: Deformation | None = None

    @cached_property
    def fine_surface(self) -> Surface | None:
        """Fine surface of the scene, read with the first picture; None for a scene without one.

        Raises:
            MeshError: the file cannot be read as a surface.
        """
        source = self.scene.mesh.fine_surface
        if source is None:
            return None
        # Imports trimesh, so only for pictures.
        from msdm_core.mesh_files.surface_io import read_surface

        vertices, triangles = read_surface(self.scene.folder / source.file, length_unit=source.length_unit)
        return self._moved(vertices), triangles

    def _moved(self, points: FloatArray) -> FloatArray:
        """Points of the scene's organ [m] (n, 3) mapped into this one [m] (n, 3)."""
        return points if self.deformation is None else self.deformation(points)

    @cached_property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of a box around the organ and all members of its family [m], (3,) each."""
        points, family = (self.template or self).mesh.points, self.scene.family
        lower, upper = points.min(axis=0), points.max(axis=0)
        if family is None:
            return lower, upper
        growth = (family.longest - 1.0) * 0.5 * (upper - lower)
        return lower - growth, upper + growth

    @property
    def outer_surface(self) -> Surface:
        """Drawn surface of the organ at rest: the fine surface, else the boundary of the tets.

        Raises:
            MeshError: the fine surface cannot be read.
        """
        return self.fine_surface or (self.mesh.points, self.mesh.boundary_triangles)

    @cached_property
    def ground_motions(self) -> tuple[Motion, ...]:
        """Displacement of the organ's ground by a unit of each motion of the scene."""
        return tuple(motion.ground(self.mesh.points) for motion in self.scene.motions)

    @cached_property
    def foundation_nodes(self) -> IntArray:
        """Surface nodes on elastic foundations, shape (n_held,)."""
        held = [np.asarray(foundation.nodes, dtype=np.int32) for foundation in self.foundations]
        return np.unique(np.concatenate(held)) if held else np.zeros(0, dtype=np.int32)

    @cached_property
    def palpable_cell(self) -> float:
        """Edge of the cells at the palpable face [m]."""
        return surface_cell(self.mesh, self.face.triangles)

    @cached_property
    def downward(self) -> FloatArray:
        """Unit vector down in pictures: gravity's direction, or without gravity the approach."""
        gravity = np.asarray(self.scene.gravity, dtype=np.float64)
        return gravity / norm(gravity) if gravity.any() else self.face.approach

    @cached_property
    def along_surface(self) -> SurfaceDistance:
        """Geodesic distances on the resting surface."""
        return SurfaceDistance(self.mesh.points, self.mesh.boundary_triangles)

    def clear_of_supports(self, points: FloatArray) -> NDArray[np.bool_]:
        """True for points [m] (n_point, 3) far enough from supports for a press to measure tissue, shape (n_point,).

        Fixed nodes are farther than SUPPORT_TIP_RADII; elastic foundations, which yield, farther than one tip radius.
        """
        tip, nodes = self.scene.instrument.tip_radius, self.mesh.points
        held = ((nodes[self.anchors], SUPPORT_TIP_RADII * tip), (nodes[self.foundation_nodes], tip))
        return np.array(
            [all((norm(near - point, axis=1) > gap).all() for near, gap in held) for point in points],
            dtype=np.bool_,
        )

    @cached_property
    def _face_supports(self) -> FloatArray:
        """Fixed and elastically held nodes of the palpable face [m], shape (n, 3)."""
        held = np.union1d(self.anchors, self.foundation_nodes)
        return self.mesh.points[np.intersect1d(held, self.face.triangles)]

    def is_covered(self, point: FloatArray) -> bool:
        """True if a ligament or another support covers a point of the palpable face [m] (3,).

        It then holds nodes within a tip radius: the tip would press the support, not the tissue.
        """
        distance = norm(self._face_supports - point, axis=1)
        return bool((distance <= self.scene.instrument.tip_radius).any())

    def organ(self, lesions: Sequence[Lesion] = (), *, modulus_factor: float = 1.0) -> OrganModel:
        """Compile the organ with lesions, and a factor on all moduli of the healthy tissue and its capsule.

        With the scene's `mass_scaling`, mass is added for its number of substeps (`OrganModel.added_mass`).
        """
        if not lesions and modulus_factor == 1.0:
            return self._healthy_organ
        return self.compiled(self.specification(lesions, modulus_factor=modulus_factor))

    @cached_property
    def _healthy_organ(self) -> OrganModel:
        """Organ shared by all simulations of the scene, with read-only arrays; its stable step takes time to find."""
        return self.compiled(self.specification())

    def specification(self, lesions: Sequence[Lesion] = (), *, modulus_factor: float = 1.0) -> OrganSpec:
        """Specification of `organ`, for further changes by an episode's draw."""
        scene, capsule = self.scene, self.scene.capsule
        material = _stiffer(scene.material, modulus_factor)
        regions = [region.as_lesion for region in scene.regions if not region.lesion]
        if capsule is not None:
            capsule = replace(capsule, youngs_modulus=capsule.youngs_modulus * modulus_factor)
        return OrganSpec(
            mesh=self.mesh,
            materials=material,
            capsule=capsule,
            lesions=(*(replace(part, material=_stiffer(part.material, modulus_factor)) for part in regions), *lesions),
            anchors=self.anchors,
            foundations=self.foundations,
            damping=scene.damping,
            # Nodes in the middle of a block's top faces are light otherwise, and turn tets inside out first.
            mass_scheme="voronoi" if scene.mesh.block is not None and scene.mesh.block.top_nodes else "barycentric",
            stiffness_rule=scene.stiffness_rule,
            gravity=scene.gravity,
            supports=scene.supports,
            support_law=SupportLaw(scene.contact.stiffness, scene.contact.damping),
            motions=self.ground_motions,
        )

    def compiled(self, specification: OrganSpec) -> OrganModel:
        """Compile a specification, with mass added as in `organ`."""
        organ, timing, law = compile_organ(specification), self.scene.timing, self.scene.contact.law
        if (
            not timing.mass_scaling
            or substeps_needed(timing.haptic_step, stable_dt(organ, law)) <= timing.substep_count
        ):
            return organ
        return scale_mass(organ, scaled_step(timing.haptic_step, timing.substep_count), law)

    def random_lesion(
        self, rng: np.random.Generator, draw: LesionDraw | None = None, *, modulus_factor: float = 1.0
    ) -> Lesion:
        """Draw a lesion below a random point of the palpable face.

        Its cover is the distance from its ball to the organ's surface, to 0.1 mm; a place without room for ball and
        cover (thin or strongly curved) is drawn again.

        Args:
            rng: source of random numbers.
            draw: its ranges; the scene's by default.
            modulus_factor: of the tissue around it, the reference of its modulus ratio.

        Raises:
            ValueError: the scene has no [lesion] table, or 200 draws give no lesion.
        """
        draw = self.scene.lesion if draw is None else draw
        if draw is None:
            raise ValueError(f"scene {self.scene.name!r} has no [lesion] table to draw a lesion from: add one")
        radius = float(rng.uniform(*draw.radius))
        cover = float(rng.uniform(*draw.cover))
        ratio = float(rng.uniform(*draw.modulus_ratio)) * modulus_factor
        for _ in range(200):
            point, normal = self.face.random_point(rng, draw.rim_distance)
            centre = self.centres_below(point[None], normal[None], cover + radius)[0]
            if np.isfinite(centre).all():
                return self.lesion_at(centre, radius, ratio, "lesion")
        raise ValueError(
            f"scene {self.scene.name!r}: no room for a lesion of radius {radius * 1000:.3g} mm under "
            f"{cover * 1000:.3g} mm of tissue: use smaller lesions"
        )

    def centres_below(self, points: FloatArray, normals: FloatArray, distance: float) -> FloatArray:
        """Points on the inward normals (n, 3) of points (n, 3) [m] at a distance from the organ's surface [m], (n, 3).

        NaN if there is none inside the organ, because another side of it is near.
        """
        depth = np.full(len(points), distance)
        centres, pending = np.full((len(points), 3), np.nan), np.arange(len(points))
        for _ in range(20):
            trial = points[pending] - normals[pending] * depth[pending, None]
            gap = distance - self._free_surface.distances(trial)
            met = np.abs(gap) <= COVER_TOLERANCE
            centres[pending[met]] = trial[met]
            depth[pending] += gap
            # A curved surface needs a little more depth; far more means that another side of the organ is near.
            pending = pending[~met & (np.abs(depth[pending] - distance) <= 0.01)]
            if not len(pending):
                break
        for index in np.flatnonzero(np.isfinite(centres).all(axis=1)):
            # Beyond a thin wall a point is as far from the surface as inside.
            if not self._nearest_surface(centres[index])[1]:
                centres[index] = np.nan
        return centres

    @cached_property
    def _free_surface(self) -> NearestTriangle:
        triangles = self.mesh.boundary_triangles
        held = np.isin(triangles, self.anchors).all(axis=1)
        return NearestTriangle(self.mesh.points[triangles[~held]])

    def check_inside(self, lesion: Lesion) -> None:
        """Check that a ball lies inside the organ.

        Raises:
            ValueError: it sticks out, or its centre is outside; states the distance and the place.
        """
        if lesion.region is not None or lesion.radius is None:
            return
        centre = np.asarray(lesion.centre, dtype=np.float64)
        nearest, inward = self._nearest_surface(centre)
        depth = float(norm(nearest - centre))
        x, y, z = nearest * 1e3
        if not inward:
            raise ValueError(
                f"{lesion.name}: its centre is {depth * 1e3:.3g} mm outside the surface at {x:.1f}, {y:.1f}, "
                f"{z:.1f} mm; the rule is that a lesion lies inside the organ (coordinates are metres)"
            )
        if depth < lesion.radius - COVER_TOLERANCE:
            raise ValueError(
                f"{lesion.name}: its ball of radius {lesion.radius * 1e3:.3g} mm sticks out of the organ by "
                f"{(lesion.radius - depth) * 1e3:.3g} mm at {x:.1f}, {y:.1f}, {z:.1f} mm: move it deeper or make it "
                "smaller"
            )

    def _nearest_surface(self, point: FloatArray) -> tuple[FloatArray, bool]:
        """Nearest point of the surface to a point [m], both (3,), and true for a point on its inner side."""
        triangle, weights = self._surface(point)
        corners = self._surface.corners[triangle]
        nearest = matmul(weights, corners)
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        return nearest, bool(matmul(nearest - point, normal) > 0.0)

    @cached_property
    def _surface(self) -> NearestTriangle:
        return NearestTriangle(self.mesh.points[self.mesh.boundary_triangles])

    def lesion_below(self, point: FloatArray, radius: float, cover: float, ratio: float, name: str) -> Lesion:
        """Sphere with its top `cover` below a point of the surface [m], `ratio` times as stiff as the tissue."""
        surface_point, normal = self.face.project(point)
        centre = surface_point - normal * (cover + radius)
        return self.lesion_at(centre, radius, ratio, name)

    def lesion_at(self, centre: ArrayLike, radius: float, ratio: float, name: str) -> Lesion:
        """Sphere at a centre [m], `ratio` times as stiff as the tissue."""
        return self.lesion_of_modulus(centre, radius, ratio * self.scene.material.youngs_modulus, name)

    def lesion_of_modulus(self, centre: ArrayLike, radius: float, youngs_modulus: float, name: str) -> Lesion:
        """Sphere at a centre [m] with a Young's modulus [Pa], otherwise like the tissue."""
        x, y, z = np.asarray(centre, dtype=np.float64).tolist()
        material = replace(self.scene.material, youngs_modulus=youngs_modulus)
        return Lesion(centre=(x, y, z), radius=radius, material=material, name=name)

    def demonstration_lesions(self) -> list[Lesion]:
        """Lesions of the scene file: regions of its mesh, and balls."""
        lesions = [region.as_lesion for region in self.scene.regions if region.lesion]
        for ball in self.scene.demonstration:
            below = self._moved(np.array([ball.below]))[0]
            lesions.append(self.lesion_below(below, ball.radius, ball.cover, ball.modulus_ratio, ball.name))
        return lesions


def _stiffer(material: Material | None, factor: float) -> Material:
    assert material is not None
    return replace(material, youngs_modulus=material.youngs_modulus * factor)


def load_anatomy(scene: Scene) -> Anatomy:
    """Mesh a scene's organ and determine its anchors and palpable face; cached by scene and files.

    Warns once if the cells of its palpable face are larger than the contact radius: the mesh would be felt.
    """
    sources = (scene.mesh.surface, scene.mesh.tets, scene.mesh.fine_surface)
    files = [scene.folder / source.file for source in sources if source is not None]
    return _load_anatomy(scene, tuple(file.stat().st_mtime_ns if file.is_file() else None for file in files))


@lru_cache(maxsize=8)
def _load_anatomy(scene: Scene, file_times: tuple[int | None, ...]) -> Anatomy:
    """`load_anatomy`, cached until the modification time of one of its files changes [ns]."""
    anatomy = anatomy_of(scene, _load_mesh(scene))
    # The organ of a retraction is not palpated.
    if scene.retract is None:
        warn_of_coarse_cells(
            f"scene {scene.name!r}", anatomy.palpable_cell, scene.instrument.tip_radius, scene.palpation.press_depth
        )
    return anatomy


def with_added_mass(
    anatomy: Anatomy, organs_of: Callable[[Anatomy], Iterable[OrganModel]], share_most: float = ADDED_MASS_SHARE
) -> Anatomy:
    """Anatomy with mass scaling and the fewest substeps for an added share of each organ's mass up to `share_most`.

    Static forces do not depend on masses: a press that comes to rest measures the same.

    Args:
        anatomy: with the largest number of substeps.
        organs_of: compiles the organs to be stable, one after the other.
        share_most: largest added mass over an organ's own.
    """
    timing = replace(anatomy.scene.timing, mass_scaling=True)
    for count in range(SUBSTEPS_FEWEST, timing.substep_count):
        fewer = replace(anatomy, scene=replace(anatomy.scene, timing=replace(timing, substep_count=count)))
        try:
            if all(organ.added_mass <= share_most * organ.node_mass.sum() for organ in organs_of(fewer)):
                return fewer
        except OrganError:
            # Needs more than the limit of mass scaling.
            continue
    return replace(anatomy, scene=replace(anatomy.scene, timing=timing))


def with_substeps(
    anatomy: Anatomy, organs: Sequence[OrganModel], *, least: int = 1, most: float = SUBSTEPS_MOST
) -> Anatomy:
    """Anatomy with enough substeps, and at least `least`, for stable contact with each of the organs.

    Raises:
        ValueError: more than `most` substeps are needed.
    """
    scene = anatomy.scene
    step = min(stable_dt(organ, scene.contact.law) for organ in organs)
    count = max(substeps_needed(scene.timing.haptic_step, step), least)
    if count > most:
        raise ValueError(
            f"this organ needs {count} substeps in {scene.timing.haptic_step:g} s, its stable step is {step:.3g} s; at "
            f"most {most} are allowed: are the moduli in pascals? Else use larger cells"
        )
    return replace(anatomy, scene=replace(scene, timing=replace(scene.timing, substep_count=count)))


def anatomy_of(scene: Scene, mesh: TetMesh) -> Anatomy:
    """Anatomy of a scene on a given mesh, without reading the scene's own."""
    for region in scene.regions:
        mesh.region_tag(region.name)
    face = find_palpable_face(mesh, scene.instrument.approach, scene.palpation, scene.instrument.tip_radius)
    fixed, foundations = _held(mesh, scene.anchors)
    return Anatomy(scene, mesh, fixed, face, foundations)


def _load_mesh(scene: Scene) -> TetMesh:
    source = scene.mesh
    if source.block is not None:
        block = source.block
        return box_mesh(block.size, block.cells, top_nodes=block.top_nodes)
    # Imports meshio and trimesh, so only for scenes with files.
    from msdm_core.mesh_files.mesh_io import read_mesh
    from msdm_core.mesh_files.surface_io import read_surface

    if source.surface is not None:
        surface, palpation = source.surface, scene.palpation
        vertices, triangles = read_surface(scene.folder / surface.file, length_unit=surface.length_unit)
        if surface.coarse_cell_size is None:
            return mesh_surface(vertices, triangles, cell_size=surface.cell_size)
        # Fine at the palpable face, coarser elsewhere.
        return mesh_surface(
            vertices,
            triangles,
            cell_size=surface.cell_size,
            coarse_cell_size=surface.coarse_cell_size,
            fine_triangles=triangles_facing(vertices, triangles, scene.instrument.approach, palpation.face_angle_deg),
            fine_depth=surface.fine_depth,
        )
    assert source.tets is not None
    return in_sweep_order(read_mesh(scene.folder / source.tets.file, length_unit=source.tets.length_unit))


def _held(mesh: TetMesh, anchors: Sequence[Anchor]) -> tuple[IntArray, tuple[Foundation, ...]]:
    """Fixed nodes of the anchors, and the foundations of the elastic ones."""
    fixed: NDArray[np.bool_] = np.zeros(mesh.node_count, dtype=bool)
    on_surface = np.zeros(mesh.node_count, dtype=bool)
    on_surface[mesh.boundary_nodes] = True
    foundations = []
    for anchor in anchors:
        inside = _inside(mesh, anchor, on_surface)
        if not inside.any():
            raise ValueError(
                f"anchor {anchor.name!r} holds no node of the organ; move or enlarge it (coordinates are metres)"
            )
        if anchor.stiffness is None or anchor.shear_stiffness is None:
            fixed |= inside
        else:
            nodes = np.flatnonzero(inside).astype(np.int32)
            foundations.append(Foundation(anchor.name, nodes, anchor.stiffness, anchor.shear_stiffness))
    if not anchors:
        raise ValueError("nothing holds the organ: give at least one anchor, or it is pushed away")
    return np.flatnonzero(fixed).astype(np.int32), tuple(foundations)


def _inside(mesh: TetMesh, anchor: Anchor, on_surface: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True for nodes held by an anchor, shape (n_node,): surface nodes, or all nodes in the box of a fixed one."""
    if anchor.box is not None:
        within = ((mesh.points >= anchor.box.lower) & (mesh.points <= anchor.box.upper)).all(axis=1)
        return np.asarray(within & on_surface if anchor.is_elastic else within, dtype=np.bool_)
    if anchor.side is not None:
        direction = np.asarray(anchor.side.direction) / norm(anchor.side.direction)
        if anchor.side.angle_deg == 180.0:
            return on_surface
        facing = matmul(node_normals(mesh.points, mesh.boundary_triangles), direction)
        # The flanks of a block, at a right angle up to rounding, face neither way.
        return on_surface & np.asarray(facing > float(cos(math.radians(anchor.side.angle_deg))) + SIDE_ROUNDING)
    assert anchor.ball is not None
    return on_surface & (norm(mesh.points - np.asarray(anchor.ball.centre), axis=1) <= anchor.ball.radius)
