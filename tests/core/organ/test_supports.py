"""An organ on what it rests on: weight, friction on an incline, corners, impacts, settling, memory, lanes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msdm_core.errors import OrganDivergedError, OrganError
from msdm_core.kernels.structure_kernels import FAULT_NONE, KEPT_NAMES, ContactLaw, OrganModel, OrganState
from msdm_core.lanes.lanes import get_lane, stack_organs, stack_shapes
from msdm_core.organ import compile as organ_compile
from msdm_core.organ.compile import rest_state
from msdm_core.organ.measure import kinetic_energy, potential_energy, support_forces
from msdm_core.organ.stability import stable_dt
from msdm_core.organ.stepping import advance, advance_organ
from msdm_core.organ.support import Support, SupportLaw
from surgsim_apps.validation.friction import FLOOR, GRAVITY, crept, free_block, on_incline, run, slid
from tests.core import oracle
from tests.core.lanes.abreast import advance_lanes, rest_lanes
from tests.core.measures import momentum
from tests.core.organ.test_stable_step import growth


def weight(model: OrganModel) -> np.ndarray:
    return model.node_mass.sum() * model.gravity


# ---- statics ------------------------------------------------------------------------------------------------------

# What a free block can lie on. It balances on a ball only where friction holds it.
BEDS = {
    "plane": (FLOOR,),
    "incline": (Support("floor", "plane", axis=(0.25, 0.1, 1.0), friction=0.8),),
    "box": (Support("bed", "box", position=(0.0, 0.0, -0.01), size=(0.016, 0.03, 0.01)),),
    "sphere": (Support("ball", "sphere", position=(0.0, 0.0, -0.05), size=(0.05,)),),
    "capsule": (Support("roll", "capsule", position=(0.0, 0.0, -0.03), axis=(0.0, 1.0, 0.0), size=(0.03, 0.1)),),
    "two rolls": tuple(
        Support(f"roll {x}", "capsule", position=(x, 0.0, -0.01), axis=(0.0, 1.0, 0.0), size=(0.01, 0.1))
        for x in (-0.012, 0.012)
    ),
    "bed and wall": (FLOOR, Support("wall", "plane", position=(-0.02, 0.0, 0.0), axis=(1.0, 0.0, 0.0))),
}


def bedded(bed: str) -> OrganModel:
    supports = BEDS[bed]
    gravity = (-4.0, 0.0, -8.0) if bed == "bed and wall" else (0.0, 0.0, -GRAVITY)
    return free_block(*supports, gravity=gravity, frame=supports[0].frame if bed == "incline" else None)


@pytest.mark.parametrize("bed", BEDS)
def test_supports_bear_the_weight(bed: str):
    """Statics: the supports' forces sum to -m g, to 1e-3 of it."""
    model = bedded(bed)
    forces = support_forces(model, rest_state(model))
    np.testing.assert_allclose(forces.sum(axis=0), -weight(model), atol=1e-3 * np.linalg.norm(weight(model)))
    assert (np.linalg.norm(forces, axis=1) > 0.1 * np.linalg.norm(weight(model))).all(), "each bears something"


@pytest.mark.parametrize("bed", BEDS)
def test_a_settled_organ_stays(bed: str):
    """Run freely for 100 ms no node is ever faster than 0.1 mm/s, nor does anything slide."""
    model = bedded(bed)
    state = rest_state(model)
    before, fastest = state.node_position.copy(), 0.0
    assert not state.node_velocity.any()
    for _ in range(100):
        run(model, state, 1e-3)
        fastest = max(fastest, float(np.linalg.norm(state.node_velocity, axis=1).max()))
    assert fastest < 1e-4
    assert np.abs(state.node_position - before).max() < 1e-6


def test_without_friction_bed_and_wall_bear_along_their_normals():
    """Both hold a node that is in both: the floor bears m g_z, the wall m g_x."""
    wall = Support("wall", "plane", position=(-0.02, 0.0, 0.0), axis=(1.0, 0.0, 0.0), friction=0.0)
    model = free_block(Support("floor", "plane", friction=0.0), wall, gravity=(-4.0, 0.0, -8.0))
    state = rest_state(model)
    mass = model.node_mass.sum()
    np.testing.assert_allclose(
        support_forces(model, state), mass * np.array([[0, 0, 8.0], [4.0, 0, 0]]), atol=1e-3 * mass
    )
    # The edge where they meet: in both of them.
    edge = (model.node_rest_position[:, 2] < 1e-9) & (model.node_rest_position[:, 0] < -0.0199)
    assert (state.node_position[edge, 2] < 0.0).all() and (state.node_position[edge, 0] < -0.02).all()


@pytest.mark.slow
def test_what_nothing_holds_does_not_settle():
    """On an incline steeper than friction holds, tan 20 degrees > 0.3."""
    tilt = np.radians(20.0)
    with pytest.raises(OrganDivergedError, match=r"did not settle.*supports"):
        rest_state(free_block(FLOOR, gravity=(GRAVITY * np.sin(tilt), 0.0, -GRAVITY * np.cos(tilt))))


# ---- friction -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_block_sticks_below_the_angle_of_friction():
    """tan 30 degrees = 0.577 < 0.6: in half a second it does not creep by 0.1 um."""
    assert crept(np.radians(30.0), 0.6) < 1e-7


@pytest.mark.parametrize(("degrees", "friction"), [(20.0, 0.0), (25.0, 0.3)])
def test_a_block_slides_as_coulomb_says(degrees: float, friction: float):
    """a = g (sin t - mu cos t) along the slope, mean of 0.3 s from 2 x / t^2 and from v / t, to 2 %."""
    tilt = np.radians(degrees)
    wanted = GRAVITY * (np.sin(tilt) - friction * np.cos(tilt))
    assert slid(tilt, friction) == pytest.approx((wanted, wanted), rel=0.02)


# ---- motion -------------------------------------------------------------------------------------------------------


def resting_energy(model: OrganModel, state: OrganState) -> float:
    """Energy of the floor's springs, normal and tangential: sum of A (k_p d^2 + k_t u^2) / 2 [J]."""
    depth = np.maximum(-state.node_position[model.support_nodes, 2], 0.0)
    stretch = (state.support_stretch[:, 0] ** 2).sum(axis=1)
    density = model.support_stiffness * depth**2 + model.support_tangential_stiffness * stretch
    return 0.5 * float(model.support_area @ density)


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_a_thrown_block_neither_tunnels_nor_gains_energy(friction: float):
    """At 1 m/s, aslant and turning, onto an undamped floor: total energy never above the start's by 2 %.

    At 0.2 of the stable step: position and velocity of symplectic Euler stand half a step apart, 5 % of energy at 0.9.
    """
    floor = Support("floor", "plane", friction=friction)
    model = free_block(floor, gravity=(0.0, 0.0, 0.0), law=SupportLaw(1e7, 0.0), damping=oracle.UNDAMPED, lift=0.002)
    state = rest_state(model)
    state.node_velocity[:] = np.array([0.3, 0.0, -1.0]) + np.cross([0.0, 3.0, 0.0], model.node_rest_position)
    start, highest, lowest = kinetic_energy(model, state), 0.0, 0.0
    for _ in range(400):
        run(model, state, 5e-4, 0.2 * model.stable_step)
        energy = kinetic_energy(model, state) + potential_energy(model, state) + resting_energy(model, state)
        highest, lowest = max(highest, energy), min(lowest, float(state.node_position[:, 2].min()))
    print(f"\nhighest energy {highest / start:.4f} of the start's, deepest node {lowest * 1e3:.2f} mm")
    assert highest < 1.02 * start
    assert lowest > -0.003
    assert state.node_position[:, 2].min() > 0.005, "it has bounced off"


def test_supports_are_the_only_force_from_outside():
    """dp = dt (m g + support force), alpha = 0, in each of 200 steps of a fall onto a roll; to 1e-12 of the largest."""
    roll = Support(
        "roll", "capsule", position=(0.01, 0.0, -0.021), axis=(0.3, 1.0, 0.0), size=(0.02, 0.1), friction=0.0
    )
    model = free_block(roll, damping=oracle.UNDAMPED)
    state = rest_state(model._replace(gravity=oracle.frozen(np.zeros(3))))
    state.node_velocity[:, 2] = -0.3
    dt, worst, largest = 0.9 * model.stable_step, 0.0, 0.0
    for _ in range(200):
        before, outside = momentum(model, state), support_forces(model, state)[0] + weight(model)
        advance(model, state, dt=dt)
        worst = max(worst, float(np.abs(momentum(model, state) - before - dt * outside).max()))
        largest = max(largest, dt * float(np.abs(outside).max()))
    assert largest > 2.0 * dt * np.linalg.norm(weight(model))
    assert worst < 1e-12 * largest * len(model.node_mass)


def test_a_push_that_ends_leaves_the_block_where_friction_holds_it():
    """Stick and slip are remembered: the same state, copied without its stretch, goes another way."""
    model, state = on_incline(np.radians(20.0), 0.4)
    kept = {name: getattr(state, name).copy() for name in KEPT_NAMES}
    run(model, state, 0.05)
    again = rest_state(model._replace(gravity=oracle.frozen(np.zeros(3))))._replace(**kept)
    run(model, again, 0.05)
    forgetful = rest_state(model._replace(gravity=oracle.frozen(np.zeros(3))))
    forgetful.node_position[:] = kept["node_position"]
    run(model, forgetful, 0.05)
    assert again.node_position.tobytes() == state.node_position.tobytes()
    assert again.support_stretch.tobytes() == state.support_stretch.tobytes()
    assert np.abs(forgetful.node_position - state.node_position).max() > 1e-6


# ---- the stable step ----------------------------------------------------------------------------------------------

# Supports, their law: each limit is sharp, as a floor's nodes are held with just what the step counts.
STEPS = {
    "stiffness": ((FLOOR,), SupportLaw(1e9, 0.0)),
    "damping": ((FLOOR,), SupportLaw(1e7, 5e4)),
    "both": ((FLOOR,), SupportLaw(5e8, 2e4)),
    "two at once": ((FLOOR, Support("carpet", "plane")), SupportLaw(5e8, 0.0)),
}


@pytest.mark.parametrize("part", STEPS)
def test_stable_just_below_and_unstable_beyond(part: str):
    """A free block drifts from its twin in proportion to time, at any stable step alike; beyond it, exponentially."""
    supports, law = STEPS[part]
    model = free_block(*supports, law=law)
    assert growth(model, None, 0.95 * model.stable_step) < 5.0 * growth(model, None, 0.5 * model.stable_step) < 1e3
    assert growth(model, None, 1.1 * model.stable_step) > 1e3
    assert model.stable_step < 0.7 * free_block(FLOOR).stable_step


def test_the_stable_step_counts_supports_and_contact_together():
    # Contact this stiff takes its part at any step, the floor the other.
    law = ContactLaw(stiffness=1e9, damping=0.0, friction=0.0, tangential_stiffness=1e8)
    held, free = free_block(FLOOR, law=SupportLaw(5e7, 0.0)), free_block()
    assert stable_dt(held, law) < 0.95 * min(stable_dt(held), stable_dt(free, law))
    assert stable_dt(free) > 1.5 * stable_dt(held)


# ---- settling once ------------------------------------------------------------------------------------------------


def test_the_same_organ_settles_once(monkeypatch):
    calls = []
    relax = organ_compile._relax
    monkeypatch.setattr(organ_compile, "_settled", type(organ_compile._settled)())
    monkeypatch.setattr(organ_compile, "CACHED", 2)
    monkeypatch.setattr(organ_compile, "_relax", lambda *given: (calls.append(1), relax(*given)))
    first = rest_state(free_block(FLOOR))
    again = rest_state(free_block(FLOOR))
    assert len(calls) == 1
    for name in KEPT_NAMES:
        assert getattr(again, name).tobytes() == getattr(first, name).tobytes(), name
    assert rest_state(free_block(FLOOR), shape_count=3).node_position.tobytes() == first.node_position.tobytes()
    assert len(calls) == 1
    again.node_position[:] = 0.0
    assert rest_state(free_block(FLOOR)).node_position.tobytes() == first.node_position.tobytes()
    rest_state(free_block(FLOOR, modulus=6000.0))
    rest_state(free_block(Support("floor", "plane", friction=0.2)))
    assert len(calls) == 3 and len(organ_compile._settled) == 2
    rest_state(free_block(FLOOR))
    assert len(calls) == 4


# ---- lanes --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_lanes_rest_as_their_organs_do_alone():
    """Eight organs of their own moduli on bed and wall, pressed and let go: to the bit, float64."""
    wall = Support("wall", "box", position=(0.03, 0.0, 0.0), rotation=(0.9, 0.0, 0.1, 0.0), size=(0.01, 0.03, 0.03))
    organs = [free_block(FLOOR, wall, modulus=4000.0 + 500.0 * lane, anchored=True) for lane in range(8)]
    law = ContactLaw(stiffness=2e7, damping=500.0, friction=0.4, tangential_stiffness=1e7)
    balls = [oracle.ball((0.0, 1e-3 * lane, 0.0275), 0.008, velocity=(0.02, 0.0, -0.05)) for lane in range(8)]
    dt = 0.9 * min(stable_dt(organ, law) for organ in organs)
    alone = [rest_state(organ, shape_count=1) for organ in organs]
    model, state, shapes = stack_organs(organs), rest_lanes(organs, shape_count=1), stack_shapes(balls)
    wrench, lane_wrench = np.zeros((8, 1, 6)), np.zeros((8, 1, 6))
    for step in range(150):
        if step == 100:
            for ball in (*balls, shapes):
                ball.tool_twist[..., 2] *= -1.0
        for organ, single, ball, into in zip(organs, alone, balls, wrench, strict=True):
            assert advance_organ(organ, single, ball, law, dt, 5, into) == FAULT_NONE
        assert not advance_lanes(model, state, shapes, law, dt, 5, lane_wrench).any()
        assert lane_wrench.tobytes() == wrench.tobytes(), f"step {step}"
    for lane, single in enumerate(alone):
        assert (np.abs(single.support_stretch).max(axis=(0, 2)) > 0.0).all(), "both are touched"
        other = get_lane(state, lane)
        for name in KEPT_NAMES:
            assert getattr(other, name).tobytes() == getattr(single, name).tobytes(), f"lane {lane}: {name}"


def test_a_state_of_other_supports_is_refused():
    with pytest.raises(OrganError, match="memory of contact points, nodes on supports"):
        advance(free_block(FLOOR), rest_state(free_block(gravity=(0.0, 0.0, 0.0))), dt=1e-5)


# ---- the frame of a support ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "axis", [(0.0, 0.0, 1.0), (0.0, 0.0, -2.0), (1.0, 0.0, 0.0), (0.3, -2.0, 0.7), (1e-8, 0.0, -1.0)]
)
def test_an_axis_turns_z_there_the_shortest_way(axis):
    support = Support("s", "plane", axis=axis)
    np.testing.assert_allclose(support.frame[:, 2], np.array(axis) / np.linalg.norm(axis), atol=1e-7)
    w, x, y, z = support.quaternion
    np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), support.frame, atol=1e-12)
    assert abs(z) < 1e-12, "about an axis across z"
