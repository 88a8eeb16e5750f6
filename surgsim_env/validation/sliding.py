"""A ball drawn over the phantom's edges and nodes: continuous force, Coulomb's friction, and rest where it sticks."""

import numpy as np

from msdm_core.kernels.contact_kernels import QUADRATURE_BARYCENTRIC, QUADRATURE_WEIGHT
from msdm_core.kernels.structure_kernels import ContactShapes, OrganState
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.compile import rest_state
from surgsim_env.validation.row import Outcome, Row, compare
from surgsim_env.validation.touch import Touch, ball, block

RADIUS = 0.008  # [m]
SPEED = 0.02  # [m/s]
# Where the ball is drawn from, along which direction, and over how many haptic steps once 4 mm have settled it: two
# periods of the lattice, so that what the mesh adds and takes away cancels.
LINES = {
    "along edges": ((0.022, 0.030), (1.0, 0.0), 500),
    "between nodes": ((0.022, 0.0312), (1.0, 0.0), 500),
    "along diagonals": ((0.0225, 0.0225), (0.7071, 0.7071), 707),
}
SETTLING = 200
JUMP_TOLERANCE = 0.02
FRICTION_TOLERANCE = 0.05


def slide(touch: Touch, line: str, depth: float) -> tuple[FloatArray, OrganState, ContactShapes]:
    """Forces of the steady part [N] (n, 3), and the simulation at its end."""
    start, direction, count = LINES[line]
    state, shapes = rest_state(touch.model, shape_count=1), ball(start, RADIUS)
    touch.move(state, shapes, (0.0, 0.0, -0.02), round(depth / 2e-5))
    touch.move(state, shapes, (0.0, 0.0, 0.0), 200)
    force = touch.move(state, shapes, (SPEED * direction[0], SPEED * direction[1], 0.0), SETTLING + count)
    return force[SETTLING:], state, shapes


def coulomb(touch: Touch, state: OrganState, shapes: ContactShapes, direction: FloatArray) -> tuple[float, float]:
    """Friction along the motion from the stored stick-slip state, and mu times the local pressure along it, summed [N].

    On a point with the ball's normal e, sliding drags along the motion without its part along e. The pressure is that
    of the law of contact, k_p g (s / r) with g = s (s + t) / r, from the deformed surface.
    """
    model, law, radius = touch.model, touch.law, float(shapes.shape_radius[0])
    corners = state.node_position[model.surface_triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    offset = np.einsum("qc,tcx->tqx", QUADRATURE_BARYCENTRIC, corners) - shapes.shape_ends[0, 0]
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


def sliding() -> Outcome:
    """No jump above 2 % of the force from one haptic step to the next; steady friction."""
    touch = block(12, alpha=None)
    friction = touch.law.friction
    rows: list[Row] = []
    for line, (_, direction, _) in LINES.items():
        way = np.array([*direction, 0.0])
        force, _, _ = slide(touch, line, 0.004)
        jump = float((np.linalg.norm(np.diff(force, axis=0), axis=1) / np.linalg.norm(force[1:], axis=1)).max())
        rows.append(
            compare(
                f"sliding {line}, largest jump between haptic steps", "continuity", expected=0.0, measured=jump,
                tolerance=JUMP_TOLERANCE, absolute=True,
                note=f"share of the force; tip 8 mm, 4 mm deep, {1e3 * SPEED:g} mm/s, friction {friction:g}",
            )
        )  # fmt: skip
        shallow, _, _ = slide(touch, line, 0.0015)
        share = -shallow @ way / shallow[:, 2]
        rows.append(
            compare(
                f"sliding {line}, tangential force over mu N", "Coulomb", expected=1.0,
                measured=float(share.mean()) / friction, tolerance=FRICTION_TOLERANCE,
                note="tip 8 mm, 1.5 mm deep (cell / contact radius 1.44), mean over two cells; on the way the mesh "
                f"makes it swing by {share.std():.3f} N / N, without friction too",
            )
        )  # fmt: skip
    rows += [deep_friction(touch), sticking()]
    return Outcome(tuple(rows))


def deep_friction(touch: Touch) -> Row:
    """4 mm deep: friction against mu times the pressure, point by point; the tissue pushed ahead adds to the drag."""
    line = "between nodes"
    way = np.array([*LINES[line][1], 0.0])
    force, state, shapes = slide(touch, line, 0.004)
    measured, expected = coulomb(touch, state, shapes, way)
    total = float((-force @ way / (touch.law.friction * force[:, 2])).mean())
    return compare(
        "sliding 4 mm deep, friction over the integral of mu p", "Coulomb at each point", expected=1.0,
        measured=measured / expected, tolerance=FRICTION_TOLERANCE,
        note=f"the whole tangential force is {total:.2f} mu N: the normal force is not all of the pressure on a ball "
        "that sits deep, and the tissue ahead leans against it",
    )  # fmt: skip


def sticking() -> Row:
    """A ball moved aside below the friction limit: change of the force in half a second over the normal force."""
    soft = block(12)
    touch = Touch.on(soft.model, soft.law._replace(friction=0.8))
    state, shapes = rest_state(touch.model, shape_count=1), ball((0.03, 0.03), RADIUS)
    for velocity, count in (((0.0, 0.0, -0.02), 100), ((0.005, 0.0, 0.0), 80), ((0.0, 0.0, 0.0), 700)):
        before = touch.move(state, shapes, velocity, count)[-1]
    after = touch.move(state, shapes, (0.0, 0.0, 0.0), 500)[-1]
    return compare(
        "sticking, change of the force in 0.5 s", "no creep", expected=0.0,
        measured=float(np.linalg.norm(after - before) / before[2]), tolerance=1e-4, absolute=True,
        note=f"share of the normal force; friction holds {-before[0] / before[2]:.2f} of it, mu 0.8",
    )  # fmt: skip
