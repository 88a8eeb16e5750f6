"""Supports: fixed planes, boxes, spheres and capsules on which an organ rests, such as a bed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import matmul, norm
from msdm_core.errors import OrganError, require_distinct, require_not_negative, require_positive
from msdm_core.kernels.support_kernels import BOX, CAPSULE, PLANE, SPHERE
from msdm_core.mesh.quality import surface_cell
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh, area_vectors

Vector = tuple[float, float, float]

KINDS = {"plane": PLANE, "sphere": SPHERE, "capsule": CAPSULE, "box": BOX}
# Meaning of the numbers of `Support.size`, as in MuJoCo [m].
SIZES = {
    "plane": (),
    "sphere": ("radius",),
    "capsule": ("radius", "half length along its z axis"),
    "box": ("half size along x", "half size along y", "half size along z"),
}


@dataclass(frozen=True)
class Support:
    """A fixed solid below an organ; kinds, sizes and frames as in MuJoCo.

    Args:
        name: used in messages and pictures.
        kind: "plane" (solid below, infinite), "box", "sphere" or "capsule".
        position: of a plane's point, of the others' middle [m].
        axis: direction of its z axis, reached by the shortest rotation: a plane's normal, a capsule's axis.
        rotation: the whole orientation as a quaternion (w, x, y, z), in place of `axis`.
        size: empty for a plane; radius; radius and half length; three half sizes [m].
        friction: Coulomb coefficient between it and the organ.
    """

    name: str
    kind: str
    position: Vector = (0.0, 0.0, 0.0)
    axis: Vector | None = None
    rotation: tuple[float, float, float, float] | None = None
    size: tuple[float, ...] = ()
    friction: float = 0.3

    def __post_init__(self) -> None:
        label = f"support {self.name!r}"
        if not self.name or self.kind not in KINDS:
            raise OrganError(f"{label}: kind is {self.kind!r}; give a name and one of the kinds {', '.join(KINDS)}")
        _require_numbers(f"{label}: position", self.position, 3)
        if self.axis is not None and self.rotation is not None:
            raise OrganError(f"{label}: axis and rotation are both given; give one of them")
        for entry, count in (("axis", 3), ("rotation", 4)):
            value = getattr(self, entry)
            if value is not None:
                _require_numbers(f"{label}: {entry}", value, count)
                if float(norm(value)) < 1e-9:
                    raise OrganError(f"{label}: {entry} is {value}; it must not be zero")
        _require_numbers(f"{label}: size", self.size, len(SIZES[self.kind]), SIZES[self.kind])
        for length in self.size:
            require_positive(f"{label}: size", length, "m")
        require_not_negative(f"{label}: friction", self.friction)

    @property
    def quaternion(self) -> FloatArray:
        """Orientation (w, x, y, z) of length 1, shape (4,)."""
        if self.rotation is not None:
            return np.array(self.rotation) / float(norm(self.rotation))
        x, y, z = np.array(self.axis or (0.0, 0.0, 1.0)) / float(norm(self.axis or (1.0,)))
        # From z to the axis: half the angle about z x axis; straight down is a half turn about x.
        turn = np.array([1.0 + z, -y, x, 0.0])
        length = float(norm(turn))
        return np.array([0.0, 1.0, 0.0, 0.0]) if length < 1e-9 else turn / length

    @property
    def frame(self) -> FloatArray:
        """Axes in the world as columns, shape (3, 3)."""
        w, x, y, z = self.quaternion
        return np.array(
            [
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
                [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
                [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
            ]
        )

    def reach(self, direction: FloatArray) -> float:
        """Largest coordinate along a unit direction [m]; infinite for a plane."""
        along = matmul(direction, self.frame)
        if self.kind == "plane":
            return math.inf
        if self.kind == "box":
            out = float(matmul(np.abs(along), self.size))
        else:
            out = self.size[0] + (self.size[1] * abs(float(along[2])) if self.kind == "capsule" else 0.0)
        return float(matmul(direction, np.array(self.position))) + out


@dataclass(frozen=True)
class SupportLaw:
    """Contact law of supports, per area of the organ's surface; static friction is half as stiff.

    Args:
        stiffness: pressure per penetration, k_p [N/m^3].
        damping: pressure per closing speed [N s/m^3].
    """

    stiffness: float = 1e7
    damping: float = 0.0

    def __post_init__(self) -> None:
        require_positive("supports: stiffness", self.stiffness, "N/m^3")
        require_not_negative("supports: damping", self.damping, "N s/m^3")


def support_fields(
    supports: Sequence[Support], law: SupportLaw, mesh: TetMesh, surface: IntArray, anchored: NDArray[np.bool_]
) -> dict[str, Any]:
    """Fields of an OrganModel for its supports.

    Args:
        supports: the solids.
        law: their contact law.
        mesh: the organ.
        surface: its triangles open to contact, shape (n_surface, 3).
        anchored: True for the nodes held fixed, shape (n_node,); supports do not act on them.

    Raises:
        OrganError: two supports of one name, a support smaller than the organ's cells, or no surface to touch.
    """
    require_distinct("supports", [support.name for support in supports])
    if supports and not len(surface):
        raise OrganError(
            f"support {supports[0].name!r} touches nothing: the anchors hold the whole surface; anchor fewer nodes, or "
            "give no supports"
        )
    if supports:
        _check_sizes(supports, surface_cell(mesh, surface))
    area = norm(area_vectors(mesh.points[surface]), axis=1)
    node_area = np.bincount(surface.ravel(), np.repeat(area / 3.0, 3), mesh.node_count)
    nodes = np.flatnonzero((node_area > 0.0) & ~anchored) if supports else np.zeros(0, dtype=np.int64)
    return {
        "support_kind": np.array([KINDS[support.kind] for support in supports], dtype=np.int32),
        "support_position": np.array([support.position for support in supports]).reshape(-1, 3),
        "support_rotation": np.array([support.frame for support in supports]).reshape(-1, 3, 3),
        "support_size": np.array([(*support.size, 0.0, 0.0, 0.0)[:3] for support in supports]).reshape(-1, 3),
        "support_friction": np.array([support.friction for support in supports], dtype=np.float64),
        "support_nodes": nodes.astype(np.int32),
        "support_area": node_area[nodes],
        "support_stiffness": float(law.stiffness),
        "support_damping": float(law.damping),
        "support_tangential_stiffness": 0.5 * float(law.stiffness),
    }


def _check_sizes(supports: Sequence[Support], cell: float) -> None:
    # Contact acts on nodes only: a small solid fits between them.
    for support in supports:
        widths = support.size[:1] if support.kind == "capsule" else support.size
        if widths and min(widths) < cell:
            raise OrganError(
                f"support {support.name!r}: {SIZES[support.kind][int(np.argmin(widths))]} is {min(widths) * 1e3:.3g} "
                f"mm; it must be at least the organ's surface cells, {cell * 1e3:.3g} mm, or the nodes miss it: make "
                "it larger or the cells smaller"
            )


def _require_numbers(quantity: str, values: Sequence[float], count: int, meaning: tuple[str, ...] = ()) -> None:
    if len(values) != count or not all(map(math.isfinite, values)):
        means = f" ({', '.join(meaning)})" if meaning else ""
        raise OrganError(f"{quantity} is {values}; it must be {count} finite numbers{means}")
