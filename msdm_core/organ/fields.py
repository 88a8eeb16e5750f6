"""Fields of an organ: contact traction of the surface, stress and energy at nodes, principal stretches of tets.

They follow from the kept state alone: an organ alone, in a lane or restored has the same.

* Traction on a triangle of present area a: t = -sum f / a, with the forces f of its quadrature points on the tools;
  pressure p = -t . n, shear t + p n.
* Cauchy stress: the virial (Tsai 1979, without velocities) of springs of tension T and span d, |d| = l, at a node of
  present volume v_i, a quarter of its tets: v_i sigma_i' = sum_s (T_s / 2 l) d d. A tet has sigma_t = mean of sigma_i'
  at its corners + q_t 1 with the tension q_t of its volume; a node the mean of its tets by volume (Hardy 1982, a weight
  over the tets around it). Without this mean the nodes at corners and centres of cells differ by more than the stress.
  Maxwell arms, stiffening and the barrier of squeezed tets are included, Rayleigh's beta is not; a membrane counts in
  the cells below it.
* Von Mises stress sqrt(3 J_2), with half the square J_2 of the deviator (von Mises 1913).
* Principal stretches of a tet: singular values of F = dx/dX.
* Energy density: of springs, volume terms and barrier (`potential_energy`), without Maxwell arms, with the same mean.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from msdm_core.errors import OrganDivergedError
from msdm_core.kernels.contact_kernels import (
    QUADRATURE_BARYCENTRIC,
    QUADRATURE_COUNT,
    ROW_AREA,
    ROW_MORE,
    ROW_PRESSURE,
    ROW_SLOPE,
    ROW_STRETCH,
)
from msdm_core.kernels.load_kernels import (
    add_spring_virials,
    add_tet_stresses,
    fill_normals,
    fill_principal_values,
    fill_squared_stretches,
)
from msdm_core.kernels.structure_kernels import (
    FAULT_NONE,
    KEPT_NAMES,
    ContactLaw,
    ContactShapes,
    OrganModel,
    OrganState,
)
from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from msdm_core.organ.measure import (
    corner_means,
    corner_sums,
    element_energies,
    element_strains,
    element_tensions,
    node_shares,
    node_strains,
    principal_values,
    squeezed_energies,
    squeezed_tensions,
)
from msdm_core.organ.stepping import advance_organ, describe_fault


@dataclass(frozen=True, eq=False)
class ContactPoints:
    """Quadrature points of an organ's surface in contact, with their forces in a substep.

    Fields:
        shape: contact shape of each, (n_point,)
        triangle: its surface triangle, (n_point,)
        place: on the flat triangle [m], (n_point, 3)
        force: of the tissue on the tool, pressure, damping and friction [N], (n_point, 3)
    """

    shape: IntArray
    triangle: IntArray
    place: FloatArray
    force: FloatArray


@dataclass(frozen=True, eq=False)
class TissueFields:
    """Fields of an organ, by surface triangle, node and tet; equations at the head of this file.

    Fields:
        traction: of the tools on each surface triangle, per present area [Pa], (n_surface, 3)
        normal: of the triangle, outward, (n_surface, 3)
        area: of the triangle, present [m^2], (n_surface,)
        stress: Cauchy stress at each node, tension positive [Pa], (n_node, 3, 3)
        principal_stress: its principal values, descending [Pa], (n_node, 3)
        principal_stretch: of each tet, descending, (n_tet, 3)
        energy_density: at each node, per undeformed volume [J/m^3], (n_node,)
    """

    traction: FloatArray
    normal: FloatArray
    area: FloatArray
    stress: FloatArray
    principal_stress: FloatArray
    principal_stretch: FloatArray
    energy_density: FloatArray

    @property
    def pressure(self) -> FloatArray:
        """Contact pressure of each surface triangle, -t . n [Pa], (n_surface,)."""
        return -(self.traction * self.normal).sum(axis=1)

    @property
    def shear(self) -> FloatArray:
        """Traction of each surface triangle along it, t + p n [Pa], (n_surface, 3)."""
        return self.traction + self.pressure[:, None] * self.normal

    @property
    def von_mises(self) -> FloatArray:
        """Von Mises stress at each node [Pa], (n_node,)."""
        high, middle, low = self.principal_stress.T
        return np.sqrt(0.5 * (np.square(high - middle) + np.square(middle - low) + np.square(low - high)))


def contact_points(
    model: OrganModel, state: OrganState, shapes: ContactShapes, contact: ContactLaw, dt: float
) -> ContactPoints:
    """Points in contact with their forces in a substep of dt [s] from the present state, which does not change.

    The exchange integrates contact implicitly: forces are those at the end of the substep. Their sum over the shapes of
    a tool is the wrench that `advance` returns for this one substep, apart from the guard of a shape's axis.

    Raises:
        OrganDivergedError: a fault in that substep.
    """
    # Scratch is written again in every call; a substep far from every surface leaves the count as it was.
    kept: dict[str, Any] = {name: getattr(state, name).copy() for name in KEPT_NAMES}
    trial = state._replace(**kept, contact_count=np.zeros_like(state.contact_count))
    copies: Any = [field.copy() for field in shapes]
    moved = ContactShapes(*copies)
    fault = advance_organ(model, trial, moved, contact, dt, 1, np.zeros((len(shapes.tool_centre), 6)))
    if fault != FAULT_NONE:
        raise OrganDivergedError(describe_fault(model, trial, fault))
    count = int(trial.contact_count[0])
    rows, (shape, item) = trial.contact_rows[:count], trial.contact_places[:count, :2].T.copy()
    slope = rows[:, ROW_SLOPE : ROW_SLOPE + 9].reshape(-1, 3, 3).sum(axis=1)
    stretch = rows[:, ROW_STRETCH : ROW_STRETCH + 3] + rows[:, ROW_MORE + 1 : ROW_MORE + 4]
    pressure = rows[:, ROW_PRESSURE] + rows[:, ROW_MORE]
    force = rows[:, ROW_AREA, None] * (pressure[:, None] * slope + contact.tangential_stiffness * stretch)
    triangle = item // QUADRATURE_COUNT
    corners = state.node_position[model.surface_triangles[triangle]]
    place = (QUADRATURE_BARYCENTRIC[item % QUADRATURE_COUNT][:, :, None] * corners).sum(axis=1)
    return ContactPoints(shape, triangle, place, force)


def tissue_fields(
    model: OrganModel, state: OrganState, shapes: ContactShapes, contact: ContactLaw, dt: float
) -> TissueFields:
    """Fields of an organ in its present state, with the contact of a substep of dt [s] (`contact_points`).

    Raises:
        OrganDivergedError: a fault in that substep.
    """
    points = contact_points(model, state, shapes, contact, dt)
    normal, area = np.empty((len(model.surface_triangles), 3)), np.empty(len(model.surface_triangles))
    fill_normals(state.node_position, model.surface_triangles, normal, area)
    push = np.zeros_like(normal)
    np.add.at(push, points.triangle, points.force)
    strain = element_strains(model, state.node_position)
    equivalent = node_strains(model, strain)
    stress = node_stresses(model, state, strain, equivalent)
    energy = element_energies(model, strain, equivalent)
    first, count = len(model.spring_nodes), len(model.tet_nodes)
    energy[first : first + count] += squeezed_energies(model, strain[first : first + count] + 1.0)
    return TissueFields(
        traction=-push / area[:, None],
        normal=normal,
        area=area,
        stress=stress,
        principal_stress=principal_values(stress),
        principal_stretch=principal_stretches(model, state),
        energy_density=_mean_around(model, node_shares(model, energy) / model.node_rest_volume),
    )


def node_stresses(model: OrganModel, state: OrganState, strain: FloatArray, equivalent: FloatArray) -> FloatArray:
    """Cauchy stress at each node [Pa], (n_node, 3, 3); other arguments as of `element_tensions`."""
    springs, tets = len(model.spring_nodes), len(model.tet_nodes)
    tension = element_tensions(model, strain, equivalent)
    if model.relaxes:
        tension = tension * model.element_gain - state.element_relief
    ratio, averaged = 1.0 + strain[springs : springs + tets], tension[springs + tets :]
    pull = tension[springs : springs + tets] + squeezed_tensions(model, ratio)
    pull += corner_means(averaged, model.tet_nodes)
    # T l0 / l: a tension of an element is over l0.
    half = 0.5 * tension[:springs] / (1.0 + strain[:springs])
    volume = (model.node_rest_volume * (1.0 + strain[springs + tets :]))[:, None, None]
    virial, total = np.zeros((2, len(model.node_mass), 3, 3))
    add_spring_virials(state.node_position, model.spring_nodes, half, virial)
    add_tet_stresses(model.tet_nodes, 0.25 * ratio * model.tet_rest_volume, pull, virial / volume, total)
    return total / volume


def principal_stretches(model: OrganModel, state: OrganState) -> FloatArray:
    """Singular values of F = dx/dX of each tet, descending, (n_tet, 3)."""
    squared, values = np.empty((3, 3, len(model.tet_nodes))), np.empty((3, len(model.tet_nodes)))
    fill_squared_stretches(model.node_rest_position, state.node_position, model.tet_nodes, squared)
    fill_principal_values(squared, values)
    return np.sqrt(np.maximum(values, 0.0)).T


def _mean_around(model: OrganModel, density: FloatArray) -> FloatArray:
    """Mean of a density at nodes over the tets around each, by undeformed volume, (n_node,)."""
    quarter = 0.25 * model.tet_rest_volume * corner_means(density, model.tet_nodes)
    return corner_sums(model, model.tet_nodes, quarter) / model.node_rest_volume
