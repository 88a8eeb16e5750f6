"""Blocks at finite strain: quadratic hexahedra of a hyperelastic solid, and an organ in static equilibrium.

A block with faces square to the axes is pulled, compressed or sheared by its ends z = 0 and z = height. Ends are bonded
to plates, or slide on them. The solids are those of `surgsim_apps.validation.continuum`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array, vstack
from scipy.sparse.linalg import spsolve

from msdm_core.kernels import SQUEEZED_RATIO, OrganModel, OrganState, evaluate_forces
from msdm_core.material import Stiffening
from msdm_core.mesh import FloatArray, TetMesh
from msdm_core.organ import element_means, element_size, element_stiffness, element_strains, node_strains, rest_state
from surgsim_apps.validation.continuum import STRAIN_LEAST
from surgsim_apps.validation.elements import Cells, Size
from surgsim_apps.validation.statics import averaged_gradient, block_sum, node_rows, nodes_at, volume_gradient

Test = Literal["pull", "slide", "shear"]
# Residual of the forces over the force on a plate.
RESIDUAL = 1e-7
STRAIN_STEP = 0.02
ROUNDS, HALVINGS = 40, 8


class SolidWithTangent(Protocol):
    """Solid with the derivative of its stress."""

    def first_piola(self, gradient: FloatArray) -> FloatArray:
        """P [Pa], (..., 3, 3)."""
        ...

    def tangent(self, gradient: FloatArray) -> FloatArray:
        """dP/dF [Pa], (..., 3, 3, 3, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class Plates:
    """Rows of a block's displacement held by its plates, and their displacement per unit of the test.

    Args:
        held: rows (n,), three a node.
        direction: displacement of these rows at unit strain [m], (n,).
        loaded: rows of the forces on the upper plate.
    """

    held: NDArray[np.int64]
    direction: FloatArray
    loaded: NDArray[np.int64]

    @classmethod
    def of(cls, points: FloatArray, test: Test) -> "Plates":
        """Plates of a block with nodes at `points` [m], (n_node, 3); strain is over its height.

        "pull": bonded ends drawn apart. "slide": ends drawn apart, free to slide. "shear": bonded ends, the upper one
        moved along x.
        """
        height = points[:, 2].max()
        low, high = nodes_at(points, 0.0), nodes_at(points, height)
        ends = np.concatenate([low, high])
        moved = np.repeat([0.0, height], [len(low), len(high)])
        if test == "slide":
            held, direction = 3 * ends + 2, moved
            # Nodes of the middle planes across x and y slide in these planes: no drift, no turn, no bending.
            middle = points.max(axis=0) / 2.0
            for axis in (0, 1):
                plane = nodes_at(points, middle[axis], axis)
                held = np.concatenate([held, 3 * plane + axis])
                direction = np.concatenate([direction, np.zeros(len(plane))])
            return cls(held, direction, 3 * high + 2)
        axis = 2 if test == "pull" else 0
        held = (3 * ends[:, None] + np.arange(3)).ravel()
        direction = np.zeros((len(ends), 3))
        direction[:, axis] = moved
        return cls(held, direction.ravel(), 3 * high + axis)


@dataclass(frozen=True, eq=False)
class QuadraticBlock:
    """Block [0, sx] x [0, sy] x [0, sz] of a solid in quadratic hexahedra at finite strain (total Lagrangian).

    Args:
        points: of the nodes [m], (n_node, 3).
        rows: of each element's displacement, (n_element, 81).
        slopes: d(grad u)/d(rows) at the quadrature points [1/m], (n_element, n_point, 81, 9).
        weights: volumes of the quadrature points [m^3], (n_element, n_point).
    """

    points: FloatArray
    rows: NDArray[np.int64]
    slopes: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, size: Size, cells: Cells) -> "QuadraticBlock":
        """Block with a number of elements along x, y and z."""
        from skfem import Basis, ElementHex2, ElementVector, MeshHex

        mesh = MeshHex.init_tensor(*(np.linspace(0.0, length, count + 1) for length, count in zip(size, cells)))
        basis = Basis(mesh, ElementVector(ElementHex2()), intorder=5)
        slopes = np.array([shape.grad for (shape,) in basis.basis])
        order, place = _rows_by_node(basis)
        return cls(
            place, order[basis.element_dofs.T],
            np.ascontiguousarray(slopes.reshape(len(slopes), 9, *slopes.shape[3:]).transpose(2, 3, 0, 1)), basis.dx,
        )  # fmt: skip

    def response(self, solid: SolidWithTangent, displacement: FloatArray) -> tuple[FloatArray, csc_array]:
        """Forces of the solid on plates and nodes [N], (3 n_node,), and their derivative [N/m]."""
        count, points = self.weights.shape
        gradient = np.eye(3) + np.einsum("epra,er->epa", self.slopes, displacement[self.rows], optimize=True).reshape(
            count, points, 3, 3
        )
        stress = solid.first_piola(gradient).reshape(count, points, 9)
        force = np.einsum("epra,epa->er", self.slopes, stress * self.weights[..., None], optimize=True)
        tangent = solid.tangent(gradient).reshape(count, points, 9, 9) * self.weights[..., None, None]
        blocks = (self.slopes @ tangent @ self.slopes.transpose(0, 1, 3, 2)).sum(axis=1)
        return _assembled(force, blocks, self.rows, 3 * len(self.points))

    def forces(self, solid: SolidWithTangent, test: Test, strains: tuple[float, ...]) -> list[float]:
        """Force on the upper plate at successive strains [N]."""
        plates = Plates.of(self.points, test)
        displacement = np.zeros(3 * len(self.points))
        return _forces(lambda u: self.response(solid, u), plates, displacement, strains, test)


def _rows_by_node(basis: Any) -> tuple[NDArray[np.int64], FloatArray]:
    """New numbers of scikit-fem's rows, three a node, and the places of these nodes (n_node, 3)."""
    order = np.empty(basis.N, dtype=np.int64)
    places: list[FloatArray] = []
    for dofs in (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs):
        rows = np.asarray(dofs)
        for first in range(0, len(rows), 3):
            nodes = len(places) + np.arange(rows.shape[1])
            places += list(basis.doflocs[:, rows[first]].T)
            for axis in range(3):
                order[rows[first + axis]] = 3 * nodes + axis
    return order, np.array(places)


def _assembled(
    force: FloatArray, blocks: FloatArray, rows: NDArray[np.int64], count: int
) -> tuple[FloatArray, csc_array]:
    """Sums of element vectors (n, m) and matrices (n, m, m) at their rows (n, m)."""
    total = np.bincount(rows.ravel(), force.ravel(), count).astype(np.float64)
    return total, csc_array(block_sum(blocks, rows, count))


def _forces(
    response: Callable[[FloatArray], tuple[FloatArray, csc_array]],
    plates: Plates,
    displacement: FloatArray,
    strains: tuple[float, ...],
    name: str,
) -> list[float]:
    """Force on the loaded plate at successive strains [N], reached by steps of at most STRAIN_STEP."""
    before, forces = 0.0, []
    for strain in strains:
        count = max(1, int(np.ceil(abs(strain - before) / STRAIN_STEP - 1e-9)))
        force = 0.0
        for target in np.linspace(before, strain, count + 1)[1:]:
            force = _balanced(response, plates, displacement, float(target), f"{name} {target:g}")
        forces.append(force)
        before = strain
    return forces


def _balanced(
    response: Callable[[FloatArray], tuple[FloatArray, csc_array]],
    plates: Plates,
    displacement: FloatArray,
    strain: float,
    name: str,
) -> float:
    """Force on the plate [N] in equilibrium at a strain (Newton's method); changes the displacement in place.

    Raises:
        ValueError: no equilibrium; names the test.
    """
    free = np.setdiff1d(np.arange(len(displacement)), plates.held)
    force, stiffness = response(displacement)
    # The first step moves the plates, and the block as a linear body.
    change = strain * plates.direction - displacement[plates.held]
    step = np.zeros_like(displacement)
    step[plates.held] = change
    step[free] = solved(stiffness, free, -force[free] - stiffness[free][:, plates.held] @ change)
    displacement += step
    for _ in range(ROUNDS):
        force, stiffness = response(displacement)
        size = float(np.linalg.norm(force[free]))
        if size <= RESIDUAL * float(np.abs(force[plates.loaded]).sum()):
            return float(force[plates.loaded].sum())
        step = solved(stiffness, free, -force[free])
        for share in 0.5 ** np.arange(HALVINGS):
            displacement[free] += share * step
            if float(np.linalg.norm(response(displacement)[0][free])) < size:
                break
            displacement[free] -= share * step
        else:
            break
    raise ValueError(f"the block did not come to rest: {name}")


def solved(stiffness: csc_array, free: NDArray[np.int64], right: FloatArray) -> FloatArray:
    """Displacement of the free rows [m] under a load [N]."""
    return np.asarray(spsolve(stiffness[free][:, free].tocsc(), right, permc_spec="MMD_AT_PLUS_A"))


@dataclass(frozen=True, eq=False)
class OrganBlock:
    """Block as an organ: forces by its kernels, statics by Newton's method with springs and volume terms.

    The matrix only leads to the equilibrium, which is that of the kernels' forces.

    Args:
        mesh: the block.
        model: its organ, without anchors.
        stiffening: of its tissue, for the matrix.
    """

    mesh: TetMesh
    model: OrganModel
    stiffening: Stiffening | None = None

    def forces(self, test: Test, strains: tuple[float, ...]) -> list[float]:
        """Force on the upper plate at successive strains [N]."""
        plates, state = Plates.of(self.mesh.points, test), rest_state(self.model)
        displacement = np.zeros(self.mesh.points.size)
        return _forces(lambda u: self.response(state, u), plates, displacement, strains, f"organ, {test}")

    def response(self, state: OrganState, displacement: FloatArray) -> tuple[FloatArray, csc_array]:
        """Minus the kernels' forces [N], (3 n_node,), and the matrix [N/m]."""
        state.node_position[:] = self.model.node_rest_position + displacement.reshape(-1, 3)
        state.node_velocity[:] = 0.0
        evaluate_forces(self.model, state)
        return -state.node_force.ravel(), self._matrix(state.node_position)

    def _matrix(self, position: FloatArray) -> csc_array:
        """Tangent of springs, tets and averaged volumes and of the law at their nodes [N/m].

        An element of size V (l0^2 of a spring), strain e and linear tension K e has V f K (de de^T + e d2e), f being
        the mean of w'(s) / s over its nodes. The factor of node a changes by f_a' ds_a, s_a ds_a = dU_a / (E_a V_a).
        """
        model, count = self.model, position.size
        strain, springs, tets = element_strains(model, position), len(model.spring_nodes), len(model.tet_nodes)
        equivalent = factor = np.ones(len(position))
        if self.stiffening is not None:
            equivalent = np.maximum(node_strains(model, strain), STRAIN_LEAST)
            factor = self.stiffening.tension(equivalent) / equivalent
        linear = element_size(model) * element_stiffness(model)
        stiffness = linear * element_means(model, factor)
        span = np.diff(position[model.spring_nodes], axis=1)[:, 0]
        length = np.linalg.norm(span, axis=1)
        direction, rest = span / length[:, None], model.spring_rest_length
        along = np.concatenate([-direction, direction], axis=1) / rest[:, None]
        gradient = volume_gradient(position, model.tet_nodes)
        changes = vstack([
            _rows(node_rows(model.spring_nodes), along, count),
            _rows(node_rows(model.tet_nodes), gradient / model.tet_rest_volume[:, None], count),
            averaged_gradient(model.tet_nodes, gradient, count).multiply(1.0 / model.node_rest_volume[:, None]),
        ]).tocsr()  # fmt: skip
        total = changes.T @ changes.multiply(stiffness[:, None]).tocsr()
        if self.stiffening is not None:
            # Twice the derivative of each node's linear energy.
            members = np.repeat(np.arange(springs + tets), np.repeat([2, 4], [springs, tets]))
            ends = np.concatenate([model.spring_nodes.ravel(), model.tet_nodes.ravel(), np.arange(len(position))])
            members = np.concatenate([members, springs + tets + np.arange(len(position))])
            shares = np.repeat([0.5, 0.25, 1.0], [2 * springs, 4 * tets, len(position)])
            shape = (len(position), len(strain))
            sums = csr_array(coo_array((shares * (linear * strain)[members], (ends, members)), shape=shape) @ changes)
            slope = 2.0 * model.node_softness * (self.stiffening.tangent(equivalent) - factor) / equivalent**2
            total = total + sums.T @ sums.multiply(slope[:, None]).tocsr()
        tension = stiffness * strain
        across = (tension[:springs] / (rest * length))[:, None, None] * (
            np.eye(3) - direction[:, :, None] * direction[:, None, :]
        )
        bent = block_sum(np.block([[across, -across], [-across, across]]), node_rows(model.spring_nodes), count)
        own, averaged = tension[springs : springs + tets], tension[springs + tets :]
        pressure = own / model.tet_rest_volume + (averaged / model.node_rest_volume)[model.tet_nodes].mean(axis=1)
        slope = np.zeros(tets)
        ratio = 1.0 + strain[springs : springs + tets]
        squeezed = ratio < SQUEEZED_RATIO
        share = SQUEEZED_RATIO / ratio[squeezed]
        pressure[squeezed] += model.tet_barrier_bulk[squeezed] * (ratio[squeezed] - SQUEEZED_RATIO) * share
        slope[squeezed] = model.tet_barrier_bulk[squeezed] * share**2
        blocks = (slope / model.tet_rest_volume)[:, None, None] * gradient[:, :, None] * gradient[:, None, :]
        blocks += pressure[:, None, None] * _volume_curvature(position[model.tet_nodes])
        return csc_array(total + bent + block_sum(blocks, node_rows(model.tet_nodes), count))


def _rows(columns: NDArray[np.int64], values: FloatArray, count: int) -> coo_array:
    """Rows with values at some columns, both (n, m), (n, count)."""
    row = np.repeat(np.arange(len(columns)), columns.shape[1])
    return coo_array((values.ravel(), (row, columns.ravel())), shape=(len(columns), count))


def _volume_curvature(corners: FloatArray) -> FloatArray:
    """d2V/dx dx of tets with corners (n, 4, 3) [m], (n, 12, 12).

    6 V = b . (c x d) with edges from the first corner: d(6 V)/db dc = -[d], [d] x = d x x; the first corner's rows are
    minus the sums of the others'.
    """
    b, c, d = (corners[:, corner] - corners[:, 0] for corner in (1, 2, 3))
    curvature = np.zeros((len(corners), 4, 3, 4, 3))
    for first, second, edge in ((1, 2, d), (2, 3, b), (3, 1, c)):
        turn = np.cross(np.eye(3)[None], edge[:, None, :]) / 6.0
        curvature[:, first, :, second, :] = turn.transpose(0, 2, 1)
        curvature[:, second, :, first, :] = turn
    curvature[:, 0] = -curvature[:, 1:].sum(axis=1)
    curvature[:, :, :, 0] = -curvature[:, :, :, 1:].sum(axis=3)
    return curvature.reshape(-1, 12, 12)
