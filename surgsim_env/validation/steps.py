"""The stable step against the true one, 2 / omega_max, and energy over ten seconds."""

import math

import numpy as np
from scipy.sparse import diags_array
from scipy.sparse.linalg import eigsh

from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.material.regions import Capsule, Damping, Lesion, Material
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.measure import kinetic_energy, potential_energy
from msdm_core.organ.stability import stable_dt
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance_organ
from surgsim_env.validation.motion import followed
from surgsim_env.validation.row import Outcome, Row, compare
from surgsim_env.validation.statics import DENSITY, assemble_stiffness

MODULUS = 20e3  # [Pa]
STEP_COUNT = 2000
START = 1e-9  # [m]


def organs() -> dict[str, OrganModel]:
    """A plain block, a nearly incompressible one, and one with capsule, lesion and held nodes."""
    mesh = box_mesh((0.04, 0.04, 0.04), (4, 4, 4))
    still = Damping(alpha=0.0)
    held = np.flatnonzero(mesh.points[:, 2] < 1e-9)
    soft, lesion = Material(MODULUS, DENSITY, 0.45), Lesion((0.02, 0.02, 0.02), 0.012, Material(8 * MODULUS, DENSITY))
    return {
        "springs": compile_organ(OrganSpec(mesh, Material(MODULUS, DENSITY), damping=still)),
        "nu 0.45": compile_organ(OrganSpec(mesh, soft, damping=still)),
        "capsule and lesion": compile_organ(
            OrganSpec(mesh, soft, Capsule(60e3), lesions=(lesion,), anchors=held, damping=still)
        ),
    }


def fastest_mode(model: OrganModel) -> tuple[float, FloatArray]:
    """omega_max [rad/s] and its shape, largest part 1, by Lanczos to rounding."""
    root = np.repeat(np.sqrt(model.node_inverse_mass), 3)
    matrix = diags_array(root) @ assemble_stiffness(model) @ diags_array(root)
    start = np.sin(1.0 + 1.7 * np.arange(len(root)) ** 1.1)
    value, vector = eigsh(matrix, k=1, which="LA", v0=start)
    shape = (root * vector[:, 0]).reshape(-1, 3)
    return math.sqrt(float(value[0])), shape / np.abs(shape).max()


def largest_growth(model: OrganModel, shape: FloatArray, dt: float, count: int) -> float:
    """Largest displacement over that at the start in `count` steps from the fastest mode."""
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


def stable_step() -> Outcome:
    """Stable at 0.95 and unstable at 1.1 of the true limit; the limit that this package uses lies just below it."""
    rows: list[Row] = []
    for name, model in organs().items():
        omega, shape = fastest_mode(model)
        limit = 2.0 / omega
        # At 0.95 of it the mode's amplitude is at most 1 / sqrt(1 - 0.95^2) = 3.2; at 1.1 it grows 2.43 x a step.
        calm = largest_growth(model, shape, 0.95 * limit, STEP_COUNT)
        wild = largest_growth(model, shape, 1.10 * limit, STEP_COUNT)
        rows += [
            compare(
                f"stable step, {name}", "2 / omega_max of the assembled matrix", expected=limit,
                measured=stable_dt(model), tolerance=0.01, unit="s", note="the value that this package uses",
            ),
            compare(
                f"stable at 0.95, {name}", "|z| = 1", expected=1.0, measured=float(calm < 10.0), tolerance=0.0,
                note=f"grew x {calm:.3g} in {STEP_COUNT} steps",
            ),
            compare(
                f"unstable at 1.1, {name}", "|z| = 2.43", expected=1.0, measured=float(wild > 1e3), tolerance=0.0,
                note=f"grew x {wild:.3g} or more",
            ),
        ]  # fmt: skip
    return Outcome(tuple(rows))


def energy_drift() -> Outcome:
    """Undamped for 10 s at half the stable step: mean energy of the last second over that of the first."""
    model = organs()["nu 0.45"]
    random = np.random.default_rng(0)
    state = rest_state(model)
    state.node_position[:] += random.uniform(-1e-6, 1e-6, state.node_position.shape)
    dt = 0.5 * model.stable_step
    count = math.ceil(10.0 / dt)
    energy = followed(
        model, state, dt, 7, count // 7, lambda now: kinetic_energy(model, now) + potential_energy(model, now)
    )
    tenth = len(energy) // 10
    measured = float(energy[-tenth:].mean() / energy[:tenth].mean())
    return Outcome(
        (compare("energy after 10 s without damping", "conservation", expected=1.0, measured=measured, tolerance=0.01),)
    )
