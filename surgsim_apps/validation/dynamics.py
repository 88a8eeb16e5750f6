"""Motion: free vibration, stable step at rest and strained, energy without damping, passivity of organ and tool.

For passivity a free ball in MuJoCo and a small organ exchange forces as in a scene: energy of both in bounces without
losses, and work of the tool in many presses.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
from scipy.optimize import curve_fit
from scipy.sparse import diags_array
from scipy.sparse.linalg import eigsh

from msdm_core.errors import OrganDivergedError
from msdm_core.kernels import ContactLaw, OrganModel, OrganState
from msdm_core.material import Capsule, Damping, Lesion, Material
from msdm_core.mesh import FloatArray
from msdm_core.meshing import box_mesh
from msdm_core.organ import (
    NO_CONTACT,
    NO_SHAPES,
    OrganSpec,
    advance_or_raise,
    advance_organ,
    compile_organ,
    contact_energy,
    kinetic_energy,
    potential_energy,
    rest_state,
    round_shapes,
    stable_dt,
)
from surgsim_apps.validation.row import Curve, Result, Row, bounded, compare
from surgsim_apps.validation.statics import DENSITY, assemble_stiffness, nodes_at
from surgsim_env.coupling import haptic_steps, runs_compiled
from surgsim_env.instruments import ToolBodies
from surgsim_env.scene import Scene, load_anatomy, make_scene, substeps_needed

SAMPLES = 400  # of a free motion
STIFFER = 20e3  # [Pa] of the organs for the stable step
STEP_COUNT = 2000
START = 1e-9  # [m]
HAPTIC_STEP = 1e-3  # [s]
GRAVITY = 9.81  # [m/s^2], on the tool alone
BLOCK = (0.03, 0.03, 0.02)  # [m]
CELLS = (6, 6, 4)
MODULUS = 15e3  # [Pa]
# A scene's contact without losses.
ELASTIC = ContactLaw(stiffness=2e7, damping=0.0, friction=0.0, tangential_stiffness=1e7)

# Free block of a scene's tissue: cell [m], cells along an edge, spin [rad/s] and its direction, noise of positions [m],
# time [s], and the largest energy over that at the start: symplectic Euler alone swings by a tenth.
FREE_CELL, FREE_CELLS = 5e-3, 4
SPIN, SPIN_DIRECTION = 16.0, (0.48, 0.6, 0.64)
NOISE, FREE_TIME, ENERGY_MOST = 1e-6, 2.0, 1.25
STRETCHES = (0.05, 0.10, 0.15, 0.20)
STEP_SHARES = (1.0, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.4)

# Passivity: radius of the bouncing ball [m], haptic steps of a mean, losses of a scene, and its alpha [1/s].
RADIUS = 0.010
WINDOW = 100
LOSSY = ContactLaw(stiffness=2e7, damping=100.0, friction=0.2, tangential_stiffness=1e7)
ALPHA = 25.0
# Mass [kg] and height [m]. A low fall leaves energy for vibrations of tissue under the resting ball; after a high fall
# the ball bounces.
OTHER_FALLS = ((0.005, 0.005), (0.02, 0.0005), (0.02, 0.005), (0.1, 0.0005), (0.1, 0.005))

BALL = """
<mujoco>
  <option timestep="{step}" integrator="Euler" jacobian="dense" gravity="0 0 {pull}">
    <flag autoreset="disable"/>
  </option>
  <worldbody>
    <body name="ball" pos="{place}">
      {joint}
      <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
      <geom type="sphere" size="{radius}" contype="0" conaffinity="0" group="3"/>
    </body>
  </worldbody>
</mujoco>
"""
FREE = "<freejoint/>"
# A heavy ball would roll off a soft block: it moves straight up and down.
UPRIGHT = '<joint type="slide" axis="0 0 1"/>'


def released(
    model: OrganModel, displacement: FloatArray, duration: float, *, step_share: float = 0.5
) -> tuple[FloatArray, FloatArray]:
    """Free motion of an organ from a small displacement, as its part along that shape, u0 . M u(t).

    Args:
        model: the organ.
        displacement: at the release [m], shape (n_node, 3).
        duration: [s].
        step_share: of the organ's stable step.

    Returns:
        times [s] and the part, 1 at the start, both (SAMPLES + 1,).
    """
    weight = displacement * model.node_mass[:, None]
    weight /= float((weight * displacement).sum())

    def part(state: OrganState) -> float:
        return float((weight * (state.node_position - model.node_rest_position)).sum())

    state = rest_state(model)
    state.node_position[:] += displacement
    steps = max(1, round(duration / SAMPLES / (step_share * model.stable_step)))
    dt = duration / SAMPLES / steps
    return dt * steps * np.arange(SAMPLES + 1, dtype=np.float64), followed(model, state, dt, steps, SAMPLES, part)


def followed(
    model: OrganModel, state: OrganState, dt: float, steps: int, count: int, measure: Callable[[OrganState], float]
) -> FloatArray:
    """Measure of the state at the start and after each of `count` runs of `steps` steps of dt [s]."""
    values = [measure(state)]
    for _ in range(count):
        advance_or_raise(model, state, dt, steps)
        values.append(measure(state))
    return np.array(values)


def fitted_oscillation(time: FloatArray, value: FloatArray) -> tuple[float, float]:
    """Frequency [Hz] and rate of decay [1/s] of A exp(-d t) cos(2 pi f t + p), by least squares."""
    place = np.flatnonzero(np.diff(np.sign(value)) != 0)
    start = (len(place) - 1) / (2.0 * (time[place[-1]] - time[place[0]]))

    def damped(t: FloatArray, size: float, frequency: float, rate: float, phase: float) -> FloatArray:
        return size * np.exp(-rate * t) * np.cos(2.0 * np.pi * frequency * t + phase)

    (_, frequency, rate, _), _ = curve_fit(damped, time, value, p0=(value[0], start, 0.0, 0.0))
    return float(frequency), float(rate)


def organs() -> dict[str, OrganModel]:
    """Blocks: plain, nearly incompressible, and with capsule, lesion and held nodes."""
    mesh = box_mesh((0.04, 0.04, 0.04), (4, 4, 4))
    undamped, held = Damping(alpha=0.0), nodes_at(mesh.points, 0.0)
    soft, lesion = Material(STIFFER, DENSITY, 0.45), Lesion((0.02, 0.02, 0.02), 0.012, Material(8 * STIFFER, DENSITY))
    return {
        "springs": compile_organ(OrganSpec(mesh, Material(STIFFER, DENSITY), damping=undamped)),
        "nu 0.45": compile_organ(OrganSpec(mesh, soft, damping=undamped)),
        "capsule and lesion": compile_organ(
            OrganSpec(mesh, soft, Capsule(60e3), lesions=(lesion,), anchors=held, damping=undamped)
        ),
    }


def fastest_mode(model: OrganModel) -> tuple[float, FloatArray]:
    """omega_max [rad/s] and its shape, with a largest part of 1, by Lanczos to rounding."""
    root = np.repeat(np.sqrt(model.node_inverse_mass), 3)
    matrix = diags_array(root) @ assemble_stiffness(model) @ diags_array(root)
    start = np.sin(1.0 + 1.7 * np.arange(len(root)) ** 1.1)
    value, vector = eigsh(matrix, k=1, which="LA", v0=start)
    shape = (root * vector[:, 0]).reshape(-1, 3)
    return math.sqrt(float(value[0])), shape / np.abs(shape).max()


def largest_growth(model: OrganModel, shape: FloatArray, dt: float, count: int) -> float:
    """Largest displacement over the initial one in `count` steps from the fastest mode."""
    state = rest_state(model)
    state.node_position[:] += START * shape
    largest = 1.0
    for _ in range(count // 10):
        advance_organ(model, state, NO_SHAPES, NO_CONTACT, dt, 10, np.zeros((0, 6)))
        size = float(np.abs(state.node_position - model.node_rest_position).max()) / START
        if not size < 1e6:
            return 1e6
        largest = max(largest, size)
    return largest


def stable_step() -> Iterator[Row]:
    """Stable at 0.95 and unstable at 1.1 of the true limit, and this package's limit, just below it."""
    for name, model in organs().items():
        omega, shape = fastest_mode(model)
        limit = 2.0 / omega
        # At 0.95 of it the mode's amplitude is at most 1 / sqrt(1 - 0.95^2) = 3.2; at 1.1 it grows 2.43 x a step.
        stable = largest_growth(model, shape, 0.95 * limit, STEP_COUNT)
        unstable = largest_growth(model, shape, 1.10 * limit, STEP_COUNT)
        yield compare(
            f"stable step, {name}", "2 / omega_max of the assembled matrix", expected=limit,
            measured=stable_dt(model), tolerance=0.01, unit="s", note="the value that this package uses",
        )  # fmt: skip
        yield compare(
            f"stable at 0.95, {name}", "|z| = 1", expected=1.0, measured=stable < 10.0, tolerance=0.0,
            note=f"grew x {stable:.3g} in {STEP_COUNT} steps",
        )  # fmt: skip
        yield compare(
            f"unstable at 1.1, {name}", "|z| = 2.43", expected=1.0, measured=unstable > 1e3, tolerance=0.0,
            note=f"grew x {unstable:.3g} or more",
        )  # fmt: skip


def total_energy(model: OrganModel, state: OrganState) -> float:
    """Kinetic and potential energy of an organ [J]."""
    return kinetic_energy(model, state) + potential_energy(model, state)


def energy_drift() -> Iterator[Row]:
    """Undamped for 10 s at half the stable step: mean energy of the last second over that of the first."""
    model = organs()["nu 0.45"]
    random = np.random.default_rng(0)
    state = rest_state(model)
    state.node_position[:] += random.uniform(-1e-6, 1e-6, state.node_position.shape)
    dt = 0.5 * model.stable_step
    energy = followed(
        model, state, dt, 7, math.ceil(10.0 / dt) // 7, partial(total_energy, model)
    )  # fmt: skip
    tenth = len(energy) // 10
    measured = float(energy[-tenth:].mean() / energy[:tenth].mean())
    yield compare("energy after 10 s without damping", "conservation", expected=1.0, measured=measured, tolerance=0.01)


def tissue_block(scene: Scene, cells: int, alpha: float) -> OrganModel:
    """Free cube of the tissue of a scene, without gravity and relaxation, which takes energy."""
    mesh, damping = box_mesh((cells * FREE_CELL,) * 3, (cells,) * 3), Damping(alpha=alpha)
    material = replace(scene.material, relaxation=None)
    return compile_organ(OrganSpec(mesh, material, damping=damping, stiffness_rule=scene.stiffness_rule))


def stretched_block(model: OrganModel, stretch: float, ratio: float, spin: float = 0.0) -> OrganState:
    """State of a block stretched along z by a strain, thinner by Poisson's ratio, and spinning [rad/s]."""
    state, middle = rest_state(model), model.node_rest_position.mean(axis=0)
    across = (1.0 + stretch) ** -ratio
    state.node_position[:] = middle + (model.node_rest_position - middle) * (across, across, 1.0 + stretch)
    state.node_velocity[:] = np.cross(np.multiply(spin, SPIN_DIRECTION), state.node_position - middle)
    return state


def stretched_energy() -> Iterator[Row]:
    """Energy of a block of liver's law, stretched by 12 % and released without damping, at the scene's relative step.

    Its steep springs are held implicitly, partly as a drag.
    """
    scene = make_scene("liver")
    share = scene.timing.haptic_step / scene.timing.substep_count / load_anatomy(scene).organ().stable_step
    model = tissue_block(scene, 8, 0.0)
    state, dt = stretched_block(model, 0.12, scene.material.poisson_ratio), share * model.stable_step
    energy = followed(model, state, dt, 1, round(FREE_TIME / dt), partial(total_energy, model))
    energy, time = energy / energy[0], dt * np.arange(len(energy))
    yield bounded(
        "energy kept after 0.1 s, block of liver's law stretched by 12 %", "conservation",
        measured=energy[np.abs(time - 0.1) < 0.01].mean(), least=0.85,
        note=f"undamped, {share:.2f} of the stable step as in the scene; {energy[time > 1.9].mean():.2f} after 2 s",
    )  # fmt: skip
    yield bounded(
        "largest energy, block of liver's law stretched by 12 %", "passivity, and the swing of symplectic Euler",
        measured=energy.max(), most=1.1,
    )  # fmt: skip


def survives(model: OrganModel, state: OrganState, dt: float) -> bool:
    """True if all tets stay upright and the energy below ENERGY_MOST of the start for FREE_TIME."""
    most = ENERGY_MOST * total_energy(model, state)
    for _ in range(math.ceil(FREE_TIME / dt / 20)):
        try:
            advance_or_raise(model, state, dt, 20)
        except OrganDivergedError:
            return False
        if total_energy(model, state) > most:
            return False
    return True


def largest_share(model: OrganModel, stretch: float, ratio: float) -> float:
    """Largest of STEP_SHARES of the stable step that a spinning, stretched block `survives`; 0 if none."""
    noise = np.random.default_rng(0).uniform(-NOISE, NOISE, model.node_rest_position.shape)
    for share in STEP_SHARES:
        state = stretched_block(model, stretch, ratio, SPIN)
        state.node_position[:] += noise
        if survives(model, state, share * model.stable_step):
            return share
    return 0.0


def strained_step() -> Iterator[Row]:
    """Step that a stretched, spinning block of a scene's tissue survives, against that of the scene at rest."""
    for name in ("phantom", "liver", "lobe"):
        anatomy = load_anatomy(make_scene(name))
        scene, organ = anatomy.scene, anatomy.organ()
        shipped = scene.timing.haptic_step / scene.timing.substep_count / stable_dt(organ, scene.contact.law)
        model = tissue_block(scene, FREE_CELLS, scene.damping.alpha)
        for stretch in STRETCHES:
            yield bounded(
                f"stable step, `{name}`, stretched by {100.0 * stretch:.0f} % and spinning", "the step of the scene",
                measured=largest_share(model, stretch, scene.material.poisson_ratio), least=shipped,
                note="shares of the stable step at rest; alpha of the scene, 2 s",
            )  # fmt: skip


def small_block(damping: Damping) -> OrganModel:
    """Block of 30 x 30 x 20 mm with 5 mm cells, bonded below."""
    mesh = box_mesh(BLOCK, CELLS)
    material, floor = Material(MODULUS, 1060.0, 0.45), nodes_at(mesh.points, 0.0)
    return compile_organ(OrganSpec(mesh, material, anchors=floor, damping=damping, mass_scheme="voronoi"))


def free_ball(mass: float, radius: float, drop: float, *, joint: str = FREE) -> ToolBodies:
    """Solid ball of a mass [kg] and radius [m] at rest, `drop` [m] above the block's middle (and off it by 1 %)."""
    inertia = 0.4 * mass * radius**2
    place = f"{0.51 * BLOCK[0]} {0.49 * BLOCK[1]} {BLOCK[2] + radius + drop}"
    text = BALL.format(
        step=HAPTIC_STEP, pull=-GRAVITY, joint=joint, place=place, mass=mass, inertia=inertia, radius=radius
    )
    return ToolBodies(mujoco.MjModel.from_xml_string(text))


class Coupled:
    """Organ and free ball with their exchange of forces."""

    def __init__(self, model: OrganModel, ball: ToolBodies, contact: ContactLaw = ELASTIC) -> None:
        """Start with the organ at rest and the ball as it is."""
        self.model, self.ball, self.contact = model, ball, contact
        mujoco.mj_forward(ball.model, ball.data)  # `energy` reads its inertia.
        self.state: OrganState = rest_state(model, shape_count=1)
        self.wrench: FloatArray = np.zeros((1, 6))
        self._ground = BLOCK[2] + float(ball.shapes.shape_radius[0])
        # Tissue squeezed by the heaviest ball is stiffer than at rest: one substep more.
        self._count = substeps_needed(HAPTIC_STEP, stable_dt(model, contact)) + 1

    def step(self) -> None:
        """Advance by one haptic step.

        Raises:
            OrganDivergedError: an inverted tet, a number that is not finite, or a force beyond FORCE_CAP.
        """
        dt, compiled = HAPTIC_STEP / self._count, runs_compiled()
        result = haptic_steps(
            self.model, self.state, self.ball, self.contact, dt, self._count, self.wrench, compiled=compiled
        )
        if result.fault:
            raise OrganDivergedError(result.fault)

    def energy(self) -> float:
        """Kinetic and potential energy of ball and organ, and energy of contact, at the end of a haptic step [J].

        MuJoCo has placed the ball anew, and its shapes are read anew. Its height counts from the touch of the block at
        rest.
        """
        ball, mass = self.ball, float(self.ball.model.body_mass[1])
        mujoco.mj_kinematics(ball.model, ball.data)
        ball.read_shapes()
        kinetic = 0.5 * float(ball.damped_inertia(0.0).diagonal() @ ball.data.qvel**2)
        lift = -mass * float(ball.model.opt.gravity[2]) * (float(ball.data.xipos[1, 2]) - self._ground)
        organ = total_energy(self.model, self.state)
        return kinetic + lift + organ + contact_energy(self.model, self.state, ball.shapes, self.contact)

    def followed(self, duration: float) -> FloatArray:
        """Energy at the start and after each haptic step of a duration [s], shape (n + 1,) [J]."""
        energies = [self.energy()]
        for _ in range(round(duration / HAPTIC_STEP)):
            self.step()
            energies.append(self.energy())
        return np.array(energies)


def bounces(falls: tuple[tuple[float, float], ...], duration: float = 10.0) -> Iterator[Result]:
    """Balls of a mass [kg] falling from a height [m], 10 s without alpha, friction and contact damping.

    Energy of ball, organ and contact is m g h at the start, counted from the ball's touch. A sunken ball is far below
    that: the second row asks for no energy to come back later either.
    """
    model = small_block(Damping(alpha=0.0))
    for mass, height in falls:
        coupled = Coupled(model, free_ball(mass, RADIUS, height, joint=UPRIGHT if mass > 0.05 else FREE))
        energy = coupled.followed(duration)
        name = f"{mass * 1e3:.0f} g from {height * 1e3:.1f} mm"
        change = f"{(energy[-1] - energy[0]) * 1e6:+.3g} uJ from {energy[0] * 1e6:.3g} uJ"
        window = energy[: len(energy) // WINDOW * WINDOW].reshape(-1, WINDOW).mean(axis=1)
        yield compare(
            f"largest energy of a bouncing ball, {name}", "passivity: never above its start", expected=1.0,
            measured=energy.max() / energy[0], tolerance=0.01,
            note=f"in {duration:g} s the energy changes by {change}",
        )  # fmt: skip
        yield compare(
            f"largest rise of its mean over 0.1 s, {name}", "passivity: what is lost stays lost", expected=0.0,
            measured=(window - np.minimum.accumulate(window)).max() / energy[0], tolerance=0.01,
            note="as a share of the start; within 0.1 s symplectic Euler swings by a few per cent",
        )  # fmt: skip
        shown = slice(None, None, max(1, len(energy) // 500))
        time = (HAPTIC_STEP * np.arange(len(energy)))[shown]
        change = (energy[shown] - energy[0]) * 1e6
        yield Curve("energy", name, time, change, "time [s]", "energy gained [uJ]", False)


def presses(count: int) -> Iterator[Row]:
    """Work of the tool on the tissue over random presses, slides and releases, each from rest, with losses."""
    model = small_block(Damping(alpha=ALPHA))
    substeps = substeps_needed(HAPTIC_STEP, stable_dt(model, LOSSY))
    random = np.random.default_rng(3)
    total = lowest = lowest_within = 0.0
    for _ in range(count):
        work = total + np.cumsum(press_work(model, substeps, random))
        lowest_within = min(lowest_within, float(work.min()) - total)
        lowest = min(lowest, float(work.min()))
        total = float(work[-1])
    yield compare(
        f"lowest cumulative work of {count} presses", "passivity: tissue at rest gives no work", expected=0.0,
        measured=lowest, tolerance=0.0, unit="J",
        note=f"together {total:.3g} J; lowest within one press {lowest_within:.2g} J",
    )  # fmt: skip


def press_work(model: OrganModel, substeps: int, random: np.random.Generator) -> FloatArray:
    """Work of the tool in each haptic step of a press from rest, -F . v dt [J], shape (n_step,).

    A ball of 6 to 10 mm slides 1 to 4 mm into the block at 20 to 200 mm/s, then sideways, then out.
    """
    radius, depth, speed = random.uniform(0.006, 0.010), random.uniform(0.001, 0.004), random.uniform(0.02, 0.2)
    site = random.uniform(0.3, 0.7, 2) * BLOCK[:2]
    start = np.array([*site, BLOCK[2] + radius])
    state = rest_state(model, shape_count=1)
    shapes = round_shapes([[start, start]], radius)
    way = max(1, round(depth / speed / HAPTIC_STEP))
    work: list[float] = []
    for down, steps in ((-1.0, way), (0.0, way // 2), (1.0, way + 5)):
        velocity = np.array([*random.uniform(-0.5, 0.5, 2), down]) * speed
        shapes.tool_twist[0, :3] = velocity
        for _ in range(steps):
            wrench = advance_or_raise(model, state, HAPTIC_STEP / substeps, substeps, shapes, LOSSY)
            work.append(-HAPTIC_STEP * float(wrench[0, :3] @ velocity))
    return np.array(work)
