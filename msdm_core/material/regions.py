"""Materials of an organ's regions (parenchyma, capsule, lesions), damping, and the moduli of each tet.

A tet partly inside a lesion has mixed moduli; a Poisson's ratio above that of springs adds a volume term, of which a
part is averaged at nodes.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import dot, expm1, log1p, matmul, norm, power
from msdm_core.errors import OrganError, require_positive
from msdm_core.material.tissue_law import Relaxation, Stiffening
from msdm_core.mesh.tet_mesh import TET_EDGES, FloatArray, TetMesh

# Smallest share of a lesion inside the organ.
LESION_SHARE_INSIDE = 0.5

# Largest rate [1/s] and time [s] of damping: beyond any tissue, and no stable step rounds to 0.
DAMPING_MOST = 1e6

# Smallest and largest radius of a lesion [m]: beyond any organ, and quotients do not overflow.
SMALLEST, FARTHEST = 1e-6, 1e6

# Points per edge of the barycentric lattice in a sampled tet: 165 points.
SAMPLES_PER_EDGE = 9


@dataclass(frozen=True)
class Material:
    """An isotropic tissue: linear and elastic, unless it stiffens or relaxes.

    Args:
        youngs_modulus: E at rest and in equilibrium [Pa], above 0.
        density: [kg/m^3], above 0.
        poisson_ratio: nu, at least 1/4 (springs alone give 1/4; the volume term adds to it) and below 1/2.
        stiffening: with strain, or None.
        relaxation: of its tension with time, or None.

    Raises:
        OrganError: names the field, its value and its range.
    """

    youngs_modulus: float
    density: float
    poisson_ratio: float = 0.25
    stiffening: Stiffening | None = None
    relaxation: Relaxation | None = None

    def __post_init__(self) -> None:
        require_positive("youngs_modulus", self.youngs_modulus, "Pa")
        require_positive("density", self.density, "kg/m^3")
        if not 0.25 <= self.poisson_ratio < 0.5:
            raise OrganError(
                f"poisson_ratio is {self.poisson_ratio}; a spring network with a volume term reaches 0.25 <= nu < 0.5: "
                "use 0.40 to 0.45 for soft tissue"
            )

    @property
    def strain_supported(self) -> float:
        """Largest equivalent strain up to which recorded presses support the law; infinite if not known."""
        supported = None if self.stiffening is None else self.stiffening.strain_supported
        return math.inf if supported is None else supported

    @property
    def spring_modulus(self) -> float:
        """Modulus in formula (6) for the shear modulus E / (2 (1 + nu)): E_s = E (1.25 / (1 + nu)) [Pa].

        Springs alone have lambda = mu = (2/5) E_s. At nu = 1/4 this is E to the bit.
        """
        return self.youngs_modulus * (1.25 / (1.0 + self.poisson_ratio))

    @property
    def volume_modulus(self) -> float:
        """Modulus of the volume term, K_t = lambda - mu = E (4 nu - 1) / (2 (1 + nu) (1 - 2 nu)) [Pa]."""
        nu = self.poisson_ratio
        return self.youngs_modulus * (4.0 * nu - 1.0) / (2.0 * (1.0 + nu) * (1.0 - 2.0 * nu))


@dataclass(frozen=True)
class Damping:
    """Rayleigh damping D = alpha M + beta K (Sala et al. 2011, section II-C).

    A mode of angular frequency w decays with the ratio alpha / (2 w) + beta w / 2.

    Args:
        alpha: mass-proportional rate [1/s], at least 0; drag against the fixed world.
        beta: stiffness-proportional time [s], at least 0; along each spring and on each tet's volume.
    """

    alpha: float
    beta: float = 0.0

    def __post_init__(self) -> None:
        for name, unit in (("alpha", "1/s"), ("beta", "s")):
            value = getattr(self, name)
            if not 0.0 <= value <= DAMPING_MOST:
                raise OrganError(
                    f"damping: {name} is {value} {unit}; it must be at least 0 and at most {DAMPING_MOST:g}"
                )


@dataclass(frozen=True)
class Capsule:
    """Outer layer of an organ (stroma).

    With a thickness, a membrane of stiffness E_c h_c on any mesh. Without, the paper's rule: the tets with a face on
    the boundary have this modulus, a layer of a sixth of a cell, with a membrane stiffness of 0.29 cell (E_c - E) that
    grows with the cell. A layer thicker than a cell is a region of the mesh.

    Args:
        youngs_modulus: E_c [Pa], above 0.
        thickness: h_c [m], above 0, or None.
    """

    youngs_modulus: float
    thickness: float | None = None

    def __post_init__(self) -> None:
        require_positive("capsule: youngs_modulus", self.youngs_modulus, "Pa")
        if self.thickness is not None:
            require_positive("capsule: thickness", self.thickness, "m")


@dataclass(frozen=True)
class Lesion:
    """A region of its own material: a sphere (centre, radius), an ellipsoid (centre, radii) or a tagged mesh region.

    Args:
        centre: (x, y, z) [m].
        radius: of a sphere [m].
        material: of the lesion.
        name: in messages and reports.
        radii: half axes along x, y, z of an ellipsoid [m], instead of radius.
        region: name of a mesh region, instead of centre and radius.
    """

    centre: tuple[float, float, float] | None = None
    radius: float | None = None
    material: Material | None = None
    name: str = "lesion"
    radii: tuple[float, float, float] | None = None
    region: str | None = None

    def __post_init__(self) -> None:
        if self.region is not None:
            return
        if self.centre is None or (self.radius is None) == (self.radii is None):
            raise OrganError(f"{self.name}: give a centre and either radius or radii, or a mesh region")
        axes = self.half_axes
        if not ((axes >= SMALLEST) & (axes <= FARTHEST)).all():
            size = f"radius is {self.radius} m" if self.radii is None else f"radii are {self.radii} m"
            raise OrganError(f"{self.name}: {size}; the rule is {SMALLEST:g} to {FARTHEST:g} m")

    @property
    def half_axes(self) -> FloatArray:
        """Half axes along x, y, z [m], shape (3,)."""
        return np.full(3, self.radius) if self.radii is None else np.asarray(self.radii, dtype=np.float64)


def lesion_fraction(mesh: TetMesh, lesion: Lesion) -> FloatArray:
    """Share of each tet's volume inside a lesion, in [0, 1], shape (n_tet,).

    Tets with all corners inside an ellipsoid are full (it is convex); those near its surface are sampled at 165 points:
    a share is accurate to about 0.01 (0.04 at worst).

    Raises:
        OrganError: a lesion outside the organ or smaller than a cell; names the lesion, the value and the rule.
    """
    if lesion.region is not None:
        return (mesh.region == mesh.region_tag(lesion.region)).astype(np.float64)
    axes = lesion.half_axes
    scaled = (mesh.points - np.asarray(lesion.centre)) / axes
    inside = dot(scaled, scaled) <= 1.0
    corners_inside = inside[mesh.tets].sum(axis=1)
    fraction = (corners_inside == 4).astype(np.float64)
    centroid = scaled[mesh.tets].mean(axis=1)
    reach = norm(scaled[mesh.tets] - centroid[:, None], axis=2).max(axis=1)
    near = (norm(centroid, axis=1) < 1.0 + reach) & (corners_inside < 4)
    samples = tet_samples(scaled[mesh.tets[near]])
    fraction[near] = (dot(samples, samples) <= 1.0).mean(axis=1)
    _check_lesion(mesh, lesion, axes, fraction)
    return fraction


def lesion_extent(mesh: TetMesh, lesion: Lesion) -> tuple[FloatArray, FloatArray]:
    """Centre [m] and half axes along x, y, z [m] of a lesion, each (3,).

    A tagged region has those of the ellipsoid with its centroid and variances: a solid ellipsoid has a^2 / 5 along a
    half axis a, a tet with corners x_i about the origin (sum x_i^2 + (sum x_i)^2) / 20.
    """
    if lesion.region is None:
        return np.asarray(lesion.centre, dtype=np.float64), lesion.half_axes
    chosen = mesh.region == mesh.region_tag(lesion.region)
    if not chosen.any():
        raise OrganError(f"{lesion.name}: region {lesion.region!r} of the mesh has no tets: leave it out")
    weight = mesh.volumes[chosen] / mesh.volumes[chosen].sum()
    corners = mesh.points[mesh.tets[chosen]]
    centre = matmul(weight, corners.mean(axis=1))
    corners = corners - centre
    variance = matmul(weight, (corners * corners).sum(axis=1) + np.square(corners.sum(axis=1))) / 20.0
    return centre, np.sqrt(5.0 * variance)


def tet_samples(corners: FloatArray) -> FloatArray:
    """165 points, spread evenly over each tet with corners (n, 4, 3), in their unit, shape (n, 165, 3)."""
    return matmul(_BARYCENTRIC_SAMPLES, corners)


def _check_lesion(mesh: TetMesh, lesion: Lesion, axes: FloatArray, fraction: FloatArray) -> None:
    node = int(np.argmin(norm(mesh.points - np.asarray(lesion.centre), axis=1)))
    # The smallest of the tets around: those at an outer face are cut along its diagonal.
    corners = mesh.points[mesh.tets[(mesh.tets == node).any(axis=1)]]
    edges = norm(corners[:, TET_EDGES[:, 0]] - corners[:, TET_EDGES[:, 1]], axis=2)
    cell = float(edges.max(axis=1).min())
    if 2.0 * axes.min() < cell:
        raise OrganError(
            f"{lesion.name}: radius {axes.min() * 1000:.3g} mm is less than half of the {cell * 1000:.3g} mm cells "
            "there; the mesh cannot show it: use a larger lesion or smaller cells"
        )
    filled = float(matmul(fraction, mesh.volumes))
    share = filled / (4.0 / 3.0 * math.pi * float(axes.prod()))
    if share < LESION_SHARE_INSIDE:
        centre = ", ".join(f"{value * 1000:.1f}" for value in np.asarray(lesion.centre))
        raise OrganError(
            f"{lesion.name}: only {max(share, 0.0):.0%} of it (centre {centre} mm) lies inside the organ; at least "
            f"{LESION_SHARE_INSIDE:.0%} must: move its centre into the organ, or make it smaller (all in metres)"
        )


def mixed_moduli(
    spring_modulus: FloatArray, volume_modulus: FloatArray, material: Material, fraction: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Spring and volume modulus of tets filled with a fraction of another material [Pa], (n_tet,) each.

    Geometric means by volume of shear and bulk modulus: log mu = (1 - f) log mu_1 + f log mu_2, and log K likewise.
    Springs give mu = (2/5) E_s and 2/3 E_s of K, the volume term the remainder, K = (2/3) E_s + K_t; so K_t stays 0 if
    both are 0, and is never negative.

    The modulus of a tet cut by an interface lies between the arithmetic mean (Voigt: one strain) and the harmonic mean
    (Reuss: one stress; Hill 1952, doi 10.1088/0370-1298/65/5/307). Measured with a lesion of 5 x and cells of half its
    radius, anywhere on the lattice: the stiffness added to a sheared block is off by +16 % with the arithmetic mean,
    -4 % with the harmonic, +5 % with the geometric; it varies with the place by 1.2, 0.4 and 0.8 %, and by 4.7 % with
    every tet wholly on one side.
    """
    share = 2.0 / 3.0 * spring_modulus
    added = log1p(volume_modulus / share)
    added_by_material = float(log1p(material.volume_modulus / (2.0 / 3.0 * material.spring_modulus)))
    spring = spring_modulus * power(material.spring_modulus / spring_modulus, fraction)
    volume = 2.0 / 3.0 * spring * expm1((1.0 - fraction) * added + fraction * added_by_material)
    # log and exp round: tets outside the lesion keep their modulus to the bit.
    return spring, np.where(fraction > 0.0, volume, volume_modulus)


def boundary_layer(mesh: TetMesh) -> NDArray[np.bool_]:
    """Tets with at least one face on the boundary: the paper's capsule, shape (n_tet,)."""
    layer = np.zeros(mesh.tet_count, dtype=bool)
    layer[mesh.boundary_tets] = True
    return layer


def _barycentric_lattice(per_edge: int) -> FloatArray:
    """Barycentric points inside a tet, evenly spread, with the tet's own centroid and moments of inertia, (n, 4).

    A lattice of m = per_edge - 1 steps has variance 3 m (m + 4) / 80 along each coordinate, a tet 3 / 80.
    """
    steps = np.array(
        [
            (i, j, k, per_edge - 1 - i - j - k)
            for i in range(per_edge)
            for j in range(per_edge - i)
            for k in range(per_edge - i - j)
        ],
        dtype=np.float64,
    )
    last = per_edge - 1
    return 0.25 + (steps - 0.25 * last) / math.sqrt(last * (last + 4))


_BARYCENTRIC_SAMPLES = _barycentric_lattice(SAMPLES_PER_EDGE)


# Up to this Poisson's ratio the volume term belongs to each tet. Above it tets lock in bending (a cosine load on
# three cells: 1.46 x too stiff at 0.49, 1.06 x at 0.25) and below a tip, so the excess is averaged at nodes.
POISSON_RATIO_PER_TET = 0.35


def averaged_volume_modulus(mesh: TetMesh, spring_modulus: FloatArray, volume_modulus: FloatArray) -> FloatArray:
    """Part of each tet's volume modulus averaged at nodes, max(0, K_t - a mu) [Pa], shape (n_tet,).

    K_t / mu = (4 nu - 1) / (1 - 2 nu), which is a at POISSON_RATIO_PER_TET, and mu = (2/5) E_s. Tets with a face on the
    boundary keep all of it: the few tets around a node of the surface would let each other collapse below a tip.

    Args:
        mesh: the organ's tets.
        spring_modulus: E_s of each tet [Pa], shape (n_tet,).
        volume_modulus: K_t of each tet [Pa], shape (n_tet,).
    """
    nu = POISSON_RATIO_PER_TET
    most = 0.4 * spring_modulus * ((4.0 * nu - 1.0) / (1.0 - 2.0 * nu))
    # Rounding must not average an organ of exactly that ratio.
    averaged = np.where(volume_modulus > most * (1.0 + 1e-9), volume_modulus - most, 0.0)
    averaged[mesh.boundary_tets] = 0.0
    return averaged


def nodal_average(mesh: TetMesh, tet_modulus: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Volume [m^3] and modulus [Pa] of each node, from a quarter of each tet around it, both (n_node,).

    V_a = sum_t V_t / 4 and K_a = sum_t (V_t / 4) K_t / V_a (averaged volumes: Bonet and Burton 1998).
    """
    corners = mesh.tets.ravel()
    volume = np.bincount(corners, np.repeat(mesh.volumes / 4.0, 4), mesh.node_count).astype(np.float64)
    modulus = np.bincount(corners, np.repeat(mesh.volumes / 4.0 * tet_modulus, 4), mesh.node_count) / volume
    return volume, modulus
