"""Scenes whose organ rests on something: read, settled, saved; tools and pictures meet the same supports."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from msdm_core.errors import OrganError
from msdm_core.material.regions import Capsule
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.organ.compile import compile_organ, rest_state
from msdm_core.organ.measure import support_forces
from msdm_core.organ.stability import stable_dt
from msdm_core.organ.support import Support
from surgsim_env.coupling.lane_group import LaneGroup
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP, SUPPORT_BIT
from surgsim_env.rendering.options import render_options
from surgsim_env.rendering.renderer import OrganRenderer
from surgsim_env.rendering.stage import LABELS
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import load_scene, make_scene, scenes_folder, with_instrument
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


def test_a_scene_file_says_what_the_organ_rests_on(tmp_path):
    text = (scenes_folder() / "organs" / "lobe.toml").read_text(encoding="utf-8")
    assert scene().supports == (
        Support("bed", "box", position=(0.04, -0.01075, -0.015), size=(0.08, 0.04925, 0.015), friction=0.2),
    )
    organ = load_anatomy(scene()).organ()
    assert organ.gravity.tolist() == [0.0, 0.0, -9.81]
    assert (organ.support_stiffness, organ.support_damping) == (scene().contact.stiffness, scene().contact.damping)
    path = tmp_path / "other.toml"
    wall = '[[supports]]\nname = "wall"\nkind = "plane"\naxis = [0, 1, 0]\n'
    path.write_text(text + wall, encoding="utf-8")
    other = load_scene(path)
    assert other.supports[1].axis == (0.0, 1.0, 0.0)
    path.write_text(text + wall.replace("plane", "floor"), encoding="utf-8")
    with pytest.raises(ValueError, match="scene 'other': support 'wall': kind is 'floor'"):
        load_scene(path)


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


def test_a_restart_rests_as_a_reset_does():
    """What sticks to the bed is back too: both run on to the same bits."""
    one, other = simulation(), simulation()
    one.instrument.command_velocity(np.array([0.01, 0.0, -0.03]))
    one.control_step(300)
    assert one.contact_force[2] > 0.05
    one.restart(ABOVE)
    for simulated in (one, other):
        simulated.control_step(50)
    for name, array in other.get_state().items():
        assert one.get_state()[name].tobytes() == array.tobytes(), name


def test_saved_and_restored_to_the_bit():
    one, other = simulation(), simulation()
    one.instrument.command_velocity(np.array([0.01, 0.0, -0.03]))
    one.control_step(250)
    saved = one.get_state()
    assert saved["organ_support_stretch"].any()
    other.set_state(one.organ_model, saved)
    for simulated in (one, other):
        simulated.control_step(100)
    assert one.contact_force.any()
    for name, array in one.get_state().items():
        assert other.get_state()[name].tobytes() == array.tobytes(), name


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
        one, other = (simulated.get_state() for simulated in both)
        for name, array in other.items():
            assert one[name].tobytes() == array.tobytes(), name
        met += int(both[0].instrument.data.ncon)
        assert np.linalg.norm(both[0].instrument.tip_velocity) < 0.03
    assert (met > 0) == (place == "bare bed")
    assert both[0].contact_force.any() == (place == "lobe")


def test_the_bed_is_soft():
    """1.5 kN/m under the probe's 0.1 kg: at rest the bed's push is that times how deep the ball stands in it."""
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
    assert 1000.0 < force / depth < 2000.0
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


def test_instruments_of_other_scenes_know_of_no_supports():
    model = Simulation(load_anatomy(make_scene("phantom"))).instrument.model
    assert not model.geom_contype.any() and not model.geom_conaffinity.any()
    assert model.opt.cone == 0


@pytest.mark.parametrize("scale", [0.92, 1.08])
def test_the_lobes_substeps_bear_its_hardest_draw(scale: float):
    """10 kPa, cells of 0.92 x 4 mm, a capsule of 20 N/m; it settles too."""
    anatomy = load_anatomy(scene())
    mesh = TetMesh(anatomy.mesh.points * scale, anatomy.mesh.tets)
    hardest = replace(scene().material, youngs_modulus=10000.0)
    capsule = Capsule(1e6, 2e-5)
    organ = compile_organ(replace(anatomy.specification(), mesh=mesh, materials=hardest, capsule=capsule))
    timing = scene().timing
    assert substeps_needed(timing.haptic_step, stable_dt(organ, scene().contact.law)) <= timing.substep_count
    assert np.isfinite(rest_state(organ).node_position).all()


def test_a_scene_whose_substeps_are_too_few_is_refused():
    few = replace(scene(), timing=replace(scene().timing, substep_count=1))
    with pytest.raises(OrganError, match=r"too long.*timing.substep_count = "):
        Simulation(load_anatomy(few))


def test_pictures_show_the_bed_as_background():
    """The bed hides what is below it, is no instrument, and takes the drape's place right under the lobe."""
    simulated = simulation(tip=np.array([0.06, 0.09, 0.03]))
    with_bed = OrganRenderer(simulated, render_options({"width": 160, "height": 120, "camera": "endoscope"}))
    labels, depth = with_bed.segmentation(), with_bed.depth()
    with_bed.close()
    names = set(np.unique(labels).tolist())
    assert names == {LABELS[name] for name in ("background", "organ", "instrument")}
    bare = Simulation(load_anatomy(replace(scene(), supports=(), gravity=(0.0, 0.0, 0.0), name="bare")))
    bare.reset(bare.organ_model, np.array([0.06, 0.09, 0.03]))
    without = OrganRenderer(bare, render_options({"width": 160, "height": 120, "camera": "endoscope"}))
    drape, tool = without.depth(), without.segmentation() == LABELS["instrument"]
    without.close()
    np.testing.assert_array_equal(labels == LABELS["instrument"], tool, err_msg="the bed is no instrument")
    below = (labels == LABELS["background"]) & (np.arange(120)[:, None] > 90)
    # The drape of the bare scene lies at z = -0.5 mm, the bed's side face stands nearer, its drape is 30 mm lower.
    assert (depth[below] > drape[below] + 0.005).any(), "the drape is below the bed"
    assert np.isfinite(depth[below]).all()


@pytest.mark.parametrize("dtype", [np.float64, pytest.param(np.float32, marks=pytest.mark.slow)])
def test_lobes_side_by_side_rest_as_they_do_alone(dtype):
    """Two lobes pressed aside on their beds: in float64 to the bit, in float32 within 0.5 % of the force."""
    alone, together = [simulation() for _ in range(2)], [simulation() for _ in range(2)]
    group = LaneGroup(together, dtype)
    for _ in range(8):
        for one in (alone, together):
            for number, simulated in enumerate(one):
                simulated.instrument.command_velocity(np.array([0.01 * number, 0.005, -0.02]))
        group.control_step(np.ones(2, dtype=np.bool_), 50, np.inf)
        for simulated in (*alone, *together):
            simulated.control_step(50)
            assert simulated.end_control_step(), simulated.fault
    for one, other in zip(alone, together, strict=True):
        assert one.contact_force[2] > 0.1
        if dtype is np.float64:
            for name, array in one.get_state().items():
                assert other.get_state()[name].tobytes() == array.tobytes(), name
        assert np.abs(other.contact_force - one.contact_force).max() < 0.005 * np.linalg.norm(one.contact_force)
        stretch = one.organ_state.support_stretch, other.organ_state.support_stretch
        assert np.abs(stretch[0]).max() > 1e-6
        np.testing.assert_allclose(*stretch, atol=0.02 * np.abs(stretch[0]).max())
