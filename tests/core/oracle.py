"""The organ's forces, step and contact energy again, in plain numpy straight from the equations; small organs.

Slow on purpose: one spring, one tet, one surface triangle at a time, no code shared with
msdm_core/kernels/substep_kernels.py.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.kernels.structure_kernels import ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.material.regions import Damping, Material
from msdm_core.mesh.ordering import spring_order
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.stability import largest_frequency, step_limit
from msdm_core.organ.stepping import advance_organ, round_shapes

FloatArray = NDArray[np.float64]

# Centroids of the four congruent parts of a triangle, a quarter of its area each.
QUADRATURE = np.array([[1 / 3, 1 / 3, 1 / 3], [2 / 3, 1 / 6, 1 / 6], [1 / 6, 2 / 3, 1 / 6], [1 / 6, 1 / 6, 2 / 3]])

TISSUE = Material(youngs_modulus=5000.0, density=1000.0, poisson_ratio=0.45)
UNDAMPED = Damping(alpha=0.0)


def edge_stiffness(mesh: TetMesh, model: OrganModel) -> FloatArray:
    """An organ's spring stiffness in the order of `mesh.edges` [N/m], shape (n_edge,)."""
    stiffness = np.empty_like(model.spring_stiffness)
    stiffness[spring_order(mesh).springs] = model.spring_stiffness
    return stiffness


# ---- the oracle -------------------------------------------------------------------------------------------------


def spring_forces(model: OrganModel, position: FloatArray, velocity: FloatArray) -> FloatArray:
    """f_i = k ((l - l0) + beta dl/dt) n, n from i to j, and minus that on j [N], shape (n_node, 3)."""
    force = np.zeros_like(position)
    for (i, j), stiffness, rest in zip(model.spring_nodes, model.spring_stiffness, model.spring_rest_length):
        span = position[j] - position[i]
        length = np.linalg.norm(span)
        along = span / length
        rate = along @ (velocity[j] - velocity[i])
        pull = stiffness * ((length - rest) + model.beta * rate) * along
        force[i] += pull
        force[j] -= pull
    return force


def volume_gradient(corners: FloatArray) -> FloatArray:
    """dV/dx of a tet's corners: a third of the inward area vector of the face opposite each [m^2], shape (4, 3)."""
    a, b, c, d = corners
    opposite = [(b, d, c), (a, c, d), (a, d, b), (a, b, c)]
    return np.array([0.5 * np.cross(q - p, r - p) / 3.0 for p, q, r in opposite])


def volume_forces(model: OrganModel, position: FloatArray, velocity: FloatArray) -> FloatArray:
    """f_a = -(K_t e_t + K' min(J - 0.6, 0) 0.6 / J + mean of the corners' K_a e_a) dV/dx_a [N], shape (n_node, 3).

    e = (J - 1) + beta dJ/dt; e_a is that of the volume around a node, of which each of its tets gives a quarter.
    """
    force = np.zeros_like(position)
    tension = averaged_tension(model, position, velocity)
    moduli = zip(model.tet_nodes, model.tet_rest_volume, model.tet_bulk, model.tet_barrier_bulk)
    for nodes, rest_volume, bulk, barrier_bulk in moduli:
        volume, rate, gradient = tet_volume(position[nodes], velocity[nodes])
        strain = volume / rest_volume - 1.0 + model.beta * rate / rest_volume
        squeezed = barrier_bulk * min(volume / rest_volume - 0.6, 0.0) * 0.6 / (volume / rest_volume)
        force[nodes] -= (bulk * strain + squeezed + tension[nodes].mean()) * gradient
    return force


def tet_volume(corners: FloatArray, velocity: FloatArray) -> tuple[float, float, FloatArray]:
    """Volume of a tet [m^3], its rate [m^3/s] and dV/dx of its corners [m^2] (4, 3)."""
    a, b, c, d = corners
    gradient = volume_gradient(corners)
    return float(np.linalg.det([b - a, c - a, d - a])) / 6.0, float((gradient * velocity).sum()), gradient


def averaged_tension(model: OrganModel, position: FloatArray, velocity: FloatArray) -> FloatArray:
    """K_a ((V - V0) + beta dV/dt) / V0 of the volume around each node [Pa], shape (n_node,)."""
    tension = np.zeros(len(position))
    for node in range(len(position)):
        around = np.flatnonzero((model.tet_nodes == node).any(axis=1))
        grown = rest = 0.0
        for nodes in model.tet_nodes[around]:
            volume, rate, _ = tet_volume(position[nodes], velocity[nodes])
            grown += 0.25 * (volume + model.beta * rate)
            rest += 0.25 * tet_volume(model.node_rest_position[nodes], velocity[nodes])[0]
        tension[node] = model.node_bulk[node] * (grown / rest - 1.0)
    return tension


def total_forces(model: OrganModel, position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Springs, volume term, both with beta, and gravity m g [N], shape (n_node, 3)."""
    gravity = model.node_mass[:, None] * model.gravity
    return spring_forces(model, position, velocity) + volume_forces(model, position, velocity) + gravity


def hold_squeezed(
    model: OrganModel, position: FloatArray, velocity: FloatArray, force: FloatArray, dt: float
) -> FloatArray:
    """The forces with the pressures of squeezed tets taken implicitly, one tet after the other [N], shape (n_node, 3).

    p' dt dJ/dt more tension at the rate of the step's end: dJ/dt = w (1 - x dt sum |dV/dx|^2 / m / V0), solved for x.
    """
    force = force.copy()
    for nodes, rest_volume, bulk in zip(model.tet_nodes, model.tet_rest_volume, model.tet_barrier_bulk):
        volume, _, gradient = tet_volume(position[nodes], velocity[nodes])
        ratio = volume / rest_volume
        if ratio >= 0.6:
            continue
        response = dt * model.node_inverse_mass[nodes][:, None]
        rate = float((gradient * (velocity[nodes] + response * force[nodes])).sum()) / rest_volume
        slope = dt * bulk * 0.6**2 / ratio**2
        give = float((gradient**2 * response).sum()) / rest_volume
        tension = min(slope * rate / (1.0 + slope * give), bulk * (0.6 - ratio) * 0.6 / ratio)
        force[nodes] -= tension * gradient
    return force


def symplectic_step(
    model: OrganModel, position: FloatArray, velocity: FloatArray, dt: float
) -> tuple[FloatArray, FloatArray]:
    """v' = exp(-alpha dt) v + dt f(x, v) / m, then x' = x + dt v'; anchored nodes (1/m = 0) stay."""
    force = hold_squeezed(model, position, velocity, total_forces(model, position, velocity), dt)
    acceleration = force * model.node_inverse_mass[:, None]
    after = math.exp(-model.alpha * dt) * velocity + dt * acceleration
    return position + dt * after, after


def contact_energy(
    model: OrganModel, position: FloatArray, shapes: ContactShapes, stiffness: float, engaged: NDArray
) -> float:
    """E = sum over shapes and quadrature points of (k_p / 2) w A0 g^2, g = s (s + t) / r [J].

    A point lies on the quadratic triangle: lambda_a a + lambda_b b + lambda_c c, and 4 lambda_b lambda_c times the rise
    of the edge opposite to a and so on, each rise a sum of weight times place over the nodes around the triangle.
    d runs from the nearest point of the shape's axis to the quadrature point, n is the triangle's deformed normal,
    t = d . n, s^2 = r^2 - (|d|^2 - t^2). Counted are points with s^2 > 0, s + t > 0 and (t <= 0 or already engaged).
    """
    energy = 0.0
    bulge = 4.0 * np.array([[b * c, c * a, a * b] for a, b, c in QUADRATURE])
    for shape, radius in enumerate(shapes.shape_radius):
        for triangle, corners in enumerate(position[model.surface_triangles]):
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            normal = normal / np.linalg.norm(normal)
            rise = model.surface_rise[triangle].T @ position[model.surface_around[triangle]]
            points = QUADRATURE @ corners + bulge @ rise
            offset = points - nearest_on_core(shapes.shape_ends[shape], shapes.shape_span[shape], points)
            height = offset @ normal
            chord_squared = radius**2 - ((offset * offset).sum(axis=1) - height**2)
            chord = np.sqrt(np.maximum(chord_squared, 0.0))
            held = engaged[shape, 4 * triangle : 4 * triangle + 4].astype(bool)
            counted = (chord_squared > 0.0) & (chord + height > 0.0) & ((height <= 0.0) | held)
            depth = np.where(counted, chord * (chord + height) / radius, 0.0)
            energy += 0.5 * stiffness * 0.25 * model.surface_rest_area[triangle] * float(depth @ depth)
            energy += guard_energy(shapes.shape_ends[shape], radius, corners, normal, stiffness)
    return energy


def guard_energy(ends: FloatArray, radius: float, corners: FloatArray, normal: FloatArray, stiffness: float) -> float:
    """Of the force k h (h / d - 1) below d = h = 0.6 r, k = pi r^2 k_p: E = k h (h ln(h / d) - (h - d)) [J].

    d is the distance from the axis to the triangle, counted where the axis' nearest point is in front of it.
    """
    reach = 0.6 * radius
    axis_point, triangle_point = nearest_pair(ends, corners, normal)
    distance = float(np.linalg.norm(axis_point - triangle_point))
    if distance >= reach or (axis_point - triangle_point) @ normal <= 0.0:
        return 0.0
    return math.pi * radius**2 * stiffness * reach * (reach * math.log(reach / distance) - (reach - distance))


def nearest_pair(ends: FloatArray, corners: FloatArray, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Nearest points of a segment and a triangle that it does not cross: an end over the face, or segment and edge."""
    pairs = []
    for end in ends:
        foot = end - ((end - corners[0]) @ normal) * normal
        if all(np.cross(corners[i - 2] - corners[i], foot - corners[i]) @ normal >= 0.0 for i in range(3)):
            pairs.append((end, foot))
    along = ends[1] - ends[0]
    for i in range(3):
        edge = corners[i - 2] - corners[i]
        # Ends of one against the other, and, where they are not parallel, the common perpendicular.
        pairs += [(end, nearest_on_axis(np.array([corners[i], corners[i - 2]]), end[None])[0]) for end in ends]
        pairs += [(nearest_on_axis(ends, corner[None])[0], corner) for corner in corners]
        matrix = np.array([[along @ along, -(along @ edge)], [along @ edge, -(edge @ edge)]])
        if abs(np.linalg.det(matrix)) > 1e-20:
            share, edge_share = np.linalg.solve(matrix, [along @ (corners[i] - ends[0]), edge @ (corners[i] - ends[0])])
            if 0.0 <= share <= 1.0 and 0.0 <= edge_share <= 1.0:
                pairs.append((ends[0] + share * along, corners[i] + edge_share * edge))
    return min(pairs, key=lambda pair: float(np.linalg.norm(pair[0] - pair[1])))


def nearest_on_core(ends: FloatArray, span: FloatArray, points: FloatArray) -> FloatArray:
    """The point of a shape's core, the axis swept to either side by the span, nearest to each point [m], (n, 3)."""
    middle = nearest_on_axis(ends, points)
    sides = [np.array([place - span, place + span]) for place in middle]
    return np.array([nearest_on_axis(side, point[None])[0] for side, point in zip(sides, points, strict=True)])


def nearest_on_axis(ends: FloatArray, points: FloatArray) -> FloatArray:
    """The point of the segment between two ends nearest to each point [m], shape (n, 3)."""
    axis = ends[1] - ends[0]
    squared = axis @ axis
    share = np.clip((points - ends[0]) @ axis / squared, 0.0, 1.0) if squared > 0.0 else np.zeros(len(points))
    return ends[0] + share[:, None] * axis


# ---- small organs and shapes to hold it against --------------------------------------------------------------------


def frozen(values: ArrayLike, dtype: type = np.float64) -> NDArray:
    """A read-only array, as a compiled OrganModel has them (numba compiles anew for writable ones)."""
    array = np.ascontiguousarray(np.array(values, dtype=dtype))
    array.setflags(write=False)
    return array


def block(
    size: tuple[float, float, float] = (0.03, 0.02, 0.02),
    cells: tuple[int, int, int] = (3, 2, 2),
    *,
    material: Material = TISSUE,
    damping: Damping = UNDAMPED,
    anchored_below: float = -1.0,
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> OrganModel:
    """A block on a BCC lattice, its nodes up to the height `anchored_below` [m] held."""
    mesh = box_mesh(size, cells)
    anchors = np.flatnonzero(mesh.points[:, 2] <= anchored_below)
    return compile_organ(OrganSpec(mesh, material, anchors=anchors, damping=damping, gravity=gravity))


def irregular_organ(seed: int, *, damping: Damping = UNDAMPED) -> OrganModel:
    """A free 48-node organ without any symmetry: jittered nodes, every spring and tet of its own stiffness."""
    random = np.random.default_rng(seed)
    lattice = box_mesh((0.03, 0.02, 0.02), (3, 2, 2))
    mesh = TetMesh(lattice.points + random.uniform(-1e-3, 1e-3, lattice.points.shape), lattice.tets)
    model = compile_organ(OrganSpec(mesh, TISSUE, damping=damping))
    model = model._replace(
        spring_stiffness=frozen(model.spring_stiffness * random.uniform(0.3, 3.0, len(model.spring_stiffness))),
        tet_bulk=frozen(model.tet_bulk * random.uniform(0.0, 3.0, len(model.tet_bulk))),
        node_bulk=frozen(model.node_bulk * random.uniform(0.0, 3.0, len(model.node_bulk))),
    )
    return model._replace(stable_step=step_limit(largest_frequency(model), model.alpha, model.beta))


def deformed_state(model: OrganModel, seed: int, *, shape_count: int = 0) -> OrganState:
    """A state with every node moved by up to 1.5 mm and thrown with up to 0.1 m/s along each axis."""
    random = np.random.default_rng(seed)
    state = rest_state(model, shape_count=shape_count)
    state.node_position[:] += random.uniform(-1.5e-3, 1.5e-3, state.node_position.shape)
    state.node_velocity[:] = random.uniform(-0.1, 0.1, state.node_velocity.shape)
    return state


def without_stiffness(model: OrganModel) -> OrganModel:
    """The same organ without springs and volume term: what is left of `node_force` is contact."""
    return model._replace(
        spring_stiffness=frozen(np.zeros_like(model.spring_stiffness)),
        tet_bulk=frozen(np.zeros_like(model.tet_bulk)),
        tet_barrier_bulk=frozen(np.zeros_like(model.tet_barrier_bulk)),
        node_bulk=frozen(np.zeros_like(model.node_bulk)),
        averages_volume=False,
    )


def single_tool(
    ends: ArrayLike,
    radius: ArrayLike,
    *,
    centre: ArrayLike | None = None,
    twist: ArrayLike = (0.0,) * 6,
    span: ArrayLike | None = None,
) -> ContactShapes:
    """Shapes carried by one tool: axis ends (n_shape, 2, 3) [m], radii (n_shape,) [m], centre of mass, twist (6,)."""
    axes = np.array(ends, dtype=np.float64).reshape(-1, 2, 3)
    middle = axes[0].mean(axis=0) if centre is None else np.asarray(centre, dtype=np.float64)
    return round_shapes(axes, radius, span=span, centre=middle, twist=twist)


def ball(centre: ArrayLike, radius: float, *, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> ContactShapes:
    """One sphere as a tool of its own."""
    middle = np.asarray(centre, dtype=np.float64)
    return single_tool([middle, middle], radius, centre=middle, twist=[*np.asarray(velocity), 0.0, 0.0, 0.0])


def contact_forces(
    model: OrganModel, state: OrganState, shapes: ContactShapes, law: ContactLaw
) -> tuple[FloatArray, FloatArray]:
    """The kernel's contact forces on the nodes [N] (n_node, 3) and wrench on the tool (6,), the state left as it is.

    In a step so short that the pressure's change within it, which acts on the flat triangles and grows as dt^2, is
    rounding.
    """
    bare = without_stiffness(model)._replace(alpha=0.0, gravity=frozen(np.zeros(3)))
    scratch = OrganState(*(array.copy() for array in state))
    moved = ContactShapes(*(array.copy() for array in shapes))
    wrench = np.zeros((1, 6))
    advance_organ(bare, scratch, moved, law, 1e-11, 1, wrench)
    return scratch.node_force, wrench[0]
