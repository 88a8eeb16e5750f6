"""Parts of a substep, as `surgsim bench` times them, against the substep itself."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from msdm_core.kernels import advance_substeps, repeat_parts
from msdm_core.material import Relaxation, Stiffening
from surgsim_env.coupling import Simulation
from surgsim_env.palpation import press
from surgsim_env.scene import load_anatomy, make_scene

SQUEEZED = 8


@pytest.mark.parametrize("real", [False, True])
def test_all_parts_together_give_the_force_of_a_substep(real):
    """Sums, law, springs, tets, contact, guard and the implicit parts: each leaves its share in the nodes' forces."""
    scene = make_scene("phantom_small")
    if real:
        arms = Relaxation((0.3, 0.3, 0.3), (0.05, 0.5, 5.0))
        tissue = replace(scene.material, stiffening=Stiffening(0.01, 0.1, 20.0), relaxation=arms)
        timing, limits = replace(scene.timing, substep_count=8), replace(scene.limits, hard_force=5.0)
        scene = replace(scene, material=tissue, timing=timing, limits=limits)
    anatomy = load_anatomy(scene)
    organ, simulation = anatomy.organ(), Simulation(anatomy)
    point, normal = anatomy.face.project(anatomy.mesh.points.mean(axis=0))
    simulation.reset(organ, point + 0.05 * normal)
    assert not press(simulation, point, normal).end
    state, tools, wrench = simulation.organ_state, simulation.instrument, np.zeros((1, 6))
    tools.shapes.tool_twist[:] = 0.0
    law, reference = simulation.contact, tools.shapes.tool_centre.copy()
    run = (tools.shapes, law, tools.response, simulation.substep_dt, 1.0)
    # A substep sets the candidates; the next one is compared.
    advance_substeps(organ, state, *run, 1, reference, wrench)
    parts = deepcopy(state)
    parts.row_position[:, :3], parts.row_velocity[:, :3] = state.node_position, state.node_velocity
    points, steep, _ = repeat_parts(organ, parts, *run, organ.relaxes, SQUEEZED, reference, wrench, 1)
    advance_substeps(organ, state, *run, 1, reference, wrench)
    assert points > 0 and (steep > 0) == real
    np.testing.assert_array_equal(parts.row_force[:, :3], state.node_force)
