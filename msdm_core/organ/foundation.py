"""Elastic foundations: springs from an organ's surface to the ground, for the tissue around it (Winkler)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.arithmetic import norm
from msdm_core.errors import OrganError, require_not_negative, require_positive
from msdm_core.mesh.tet_mesh import TetMesh, area_vectors


@dataclass(frozen=True, eq=False)
class Foundation:
    """Springs from a part of an organ's surface to the ground, in tension and compression alike.

    Args:
        name: used in messages.
        nodes: indices of surface nodes, shape (n,).
        stiffness: pressure per displacement along the surface normal [N/m^3].
        shear_stiffness: traction per displacement along the surface [N/m^3].
    """

    name: str
    nodes: ArrayLike
    stiffness: float
    shear_stiffness: float

    def __post_init__(self) -> None:
        require_positive(f"foundation {self.name!r}: stiffness", self.stiffness, "N/m^3")
        require_not_negative(f"foundation {self.name!r}: shear_stiffness", self.shear_stiffness, "N/m^3")


def foundation_fields(foundations: Sequence[Foundation], mesh: TetMesh, anchored: NDArray[np.bool_]) -> dict[str, Any]:
    """Fields of an OrganModel for its foundations.

    A node has the stiffness K = sum over the surface triangles around it of (A / 3) (k_t I + (k_n - k_t) n n^T), with
    the area A and the normal n of each; those of several foundations add up.

    Args:
        foundations: on the organ.
        mesh: the organ.
        anchored: True for the nodes held fixed, shape (n_node,); foundations do not act on them.

    Raises:
        OrganError: nodes off the surface.
    """
    blocks = np.zeros((mesh.node_count, 3, 3))
    triangles = mesh.boundary_triangles
    normals = area_vectors(mesh.points[triangles])
    area = norm(normals, axis=1)[:, None, None]
    # (A / 3) I and (A / 3) n n^T.
    third = area / 3.0 * np.eye(3)
    normal = normals[:, :, None] * normals[:, None, :] / (3.0 * area)
    for foundation in foundations:
        held = np.zeros(mesh.node_count, dtype=bool)
        held[_surface_nodes(foundation, mesh)] = True
        each = foundation.shear_stiffness * (third - normal) + foundation.stiffness * normal
        for corner in range(3):
            inside = held[triangles[:, corner]]
            np.add.at(blocks, triangles[inside, corner], each[inside])
    nodes = np.flatnonzero(blocks.any(axis=(1, 2)) & ~anchored)
    return {
        "foundation_nodes": nodes.astype(np.int32),
        "foundation_position": mesh.points[nodes],
        "foundation_stiffness": blocks[nodes],
    }


def _surface_nodes(foundation: Foundation, mesh: TetMesh) -> NDArray[Any]:
    nodes = np.asarray(foundation.nodes)
    on_surface = np.zeros(mesh.node_count, dtype=bool)
    on_surface[mesh.boundary_nodes] = True
    if nodes.ndim != 1 or nodes.size == 0 or nodes.dtype.kind not in "iu":
        raise OrganError(f"foundation {foundation.name!r} holds nothing: give indices of surface nodes, shape (n,)")
    for node in nodes:
        if not (0 <= node < mesh.node_count and on_surface[node]):
            raise OrganError(
                f"foundation {foundation.name!r}: node {node} is not on the surface; the rule is indices of surface "
                f"nodes, of which there are {on_surface.sum()}"
            )
    return nodes
