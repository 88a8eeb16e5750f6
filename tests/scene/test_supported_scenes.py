"""An organ that rests on its bed is settled, and tools meet its bed alike in both loops."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from msdm_core.material.regions import Capsule
from msdm_core.organ.compile import compile_organ, rest_state
from msdm_core.organ.measure import support_forces
from msdm_core.organ.stability import stable_dt
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP, SUPPORT_BIT
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene, with_instrument
from surgsim_env.scene.model import Scene, substeps_needed

# Beside the lobe, over its bed, whose top is z = 0 [m].
BARE = np.array([0.105, 0.010, 0.020])
ABOVE = np.array([0.040, 0.020, 0.022])


@cache
def scene() -> Scene:
    """The lobe, palpated."""
    return with_instrument(make_scene("lobe"), "probe")


def simulation(*, compiled: bool = True, instrument: str | None = None, tip=ABOVE) -> Simulation:
    made = Simulation(load_anatomy(with_instrument(scene(), instrument)))
    made.compiled = compiled
    made.reset(made.organ_model, tip)
    return made


def test_the_lobe_lies_on_its_bed_at_the_start_and_stays():
    """No node is faster than 1 mm/s from before step 0 to 100 ms after; the bed bears most of the weight."""
    simulated = simulation()
    organ, state = simulated.organ_model, simulated.organ_state
    assert not state.node_velocity.any()
    bed = support_forces(organ, state)[0]
    assert 0.7 < bed[2] / (9.81 * organ.node_mass.sum()) < 1.0
    free = state.node_position[organ.node_rest_position[:, 1] > 0.0479]
    assert -0.006 < free[:, 2].min() < -0.0005, "the free edge hangs over"
    for _ in range(100):
        simulated.control_step(1)
        assert np.linalg.norm(state.node_velocity, axis=1).max() < 1e-3


@pytest.mark.parametrize(
    ("place", "instrument"),
    [
        ("bare bed", None),
        ("lobe", None),
        pytest.param("bare bed", "psm_palpator", marks=pytest.mark.slow),
        pytest.param("bare bed", "grasper", marks=pytest.mark.slow),
    ],
)
def test_a_tool_meets_the_bed_alike_in_both_loops(place: str, instrument: str | None):
    """Pressed 10 mm into the bare bed, or through the lobe towards it: calm, and to the bit in the compiled loop."""
    start = BARE if place == "bare bed" else ABOVE
    both = tuple(simulation(compiled=compiled, instrument=instrument, tip=start) for compiled in (True, False))
    speeds = [(0.0, 0.0, -0.02)] * (22 if place == "bare bed" else 5) + [(0.005, 0.0, 0.0)] * 4 + [(0.0, 0.0, 0.02)] * 2
    met = 0
    for speed in speeds:
        for simulated in both:
            simulated.instrument.command_velocity(np.array(speed))
            simulated.control_step(50)
            assert simulated.end_control_step(), simulated.fault
        first, other = (simulated.get_state() for simulated in both)
        for name, array in other.items():
            assert first[name].tobytes() == array.tobytes(), name
        met += int(both[0].instrument.data.ncon)
        assert np.linalg.norm(both[0].instrument.tip_velocity) < 0.03
    assert (met > 0) == (place == "bare bed")
    assert both[0].contact_force.any() == (place == "lobe")


def test_the_bed_is_soft():
    """3 kN/m under the probe's 0.2 kg, as MuJoCo's contacts stiffen with the mass: push over depth at rest."""
    simulated = simulation(tip=BARE)
    instrument = simulated.instrument
    instrument.command_velocity(np.array([0.0, 0.0, -0.02]))
    simulated.control_step(900)
    instrument.command_velocity(np.zeros(3))
    simulated.control_step(500)
    simulated.end_control_step()
    depth = scene().instrument.tip_radius - instrument.tip_position[2]
    force = 5000.0 * (instrument.tip_position[2] - instrument.data.ctrl[2])
    assert depth > 0.002
    assert 2000.0 < force / depth < 4000.0
    assert np.linalg.norm(instrument.tip_velocity) < 1e-4


@pytest.mark.parametrize("instrument", [None, "psm_palpator"])
def test_tools_meet_supports_and_not_each_other(instrument):
    model = simulation(instrument=instrument).instrument.model
    felt = model.geom_group == CONTACT_GROUP
    bed = model.geom("support_bed").id
    assert (model.geom_conaffinity[felt] & SUPPORT_BIT).all() and not (model.geom_contype[felt] & SUPPORT_BIT).any()
    assert model.geom_contype[bed] == SUPPORT_BIT and model.geom_conaffinity[bed] == 0
    np.testing.assert_allclose(model.geom_pos[bed], scene().supports[0].position)
    np.testing.assert_allclose(model.geom_size[bed], scene().supports[0].size)


@pytest.mark.parametrize("end", [0, 1])
def test_the_lobes_substeps_bear_its_hardest_draw(end: int):
    """Stiffest tissue and capsule of [retract] in the smallest and largest cells; it settles too."""
    anatomy, table = load_anatomy(scene()), scene().retract
    assert table is not None
    mesh = anatomy.mesh.scaled(table.scale[end])
    hardest = replace(scene().material, youngs_modulus=table.youngs_modulus[1])
    capsule = Capsule(1e4 * table.capsule_stiffness[1], 1e-4)
    organ = compile_organ(replace(anatomy.specification(), mesh=mesh, materials=hardest, capsule=capsule))
    timing = scene().timing
    assert substeps_needed(timing.haptic_step, stable_dt(organ, scene().contact.law)) <= timing.substep_count
    assert np.isfinite(rest_state(organ).node_position).all()
