"""Friction: a ball drawn over the phantom, a strip between the pads of a jaw, a free block on supports."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msdm_core.arithmetic import matmul
from msdm_core.kernels import (
    QUADRATURE_BARYCENTRIC,
    QUADRATURE_RISE,
    QUADRATURE_WEIGHT,
    ContactLaw,
    ContactShapes,
    OrganModel,
    OrganState,
)
from msdm_core.material import Damping, Material
from msdm_core.mesh import FloatArray, TetMesh
from msdm_core.meshing import box_mesh
from msdm_core.organ import (
    OrganSpec,
    Support,
    SupportLaw,
    advance,
    advance_or_raise,
    compile_organ,
    rest_state,
    round_shapes,
    stable_dt,
    support_forces,
)
from surgsim_apps.validation.row import Row, compare
from surgsim_apps.validation.statics import vector_areas
from surgsim_apps.validation.touch import BallOnOrgan, ball, block

RADIUS = 0.008  # [m]
SPEED = 0.02  # [m/s]
# Start of the ball, direction, and number of haptic steps after SETTLING: two periods of the lattice, over which the
# mesh's part cancels.
LINES = {
    "along edges": ((0.022, 0.030), (1.0, 0.0), 500),
    "between nodes": ((0.022, 0.0312), (1.0, 0.0), 500),
    "along diagonals": ((0.0225, 0.0225), (0.7071, 0.7071), 707),
}
SETTLING = 200
JUMP_TOLERANCE = 0.02
FRICTION_TOLERANCE = 0.05

# The strip, its jaw and its weight.
WIDTH, LENGTH = 0.010, 0.060  # [m]
MODULUS, POISSON, DENSITY = 20e3, 0.45, 1060.0
# Length between the pads, height of the weight, levels of the measured strain, a width away from pads and weight [m].
HELD, WEIGHT_HEIGHT = 0.010, 0.005
GAUGE = (0.015, 0.040)
WEIGHT = 0.004  # [kg]
PAD_RADIUS = 0.0015  # [m]
LAW = ContactLaw(stiffness=3e7, damping=100.0, friction=0.2, tangential_stiffness=1.5e7)
# Of the pads, rougher than the law.
FRICTION = 0.4
# Growth of the load from step to step until the strip slips: the resolution of the slip load.
LOAD_STEP = 0.02
# A sticking strip moves by less than 2 mm; a strip that slips goes on falling [m].
SLIPPED = 0.002

# The block on supports.
GRAVITY = 9.81  # [m/s^2]
DAMPED = Damping(alpha=25.0)
FLOOR = Support("floor", "plane")
STEP_SHARE = 0.9
SLIDES = ((20.0, 0.2), (35.0, 0.4))  # angle [degrees], friction
SLIDING_TIME = 0.3  # [s]


def slide(touch: BallOnOrgan, line: str, depth: float) -> tuple[FloatArray, OrganState, ContactShapes]:
    """Forces of steady sliding [N] (n, 3), state and ball at its end."""
    start, direction, count = LINES[line]
    state, shapes = rest_state(touch.model, shape_count=1), ball(start, RADIUS)
    touch.move(state, shapes, (0.0, 0.0, -0.02), round(depth / 2e-5))
    touch.move(state, shapes, (0.0, 0.0, 0.0), 200)
    force = touch.move(state, shapes, (SPEED * direction[0], SPEED * direction[1], 0.0), SETTLING + count)
    return force[SETTLING:], state, shapes


def coulomb(touch: BallOnOrgan, state: OrganState, shapes: ContactShapes, direction: FloatArray) -> tuple[float, float]:
    """Friction along the motion by the stored stick-slip state, and mu times the local pressure along it, summed [N].

    Sliding drags a point along the motion without its part along the ball's normal e. The pressure is k_p g (s / r) of
    the contact law, g = s (s + t) / r, on the deformed surface.
    """
    model, law, radius = touch.model, touch.law, float(shapes.shape_radius[0])
    corners = state.node_position[model.surface_triangles]
    normal = vector_areas(state.node_position, model.surface_triangles)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    rise = np.einsum("tjk,tjx->tkx", model.surface_rise, state.node_position[model.surface_around])
    points = np.einsum("qc,tcx->tqx", QUADRATURE_BARYCENTRIC, corners)
    offset = points + np.einsum("qk,tkx->tqx", QUADRATURE_RISE, rise) - shapes.shape_ends[0, 0]
    height = np.einsum("tqx,tx->tq", offset, normal)
    across = offset - height[:, :, None] * normal[:, None]
    chord = np.sqrt(np.maximum(radius**2 - (across**2).sum(axis=2), 0.0))
    area = (model.surface_rest_area * QUADRATURE_WEIGHT)[:, None]
    push = area * law.stiffness * (chord + height) * (chord / radius) ** 2
    outward = (chord[:, :, None] * normal[:, None] - across) / radius
    along = direction - (outward @ direction)[:, :, None] * outward
    along /= np.linalg.norm(along, axis=2)[:, :, None]
    touched = state.contact_engaged[0].reshape(push.shape).astype(bool)
    expected = law.friction * float((push * (along @ direction))[touched].sum())
    lag = -state.contact_stretch[0].reshape(*push.shape, 3) @ direction
    return law.tangential_stiffness * float((area * lag)[touched].sum()), expected


def sliding() -> Iterator[Row]:
    """Largest jump of the force between haptic steps, and steady friction, over sliding directions."""
    touch = block(12, alpha=None)
    friction = touch.law.friction
    for line, (_, direction, _) in LINES.items():
        along = np.array([*direction, 0.0])
        force, _, _ = slide(touch, line, 0.004)
        jump = float((np.linalg.norm(np.diff(force, axis=0), axis=1) / np.linalg.norm(force[1:], axis=1)).max())
        yield compare(
            f"sliding {line}, largest jump between haptic steps", "continuity", expected=0.0, measured=jump,
            tolerance=JUMP_TOLERANCE,
            note=f"share of the force; tip 8 mm, 4 mm deep, {1e3 * SPEED:g} mm/s, friction {friction:g}",
        )  # fmt: skip
        shallow, _, _ = slide(touch, line, 0.0015)
        share = -shallow @ along / shallow[:, 2]
        yield compare(
            f"sliding {line}, tangential force over mu N", "Coulomb", expected=1.0,
            measured=float(share.mean()) / friction, tolerance=FRICTION_TOLERANCE,
            note="tip 8 mm, 1.5 mm deep (cell / contact radius 1.44), mean over two cells; on the way the mesh "
            f"makes it swing by {share.std():.3f} N / N, without friction too",
        )  # fmt: skip
    yield deep_friction(touch)
    yield sticking()


def deep_friction(touch: BallOnOrgan) -> Row:
    """Friction of a ball 4 mm deep against mu times the pressure, point by point."""
    line = "between nodes"
    along = np.array([*LINES[line][1], 0.0])
    force, state, shapes = slide(touch, line, 0.004)
    measured, expected = coulomb(touch, state, shapes, along)
    total = float((-force @ along / (touch.law.friction * force[:, 2])).mean())
    return compare(
        "sliding 4 mm deep, friction over the integral of mu p", "Coulomb at each point", expected=1.0,
        measured=measured / expected, tolerance=FRICTION_TOLERANCE,
        note=f"the whole tangential force is {total:.2f} mu N: the normal force is not all of the pressure on a ball "
        "that sits deep, and the tissue ahead leans against it",
    )  # fmt: skip


def sticking() -> Row:
    """Ball moved aside below the friction limit: change of the force in half a second over the normal force."""
    soft = block(12)
    touch = BallOnOrgan.on(soft.model, soft.law._replace(friction=0.8))
    state, shapes = rest_state(touch.model, shape_count=1), ball((0.03, 0.03), RADIUS)
    for velocity, count in (((0.0, 0.0, -0.02), 100), ((0.005, 0.0, 0.0), 80), ((0.0, 0.0, 0.0), 700)):
        before = touch.move(state, shapes, velocity, count)[-1]
    after = touch.move(state, shapes, (0.0, 0.0, 0.0), 500)[-1]
    return compare(
        "sticking, change of the force in 0.5 s", "no creep", expected=0.0,
        measured=np.linalg.norm(after - before) / before[2], tolerance=1e-4,
        note=f"share of the normal force; friction holds {-before[0] / before[2]:.2f} of it, mu 0.8",
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class HangingStrip:
    """Strip between two pads that close along x, with a gravity for each run.

    Args:
        model, state: of the strip.
        pads: tools 0 and 1.
        dt: of a substep [s].
    """

    model: OrganModel
    state: OrganState
    pads: ContactShapes
    dt: float

    def run(
        self, duration: float, *, gravity: float = 0.0, tilt: float = 0.0, closing: float = 0.0, turning: float = 0.0
    ) -> FloatArray:
        """Advance by a duration; returns the last wrenches on the pads [N, N m], shape (2, 6).

        Args:
            duration: [s].
            gravity: along -z [m/s^2].
            tilt: of gravity about x [rad].
            closing: of each pad [m/s].
            turning: of both about x, around their middle [rad/s].

        Raises:
            OrganDivergedError: the simulation of the strip ended with a fault.
        """
        pull = -gravity * np.array([0.0, -np.sin(tilt), np.cos(tilt)])
        pull.setflags(write=False)
        model, wrench = self.model._replace(gravity=pull), np.zeros((2, 6))
        self.pads.tool_twist[:] = 0.0
        self.pads.tool_twist[:, 0] = closing, -closing
        self.pads.tool_twist[:, 3] = turning
        if turning:
            arm = self.pads.tool_centre - self.pads.tool_centre.mean(axis=0)
            self.pads.tool_twist[:, :3] += np.cross([turning, 0.0, 0.0], arm)
        for _ in range(round(duration / (5 * self.dt))):
            wrench = advance_or_raise(model, self.state, self.dt, 5, self.pads, LAW)
        return wrench

    def height(self, level: float) -> float:
        """Mean present height of the nodes of a level at rest [m]."""
        nodes = np.abs(self.model.node_rest_position[:, 2] - level) < 1e-6
        return float(self.state.node_position[nodes, 2].mean())

    @property
    def gauge_length(self) -> float:
        """Present distance of the two levels of GAUGE [m]."""
        return self.height(GAUGE[1]) - self.height(GAUGE[0])

    def carried(self, gravity: float) -> float:
        """Tension of the gauge [N]: mean of the weight below its levels."""
        rest, mass = self.model.node_rest_position[:, 2], self.model.node_mass
        return gravity * float(np.mean([mass[rest < level].sum() for level in np.linspace(*GAUGE, 101)]))


def grip(wrench: FloatArray) -> float:
    """Mean of the normal forces on both pads [N]."""
    return float(0.5 * (wrench[1, 0] - wrench[0, 0]))


def gripped_strip(friction: float = FRICTION) -> HangingStrip:
    """Strip of 10 x 10 x 60 mm, its lowest 5 mm heavier by 4 g, at rest in a grip of 0.33 N without gravity."""
    box = box_mesh((WIDTH, WIDTH, LENGTH), (4, 4, 24))
    low = box.points[box.tets].mean(axis=1)[:, 2] < WEIGHT_HEIGHT
    mesh = TetMesh(box.points, box.tets, np.where(low, 1, 0), {0: "strip", 1: "weight"})
    heavy = Material(MODULUS, DENSITY + WEIGHT / (WIDTH * WIDTH * WEIGHT_HEIGHT), POISSON)
    materials = {"strip": Material(MODULUS, DENSITY, POISSON), "weight": heavy}
    model = compile_organ(OrganSpec(mesh=mesh, materials=materials, damping=Damping(alpha=40.0)))
    middle, half = LENGTH - 0.5 * HELD, 0.5 * HELD
    reach = (-0.001 + PAD_RADIUS, WIDTH + 0.001 - PAD_RADIUS)
    ends = [[[x, y, middle] for y in reach] for x in (-PAD_RADIUS, WIDTH + PAD_RADIUS)]
    span = [[0.0, 0.0, half - PAD_RADIUS]] * 2
    pads = round_shapes(ends, [PAD_RADIUS] * 2, span=span, friction=friction / LAW.friction, tool=[0, 1])
    strip = HangingStrip(model, rest_state(model, shape_count=2), pads, 0.9 * stable_dt(model, LAW))
    strip.run(0.2, closing=0.004)
    strip.run(0.3)
    return strip


def slip(strip: HangingStrip, gravity: float) -> tuple[float, float]:
    """Largest load held by the jaw and grip at that load [N], from a gravity on [m/s^2].

    Raises:
        ValueError: the strip never slipped.
    """
    mass = float(strip.model.node_mass.sum())
    wrench = strip.run(0.6, gravity=gravity)
    height = strip.height(LENGTH)
    for _ in range(40):
        heavier = gravity * (1.0 + LOAD_STEP)
        heavier_wrench = strip.run(0.1, gravity=heavier)
        if strip.height(LENGTH) < height - SLIPPED:
            return gravity * mass, grip(wrench)
        gravity, wrench = heavier, heavier_wrench
    raise ValueError(f"the strip never slipped, up to {gravity * mass:.3f} N")


def grasped_strip() -> Iterator[Row]:
    """Strip hung on its jaw: reaction against weight, strain against F / (E A), and slip load."""
    strip, gravity = gripped_strip(), 8.5
    resting = strip.gauge_length
    wrench = strip.run(0.6, gravity=gravity)
    yield compare(
        "grasped strip, force on the jaw", "statics: the weight", measured=-float(wrench[:, 2].sum()),
        expected=gravity * float(strip.model.node_mass.sum()), tolerance=0.001, unit="N",
        note=f"10 x 10 x 60 mm, cell 2.5 mm, two pads of 10 mm, grip {grip(wrench):.2f} N each",
    )  # fmt: skip
    yield compare(
        "grasped strip, strain", "Hooke: F / (E A)", expected=strip.carried(gravity) / (MODULUS * WIDTH**2),
        measured=strip.gauge_length / resting - 1.0, tolerance=0.10,
        note="between levels a width away from pads and weight; formula (6) is some 7 % too stiff near the faces of "
        "so thin a lattice (row \"bar in tension\"), small strains in the reference",
    )  # fmt: skip
    load, held = slip(gripped_strip(), 12.0)
    yield compare(
        "grasped strip, load at which it slips", "Coulomb: 2 mu N", expected=2.0 * FRICTION * held, measured=load,
        tolerance=0.05, unit="N",
        note=f"mu {FRICTION:g}, N the grip as it is then; the load grows by {100.0 * LOAD_STEP:g} % at a time",
    )  # fmt: skip


def free_block(
    *supports: Support,
    gravity: tuple[float, float, float] = (0.0, 0.0, -GRAVITY),
    frame: FloatArray | None = None,
    law: SupportLaw | None = None,
    damping: Damping = DAMPED,
    lift: float = 0.0,
    modulus: float = 5000.0,
    anchored: bool = False,
) -> OrganModel:
    """Free block of 40 x 40 x 20 mm, 5 mm cells, on z = 0 (of a turned frame), its middle over 0."""
    mesh = box_mesh((0.04, 0.04, 0.02), (8, 8, 4))
    points = mesh.points + np.array([-0.02, -0.02, lift])
    anchors = np.flatnonzero(points[:, 0] < -0.0199) if anchored else ()
    mesh = TetMesh(points if frame is None else points @ frame.T, mesh.tets)
    return compile_organ(
        OrganSpec(
            mesh,
            Material(modulus, 1060.0, 0.45),
            anchors=anchors,
            damping=damping,
            gravity=gravity,
            supports=supports,
            support_law=law or SupportLaw(1e7, 100.0),
        )
    )


def on_incline(tilt: float, friction: float) -> tuple[OrganModel, OrganState]:
    """Block settled on an incline towards +x of an angle [rad] with a friction of 2, then with the given one."""
    slope = Support("slope", "plane", axis=(np.sin(tilt), 0.0, np.cos(tilt)), friction=2.0)
    model = free_block(slope, frame=slope.frame, damping=Damping(alpha=0.0, beta=1e-3), modulus=20000.0)
    state = rest_state(model)
    friction_array = np.array([friction])
    friction_array.setflags(write=False)
    return model._replace(support_friction=friction_array), state


def run(model: OrganModel, state: OrganState, seconds: float, dt: float | None = None) -> None:
    """Advance by whole substeps of `dt` [s], by default of 0.9 of the stable step."""
    dt = STEP_SHARE * model.stable_step if dt is None else dt
    advance(model, state, dt=dt, substep_count=round(seconds / dt))


def slid(tilt: float, friction: float) -> tuple[float, float]:
    """Mean acceleration down an incline in 0.3 s from rest [m/s^2]: by the path 2 x / t^2, by the speed v / t."""
    model, state = on_incline(tilt, friction)
    down, mass = np.array([np.cos(tilt), 0.0, -np.sin(tilt)]), model.node_mass.sum()
    dt = STEP_SHARE * model.stable_step
    seconds = round(SLIDING_TIME / dt) * dt
    start = model.node_mass @ state.node_position
    run(model, state, seconds, dt)
    path = (model.node_mass @ state.node_position - start) @ down / mass
    speed = matmul(model.node_mass, state.node_velocity) @ down / mass
    return float(2.0 * path / seconds**2), float(speed / seconds)


def crept(tilt: float, friction: float) -> float:
    """Largest creep of a node in half a second on an incline that holds the block [m].

    It counts half a second after the change of friction, at which nodes near the limit slip and the block swings.
    """
    model, state = on_incline(tilt, friction)
    run(model, state, 0.5)
    before = state.node_position.copy()
    run(model, state, 0.5)
    return float(np.abs(state.node_position - before).max())


def on_supports() -> Iterator[Row]:
    """Weight on a plane, no creep below the angle of friction, acceleration g (sin a - mu cos a) above it."""
    model = free_block(FLOOR)
    force = support_forces(model, rest_state(model)).sum(axis=0)
    yield compare(
        "block on a plane, force of the support", "statics: the weight",
        expected=float(model.node_mass.sum()) * GRAVITY, measured=force[2], tolerance=1e-3, unit="N",
        note=f"40 x 40 x 20 mm, cell 5 mm; across it {np.hypot(*force[:2]):.1g} N",
    )  # fmt: skip
    yield compare(
        "block on an incline of 20 degrees, creep in 0.5 s", "Coulomb: at rest where tan a < mu", expected=0.0,
        measured=crept(np.radians(20.0), 0.4), tolerance=1e-7, unit="m",
        note="mu 0.4, tan a = 0.364; the node that moves most",
    )  # fmt: skip
    for degrees, friction in SLIDES:
        tilt = np.radians(degrees)
        path, speed = slid(tilt, friction)
        yield compare(
            f"block on an incline of {degrees:g} degrees, mu {friction:g}, acceleration",
            "Coulomb: g (sin a - mu cos a)", expected=GRAVITY * (np.sin(tilt) - friction * np.cos(tilt)),
            measured=path, tolerance=0.02, unit="m/s^2",
            note=f"from the path in {SLIDING_TIME:g} s from rest; {speed:.4g} m/s^2 from the speed at its end",
        )  # fmt: skip
