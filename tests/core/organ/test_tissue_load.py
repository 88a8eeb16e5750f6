"""Largest contact pressure and principal strain of an organ, against plain numpy and closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msdm_core import Material, Stiffening, box_mesh
from msdm_core.kernels.contact_kernels import QUADRATURE_BARYCENTRIC, QUADRATURE_COUNT
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.measure import tissue_load
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, round_shapes

STIFFNESS = 2e7


@pytest.fixture(scope="module")
def organ():
    mesh = box_mesh((0.04, 0.03, 0.02), (4, 3, 2))
    return compile_organ(OrganSpec(mesh, Material(5000.0, 1060.0, 0.45)))


@given(st.integers(0, 2**31), st.sampled_from([1e-6, 1e-4, 2e-3]))
@settings(deadline=None, max_examples=40)
def test_strain_is_that_of_singular_values(organ, seed, size):
    state = rest_state(organ)
    state.node_position[:] += size * np.random.default_rng(seed).standard_normal(state.node_position.shape)
    rest, now = organ.node_rest_position[organ.tet_nodes], state.node_position[organ.tet_nodes]
    gradient = np.linalg.solve(rest[:, 1:] - rest[:, :1], now[:, 1:] - now[:, :1])
    expected = []
    for node in range(len(organ.node_mass)):
        around = (organ.tet_nodes == node).any(axis=1)
        mean = np.average(gradient[around], axis=0, weights=organ.tet_rest_volume[around])
        expected.append(np.abs(np.linalg.svd(mean, compute_uv=False) - 1.0).max())
    load = tissue_load(organ, state, NO_SHAPES, NO_CONTACT)
    assert load.strain == pytest.approx(max(expected), rel=1e-6)
    assert expected[load.strain_node] == pytest.approx(max(expected), rel=1e-6)
    assert load.pressure == 0.0


@pytest.mark.parametrize("stretch", [0.7, 1.2])
def test_a_stretched_and_turned_organ(organ, stretch):
    """Compression counts as extension does; a rotation strains nothing."""
    state = rest_state(organ)
    angle = 0.7
    turn = np.array([[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0, 0, 1.0]])
    state.node_position[:] = (state.node_position * [stretch, 1.0, 1.0]) @ turn.T
    assert tissue_load(organ, state, NO_SHAPES, NO_CONTACT).strain == pytest.approx(abs(stretch - 1.0), rel=1e-9)


@pytest.mark.parametrize("size", [1e-4, -1e-4])
def test_equivalent_strain_is_that_of_a_bar(size):
    """A block of stiffening tissue, sheared at constant volume by e along x and -e / 2 across: s = |e|."""
    mesh = box_mesh((0.03, 0.03, 0.03), (6, 6, 6))
    organ = compile_organ(OrganSpec(mesh, Material(5000.0, 1000.0, 0.45, Stiffening(0.1, 0.3, 5.0))))
    state = rest_state(organ)
    state.node_position[:] *= [1.0 + size, 1.0 - 0.5 * size, 1.0 - 0.5 * size]
    load = tissue_load(organ, state, NO_SHAPES, NO_CONTACT)
    # Nodes on an edge of the block have an eighth or a quarter of the lattice's directions.
    assert load.equivalent_strain == pytest.approx(abs(size), rel=0.35)
    linear = compile_organ(OrganSpec(mesh, Material(5000.0, 1000.0, 0.45)))
    assert tissue_load(linear, state, NO_SHAPES, NO_CONTACT).equivalent_strain == 0.0


def test_nothing_strained_at_rest(organ):
    load = tissue_load(organ, rest_state(organ), NO_SHAPES, NO_CONTACT)
    assert load.strain < 1e-7


def test_pressure_where_a_ball_sinks_into_a_flat_surface(organ):
    """The mean over the patch of a node of k_p s (s + t) / r, by plain sums over its quadrature points."""
    radius, sunk = 0.008, 0.0005
    state = rest_state(organ, shape_count=1)
    centre = np.array([0.0203, 0.0148, 0.02 + radius - sunk])
    shapes = round_shapes([[centre, centre]], radius)
    corners = organ.node_rest_position[organ.surface_triangles]
    top = np.flatnonzero((corners[:, :, 2] > 0.02 - 1e-9).all(axis=1))
    state.contact_engaged.reshape(1, -1, QUADRATURE_COUNT)[:, top] = 1
    load = tissue_load(organ, state, shapes, NO_CONTACT._replace(stiffness=STIFFNESS))
    expected = []
    for node in range(len(organ.node_mass)):
        force = area = 0.0
        for triangle in np.flatnonzero((organ.surface_triangles == node).any(axis=1)):
            corner = int(np.flatnonzero(organ.surface_triangles[triangle] == node)[0])
            area += organ.surface_rest_area[triangle] / 3.0
            for weights in QUADRATURE_BARYCENTRIC if triangle in top else ():
                x, y, z = weights @ corners[triangle]
                chord = math.sqrt(max(radius**2 - (x - centre[0]) ** 2 - (y - centre[1]) ** 2, 0.0))
                sunk_by = max(chord + z - centre[2], 0.0)
                force += (
                    weights[corner] * organ.surface_rest_area[triangle] / 4.0 * STIFFNESS * chord * sunk_by / radius
                )
        expected.append(force / area if area else 0.0)
    assert load.pressure == pytest.approx(max(expected), rel=1e-9)
    assert load.pressure_node == int(np.argmax(expected))
