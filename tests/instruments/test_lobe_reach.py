"""Instruments at the lobe: where each has to come to lift it and to touch what lies below."""

from dataclasses import replace

import numpy as np
import pytest

from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.arm.pair import Pair
from surgsim_env.instruments.make import make_instrument
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import Port, SceneInstrument

pytestmark = pytest.mark.filterwarnings("ignore:scene 'lobe'")
# 100 mm from each other on the free side, 15 cm from the edge, 5 cm above it.
LEFT_PORT = Port((-0.01, 0.20, 0.06), (0.2, -0.9, -0.35))
RIGHT_PORT = Port((0.09, 0.20, 0.06), (-0.2, -0.9, -0.35))
# Along the free edge, the pads beyond the bed, at half height; lifted and folded back.
EDGE = [(x, 0.049, 0.006) for x in (0.02, 0.04, 0.06)]
FOLDED = [(x, 0.022, 0.038) for x in (0.03, 0.05)]
# Targets lie on the bed 15 to 30 mm from the grown edge.
TARGETS = [(x, y, 0.0035) for x in (0.03, 0.05) for y in (0.015, 0.030)]


def lobe(model: str, **ports) -> Anatomy:
    """The lobe with an instrument that comes from the free side, its tip level."""
    scene = make_scene("lobe")
    instrument = SceneInstrument(model, 0.0035, approach=(0.0, -1.0, -0.3), tip_direction=(0.0, -1.0, 0.0))
    return load_anatomy(
        replace(scene, palpation=replace(scene.palpation, face_margin=0.0), instrument=instrument, **ports)
    )


@pytest.fixture(scope="module")
def pair() -> Pair:
    anatomy = lobe("psm_pair", ports=(LEFT_PORT, RIGHT_PORT))
    points = anatomy.mesh.points
    made = make_instrument(anatomy, points.min(axis=0) - 0.04, points.max(axis=0) + 0.04)
    assert isinstance(made, Pair)
    return made


@pytest.mark.parametrize(("side", "places"), [("left", EDGE + FOLDED), ("right", TARGETS)])
def test_each_arm_reaches_its_work_as_it_shall_point(pair: Pair, side: str, places):
    """The left jaw level at the edge and folded back, the right tip level on the bed below: within a micrometre."""
    for place in places:
        solution = pair.arms[side].reach(np.array(place))
        assert solution.position_error < 1e-6 and solution.angle_error < 1e-3, place


def test_the_arms_are_apart_where_they_work(pair: Pair):
    """The left one at the lifted edge, the right one at each target under it."""
    for target in TARGETS:
        pair.place(np.array([FOLDED[0], target]))
        assert pair.distance > 0.004, target


@pytest.mark.parametrize(("model", "force"), [("grasper.xml", 0.5), ("psm_retractor", 0.4)])
def test_a_jaw_gets_around_the_edge_that_stands_over(model: str, force: float):
    """Open, level, one pad above and one below the edge of the lobe at rest: nothing touches anything."""
    sim = Simulation(lobe(model, port=LEFT_PORT))
    # The lobe sags to its edge: its middle height is that between the pads' ends.
    gripped = sim.organ_state.node_position[sim.organ_model.node_rest_position[:, 1] > 0.039]
    sim.restart(np.array([0.04, 0.049, gripped[:, 2].mean()]))
    sim.control_step(50)
    assert sim.end_control_step(), sim.fault
    assert not sim.contact_wrench.any() and sim.instrument.data.ncon == 0
    sim.instrument.command_jaw(-1.0)
    for _ in range(14):
        sim.control_step(50)
        assert sim.end_control_step(), sim.fault
    assert sim.grasp.holds and sim.grasp.grip_force == pytest.approx(force, rel=0.2)


def test_a_ball_that_touches_the_bed_tells_its_force():
    """Driven into the bed beside the lobe, 2 mm/s and soft enough for 0.3 to 1.0 N to be met; the left one reads 0."""
    sim = Simulation(lobe("psm_pair", ports=(LEFT_PORT, RIGHT_PORT)))
    pair = sim.instrument
    assert isinstance(pair, Pair)
    sim.restart(np.array([[0.02, 0.08, 0.03], [0.10, 0.020, 0.0036]]))
    forces = []
    for _ in range(6):
        pair.command_velocity(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.002]]))
        sim.control_step(50)
        assert sim.end_control_step(), sim.fault
        forces.append(pair.touch_force("right", "bed"))
    assert forces[0] == 0.0 and 0.4 < forces[-1] < 1.0
    rises = np.diff(forces)
    assert rises.max() < 0.35, "one control step does not take it from below 0.3 N to above 1.0 N"
    for _ in range(20):
        pair.command_velocity(np.zeros((2, 3)))
        sim.control_step(50)
    assert sim.end_control_step(), sim.fault
    assert pair.touch_force("right", "bed") == pytest.approx(forces[-1], rel=0.2)
    assert pair.touch_force("left", "bed") == 0.0 == pair.collision_force
    assert not sim.contact_wrench.any()
    with pytest.raises(KeyError, match="support_table"):
        pair.touch_force("right", "table")
