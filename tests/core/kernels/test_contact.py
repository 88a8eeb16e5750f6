"""Contact as a whole: presses, friction, the far side of a thin plate, letting go. Balls move as told; no MuJoCo."""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from msdm_core.errors import OrganError
from msdm_core.kernels.structure_kernels import ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.material.regions import Damping, Material
from msdm_core.organ.compile import rest_state
from msdm_core.organ.measure import inverted_tets
from msdm_core.organ.stability import stable_dt
from msdm_core.organ.stepping import advance
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import make_scene
from tests.core import oracle


def test_advance_counts_contact_in_the_stable_step_and_refuses_a_foreign_state():
    scene = make_scene("phantom")
    model = load_anatomy(scene).organ()
    law = scene.contact.law
    shapes = oracle.single_tool([[[0.03, 0.03, 0.06]] * 2], [0.008])
    # Ten times as stiff as the scene's: it counts, though contact is implicit.
    law = law._replace(stiffness=10.0 * law.stiffness)
    limit = stable_dt(model, law)
    assert limit < 0.6 * model.stable_step
    state = rest_state(model, shape_count=1)
    with pytest.raises(OrganError, match="at most the stable step"):
        advance(model, state, dt=1.001 * limit, shapes=shapes, contact=law)
    advance(model, state, dt=0.999 * limit, shapes=shapes, contact=law)
    # Without shapes nothing touches, and the longer step is fine.
    advance(model, state, dt=0.999 * model.stable_step)
    with pytest.raises(OrganError, match=rf"the state has {len(model.node_mass)} nodes.* the organ"):
        advance(oracle.block(), state, dt=1e-5)


HAPTIC_STEP = 1e-3  # [s]
PRESS_SPEED = 0.01  # [m/s]
SITES = {"a node": (0.03, 0.03, 0.03), "between nodes": (0.0312, 0.0287, 0.03)}


@cache
def phantom() -> Anatomy:
    return load_anatomy(make_scene("phantom"))


@cache
def phantom_organ(site: str, hard: bool) -> OrganModel:
    """The phantom, healthy or with its stiffest, shallowest, largest lesion below a site."""
    anatomy = phantom()
    draw = anatomy.scene.lesion
    lesion = anatomy.lesion_below(np.array(SITES[site]), draw.radius[1], draw.cover[0], draw.modulus_ratio[1], "worst")
    return anatomy.organ([lesion] if hard else [])


class Press(NamedTuple):
    """Depth of the ball's lowest point [m], force along z [N], smallest volume ratio so far, each haptic step."""

    depth: NDArray
    force: NDArray
    volume_ratio: NDArray
    state: OrganState


def press(model: OrganModel, site: ArrayLike, radius: float, stop: float, speed: float = PRESS_SPEED) -> Press:
    """Push a ball straight down into the phantom until it is pushed back with `stop` [N], or lets go, or 25 mm deep."""
    timing, law = phantom().scene.timing, phantom().scene.contact.law
    state = rest_state(model, shape_count=1)
    start = np.asarray(site) + np.array([0.0, 0.0, radius])
    shapes = oracle.ball(start, radius, velocity=(0.0, 0.0, -speed))
    rows = []
    while True:
        wrench = step(model, state, shapes, law, timing.substep_count)
        depth, force = start[2] - shapes.shape_ends[0, 0, 2], wrench[2]
        rows.append((depth, force, state.volume_ratio_smallest[0]))
        lost = force < 0.7 * max(row[1] for row in rows) and depth > 1e-3
        if force >= stop or lost or depth > 0.025:
            return Press(*np.array(rows).T, state)


def step(model: OrganModel, state: OrganState, shapes: ContactShapes, law: ContactLaw, substeps: int) -> NDArray:
    """One haptic step: the mean wrench on the tool, (6,)."""
    dt = HAPTIC_STEP / substeps
    return advance(model, state, dt=dt, substep_count=substeps, shapes=shapes, contact=law)[0]


def rises(force: NDArray) -> bool:
    """True if a force read every 10 ms rises from the first touch on (within that, the organ's own swing shows).

    Over a node the nearest quadrature point is 1.2 mm to the side: a ball of 8 mm sinks 0.1 mm and more before it
    meets one.
    """
    touched = force[np.flatnonzero(force > 0.0)[0] :]
    return bool((np.diff(touched[9::10]) > 0.0).all())


# ---- presses ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hard", [False, True], ids=["healthy", "lesion 10x, 10 mm, cover 3 mm"])
@pytest.mark.parametrize("site", SITES)
def test_a_press_to_one_and_a_half_times_the_hard_limit(site: str, hard: bool):
    """Force rises with depth all the way to 1.2 N, no fault, no inverted tet."""
    scene = phantom().scene
    target = 1.5 * scene.limits.hard_force
    model = phantom_organ(site, hard)
    pressed = press(model, SITES[site], scene.instrument.tip_radius, target)
    print(
        f"\n{site}, {'lesion' if hard else 'healthy'}: {pressed.force[-1]:.3f} N at {pressed.depth[-1] * 1e3:.2f} mm,"
        f" smallest V/V0 {pressed.volume_ratio[-1]:.2f}"
    )
    assert pressed.force[-1] >= target
    assert rises(pressed.force)
    assert np.diff(pressed.force).min() > -0.002 * target
    # Over the lesion 3 mm of tissue, less than a cell, lie between it and a ball 7.5 mm deep.
    assert pressed.volume_ratio[-1] > 0.2
    assert not inverted_tets(model, pressed.state).size


def test_a_lesion_is_felt():
    """At the scene's press depth the worst lesion pushes back at least twice as hard as healthy tissue."""
    depth, radius = phantom().scene.palpation.press_depth, phantom().scene.instrument.tip_radius
    force = []
    for hard in (False, True):
        pressed = press(phantom_organ("a node", hard), SITES["a node"], radius, 1.2)
        force.append(np.interp(depth, pressed.depth, pressed.force))
    assert 0.15 < force[0] < 0.35
    assert force[1] > 2.0 * force[0]


# ---- a floor: closed forms ----------------------------------------------------------------------------------------

FLOOR_LAW = ContactLaw(stiffness=2e7, damping=0.0, friction=0.3, tangential_stiffness=1e7)


@cache
def floor() -> OrganModel:
    """A plate of fixed nodes with a free top: contact and friction by themselves."""
    free = oracle.block((0.02, 0.02, 0.002), (20, 20, 2))
    return free._replace(node_inverse_mass=oracle.frozen(np.zeros_like(free.node_mass)), stable_step=1.0)


def on_floor(depth: float, *, radius: float = 0.008) -> tuple[OrganState, ContactShapes]:
    """A ball at a depth [m] in the middle of the floor."""
    state = rest_state(floor(), shape_count=1)
    return state, oracle.ball((0.01003, 0.00996, 0.002 - depth + radius), radius)


def move(state: OrganState, shapes: ContactShapes, velocity: ArrayLike, count: int, law: ContactLaw) -> NDArray:
    """The floor's wrench on the ball over some haptic steps at a velocity [m/s], shape (count, 6)."""
    shapes.tool_twist[0, :3] = velocity
    return np.array([step(floor(), state, shapes, law, 1) for _ in range(count)])


@pytest.mark.parametrize("depth", [0.2e-3, 0.5e-3, 1e-3])
def test_a_ball_on_a_floor_feels_the_integrated_pressure(depth: float):
    """F = int k_p g (s / r) dA = (k_p / r^2) int s^2 (s + t) dA, t = d - r, s^2 = r^2 - rho^2, out to s + t = 0.

    With dA = 2 pi rho drho = -2 pi s ds: F = 2 pi (k_p / r^2) [s^5 / 5 + t s^4 / 4] from s = -t to s = r. Quadrature
    points are 0.5 mm apart, the contact radius is 1.8 to 3.9 mm.
    """
    radius = 0.008
    t = depth - radius
    integral = (radius**5 - (-t) ** 5) / 5.0 + t * (radius**4 - t**4) / 4.0
    state, shapes = on_floor(depth, radius=radius)
    force = move(state, shapes, (0.0, 0.0, 0.0), 1, FLOOR_LAW)[0, 2]
    assert force == pytest.approx(2.0 * np.pi * FLOOR_LAW.stiffness / radius**2 * integral, rel=0.03)


def test_sliding_friction_is_mu_times_the_normal_force():
    """Steady sliding: |T| = mu N against the motion, within 5 % (the ball's flanks tilt by d / r, second order)."""
    state, shapes = on_floor(0.3e-3)
    wrench = move(state, shapes, (0.01, 0.0, 0.0), 150, FLOOR_LAW)[50:]
    ratio = wrench[:, 0] / wrench[:, 2]
    assert ratio == pytest.approx(-FLOOR_LAW.friction, rel=0.05)
    assert ratio.mean() == pytest.approx(-FLOOR_LAW.friction, rel=0.03)
    assert np.abs(wrench[:, 1] / wrench[:, 2]).max() < 0.05 * FLOOR_LAW.friction
    slow = move(*on_floor(0.3e-3), (0.001, 0.0, 0.0), 1000, FLOOR_LAW)[-50:]  # Coulomb: the speed does not matter
    assert (slow[:, 0] / slow[:, 2]).mean() == pytest.approx(ratio.mean(), rel=0.02)


def test_sticking_friction_is_a_spring_that_remembers():
    """Below the limit T = -k_t A u: constant at rest, zero again when the ball is back.

    Drawn by 2 um: at this depth the edge of the patch, 2.7 mm in radius, passes no point. One of 360 would change the
    slope by up to 20 / 360 in the step in which it is let go. The planes of the stretches tilt by u / r.
    """
    state, shapes = on_floor(0.46e-3)
    law = FLOOR_LAW._replace(friction=5.0)  # sticks throughout
    out = move(state, shapes, (1e-4, 0.0, 0.0), 20, law)
    slope = np.diff(out[:, 0])
    np.testing.assert_allclose(slope, slope[0], rtol=2e-6 / 0.008)  # linear
    assert slope[0] < 0.0
    engaged = state.contact_engaged.copy()
    held = move(state, shapes, (0.0, 0.0, 0.0), 500, law)
    np.testing.assert_array_equal(state.contact_engaged, engaged)
    np.testing.assert_allclose(held - held[0], 0.0, rtol=0, atol=1e-12 * held[0, 2])  # no creep in 0.5 s
    # Friction is that of a step's end: the 20th step on the way out began with 20 of stretch and counted one ahead.
    assert held[0, 0] == pytest.approx(out[-1, 0] * 20.0 / 21.0, rel=5e-3)
    move(state, shapes, (-1e-4, 0.0, 0.0), 20, law)
    back = move(state, shapes, (0.0, 0.0, 0.0), 1, law)
    assert abs(back[-1, 0]) < 0.01 * abs(out[-1, 0])


def test_sliding_on_tissue():
    """On the phantom too, friction drags by mu N, and not at all for mu = 0: mean over one cell of the lattice.

    Pressed 1.5 mm and drawn along x; on the way the mesh lets the force along x swing by 0.03 N / N either way.
    """
    drag = {}
    for friction in (0.2, 0.0):
        model, law = phantom_organ("a node", False), phantom().scene.contact.law._replace(friction=friction)
        state = rest_state(model, shape_count=1)
        shapes = oracle.ball((0.022, 0.0312, 0.038), 0.008, velocity=(0.0, 0.0, -0.015))
        for _ in range(100):
            step(model, state, shapes, law, 4)
        shapes.tool_twist[0, :3] = 0.0
        for _ in range(100):
            step(model, state, shapes, law, 4)
        shapes.tool_twist[0, :3] = (0.02, 0.0, 0.0)
        wrench = np.array([step(model, state, shapes, law, 4) for _ in range(450)])[200:]
        drag[friction] = float((wrench[:, 0] / wrench[:, 2]).mean())
    print(f"\nmean drag / N: {drag}")
    assert abs(drag[0.0]) < 0.05 * 0.2
    assert -drag[0.2] == pytest.approx(0.2, rel=0.05)


def test_sticking_on_tissue_does_not_creep():
    """Pressed, drawn aside below the limit of friction, held: force and tissue stay as they are for 0.5 s."""
    model, law = phantom_organ("a node", False), phantom().scene.contact.law._replace(friction=0.8)
    model = model._replace(alpha=150.0)  # near critical: at rest soon
    state = rest_state(model, shape_count=1)
    shapes = oracle.ball((0.03, 0.03, 0.038), 0.008, velocity=(0.0, 0.0, -0.02))
    for velocity, count in (((0.0, 0.0, -0.02), 100), ((0.005, 0.0, 0.0), 80), ((0.0, 0.0, 0.0), 700)):
        shapes.tool_twist[0, :3] = velocity
        for _ in range(count):
            wrench = step(model, state, shapes, law, 4)
    before, place = wrench, state.node_position.copy()
    for _ in range(500):
        wrench = step(model, state, shapes, law, 4)
    assert -before[0] > 0.1 * before[2]  # friction does hold something
    np.testing.assert_allclose(wrench[:3], before[:3], rtol=0, atol=1e-5 * before[2])
    assert np.abs(state.node_position - place).max() < 1e-8


# ---- the far side, letting go ---------------------------------------------------------------------------------------


def test_the_far_side_of_a_thin_plate_is_not_touched():
    """A 5 mm ball pressed into a plate of 3 mm: only points of the near side are ever engaged."""
    model = thin_plate()
    near = (model.node_rest_position[model.surface_triangles][:, :, 2] > 0.003 - 1e-9).all(axis=1)
    far = (model.node_rest_position[model.surface_triangles][:, :, 2] < 1e-9).all(axis=1)
    assert near.sum() == 2 * far.sum() > 200  # nodes in the middle of the near side's squares
    law = ContactLaw(stiffness=2e7, damping=100.0, friction=0.2, tangential_stiffness=1e7)
    state = rest_state(model, shape_count=1)
    shapes = oracle.ball((0.0151, 0.0148, 0.003 + 0.005), 0.005, velocity=(0.0, 0.0, -0.01))
    for _ in range(150):
        wrench = step(model, state, shapes, law, 8)
        touched = state.contact_engaged[0].reshape(-1, 4).any(axis=1)
        assert not touched[~near].any()
    assert wrench[2] > 0.01 and touched[near].any()
    # Far points lie below the ball, and along their normal s + t > 0: depth alone would have pushed them.
    offset = state.node_position[np.unique(model.surface_triangles[far])] - shapes.shape_ends[0, 0]
    chord = np.sqrt(np.maximum(0.005**2 - (offset[:, :2] ** 2).sum(axis=1), 0.0))
    assert ((chord > 0.0) & (chord - offset[:, 2] > 0.0)).sum() > 5


def thin_plate() -> OrganModel:
    """30 x 30 x 3 mm, held by its rim."""
    free = oracle.block((0.03, 0.03, 0.003), (10, 10, 1), material=Material(2e4, 1000.0, 0.45), damping=Damping(100.0))
    points = free.node_rest_position[:, :2]
    rim = ((points < 1e-9) | (points > 0.03 - 1e-9)).any(axis=1)
    return free._replace(node_inverse_mass=oracle.frozen(np.where(rim, 0.0, free.node_inverse_mass)))


def test_letting_go_forgets_everything():
    """Parted: nothing engaged, no stretch, no force; a second press from rest equals the first to the bit."""
    model = phantom_organ("a node", False)._replace(alpha=200.0)
    law = phantom().scene.contact.law
    state = rest_state(model, shape_count=1)

    def touch() -> NDArray:
        shapes = oracle.ball((0.0293, 0.0306, 0.0385), 0.008, velocity=(0.01, 0.0, -0.02))
        return np.array([step(model, state, shapes, law, 4) for _ in range(100)])

    first = touch()
    assert state.contact_engaged.any() and np.abs(state.contact_stretch).max() > 0.0 and first[-1, 2] > 0.05
    away = oracle.ball((0.03, 0.03, 0.08), 0.008)
    np.testing.assert_array_equal(step(model, state, away, law, 4), 0.0)
    assert not state.contact_engaged.any() and not state.contact_stretch.any()
    state.node_position[:] = model.node_rest_position
    state.node_velocity[:] = 0.0
    np.testing.assert_array_equal(touch(), first)


def test_a_ball_drawn_out_releases_point_by_point():
    """Pressed and drawn straight back: force falls to nothing, the memory is empty at the end."""
    model, law = phantom_organ("a node", False), phantom().scene.contact.law
    state = rest_state(model, shape_count=1)
    shapes = oracle.ball((0.03, 0.03, 0.038), 0.008, velocity=(0.0, 0.0, -0.02))
    engaged = []
    for count in (150, 250):
        for _ in range(count):
            wrench = step(model, state, shapes, law, 4)
            engaged.append(int(state.contact_engaged.sum()))
        shapes.tool_twist[0, 2] = 0.02
    assert max(engaged) == engaged[149] > 20
    assert engaged[-1] == 0 and not state.contact_stretch.any()
    np.testing.assert_array_equal(wrench, 0.0)


def test_phantoms_substeps_are_below_the_stable_step():
    """The presses above ran as the scene does: its substep stays below the stable step with contact."""
    model = phantom_organ("a node", True)
    assert HAPTIC_STEP / phantom().scene.timing.substep_count < stable_dt(model, phantom().scene.contact.law)
