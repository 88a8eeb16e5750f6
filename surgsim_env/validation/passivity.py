"""Passivity of organ and tool together: bounces of a free ball without losses, and the work of many presses."""

import numpy as np

from msdm_core.errors import OrganDivergedError
from msdm_core.kernels.structure_kernels import FAULT_NONE, ContactLaw, OrganModel
from msdm_core.material.regions import Damping
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.compile import rest_state
from msdm_core.organ.stability import stable_dt
from msdm_core.organ.stepping import advance_organ, describe_fault, round_shapes
from surgsim_env.scene.model import substeps_needed
from surgsim_env.validation.free_tool import BLOCK, FREE, HAPTIC_STEP, UPRIGHT, Coupled, free_ball, small_block
from surgsim_env.validation.row import Curve, Outcome, Row, compare

RADIUS = 0.010  # [m]
WINDOW = 100  # [haptic steps]
# The losses of a scene.
LOSSY = ContactLaw(stiffness=2e7, damping=100.0, friction=0.2, tangential_stiffness=1e7)
ALPHA = 25.0  # [1/s]
# Mass [kg] and height [m]. After a low fall little energy is lost before vibrating tissue under the resting ball could
# gain some; after a high fall the ball bounces.
OTHER_FALLS = ((0.005, 0.005), (0.02, 0.0005), (0.02, 0.005), (0.1, 0.0005), (0.1, 0.005))


def bounces(falls: tuple[tuple[float, float], ...], duration: float = 10.0) -> Outcome:
    """Balls of a mass [kg] that fall from a height [m] for 10 s, without alpha, friction and contact damping.

    Energy is that of ball, organ and contact together, from the ball's touching height on: m g h at the start. A ball
    that has sunk in is far below that, so the second row asks that no energy comes back later either.
    """
    model = small_block(Damping(alpha=0.0))
    rows: list[Row] = []
    curves: list[Curve] = []
    for mass, height in falls:
        coupled = Coupled(model, free_ball(mass, RADIUS, height, joint=UPRIGHT if mass > 0.05 else FREE))
        energy = coupled.followed(duration)
        name = f"{mass * 1e3:.0f} g from {height * 1e3:.1f} mm"
        window = energy[: len(energy) // WINDOW * WINDOW].reshape(-1, WINDOW).mean(axis=1)
        rise = float((window - np.minimum.accumulate(window)).max() / energy[0])
        rows += [
            compare(
                f"largest energy of a bouncing ball, {name}", "passivity: never above its start", expected=1.0,
                measured=float(energy.max() / energy[0]), tolerance=0.01,
                note=f"{duration:g} s; at the end {(energy[-1] - energy[0]) * 1e6:+.3g} uJ of {energy[0] * 1e6:.3g} uJ",
            ),
            compare(
                f"largest rise of its mean over 0.1 s, {name}", "passivity: what is lost stays lost", expected=0.0,
                measured=rise, tolerance=0.01, absolute=True,
                note="as a share of the start; within 0.1 s symplectic Euler swings by a few per cent",
            ),
        ]  # fmt: skip
        shown = slice(None, None, max(1, len(energy) // 500))
        time = (HAPTIC_STEP * np.arange(len(energy)))[shown]
        change = (energy[shown] - energy[0]) * 1e6
        curves.append(Curve("energy", name, tuple(time), tuple(change), "time [s]", "energy gained [uJ]", False))
    return Outcome(tuple(rows), tuple(curves))


def presses(count: int) -> Outcome:
    """The tool's work on the tissue over many random presses, slides and releases, each from rest, losses on."""
    model = small_block(Damping(alpha=ALPHA))
    substeps = substeps_needed(HAPTIC_STEP, stable_dt(model, LOSSY))
    random = np.random.default_rng(3)
    total = lowest = lowest_within = 0.0
    for _ in range(count):
        work = total + np.cumsum(press_work(model, substeps, random))
        lowest_within = min(lowest_within, float(work.min()) - total)
        lowest = min(lowest, float(work.min()))
        total = float(work[-1])
    row = compare(
                f"lowest cumulative work of {count} presses", "passivity: tissue at rest gives no work", expected=0.0,
                measured=lowest, tolerance=0.0, unit="J", absolute=True,
                note=f"together {total:.3g} J; lowest within one press {lowest_within:.2g} J",
    )  # fmt: skip
    return Outcome((row,))


def press_work(model: OrganModel, substeps: int, random: np.random.Generator) -> FloatArray:
    """Work of the tool in each haptic step of one press from rest, -F . v dt [J], shape (n_step,).

    A ball of 6 to 10 mm goes 1 to 4 mm into the block at 20 to 200 mm/s, sliding as it goes, then sideways, then out.
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
        wrench = np.zeros((1, 6))
        for _ in range(steps):
            fault = advance_organ(model, state, shapes, LOSSY, HAPTIC_STEP / substeps, substeps, wrench)
            if fault != FAULT_NONE:
                raise OrganDivergedError(describe_fault(model, state, fault))
            work.append(-HAPTIC_STEP * float(wrench[0, :3] @ velocity))
    return np.array(work)
