"""A free block on a support: weight on a plane, rest and sliding on an incline."""

import numpy as np

from msdm_core.kernels.structure_kernels import OrganModel, OrganState
from msdm_core.material.regions import Damping, Material
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.measure import momentum, support_forces
from msdm_core.organ.stepping import advance
from msdm_core.organ.support import Support, SupportLaw
from surgsim_env.validation.row import Outcome, Row, compare

GRAVITY = 9.81  # [m/s^2]
DAMPED = Damping(alpha=25.0)
FLOOR = Support("floor", "plane")
STEP_SHARE = 0.9
SLIDES = ((20.0, 0.2), (35.0, 0.4))  # angle [degrees], friction
SLIDING_TIME = 0.3  # [s]


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
    """A block of 40 x 40 x 20 mm, 5 mm cells, that stands free on z = 0 (of a turned frame), its middle over 0."""
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
    """A block settled on a plane that falls towards +x by an angle [rad], held there by friction of 2, then by less."""
    slope = Support("slope", "plane", axis=(np.sin(tilt), 0.0, np.cos(tilt)), friction=2.0)
    model = free_block(slope, frame=slope.frame, damping=Damping(alpha=0.0, beta=1e-3), modulus=20000.0)
    state = rest_state(model)
    left = np.array([friction])
    left.setflags(write=False)
    return model._replace(support_friction=left), state


def run(model: OrganModel, state: OrganState, seconds: float, dt: float | None = None) -> None:
    """Advance by whole substeps, of 0.9 of the stable step unless `dt` [s] is given."""
    dt = STEP_SHARE * model.stable_step if dt is None else dt
    advance(model, state, dt=dt, substep_count=round(seconds / dt))


def slid(tilt: float, friction: float) -> tuple[float, float]:
    """Acceleration down an incline [m/s^2], mean of 0.3 s from rest: from the path 2 x / t^2, from the speed v / t."""
    model, state = on_incline(tilt, friction)
    down, mass = np.array([np.cos(tilt), 0.0, -np.sin(tilt)]), model.node_mass.sum()
    dt = STEP_SHARE * model.stable_step
    seconds = round(SLIDING_TIME / dt) * dt
    start = model.node_mass @ state.node_position
    run(model, state, seconds, dt)
    path = (model.node_mass @ state.node_position - start) @ down / mass
    speed = momentum(model, state) @ down / mass
    return float(2.0 * path / seconds**2), float(speed / seconds)


def crept(tilt: float, friction: float) -> float:
    """Largest creep of any node in half a second on an incline that holds the block [m].

    Half a second before, friction becomes that of the incline: what lies near its limit gives, and the block swings.
    """
    model, state = on_incline(tilt, friction)
    run(model, state, 0.5)
    before = state.node_position.copy()
    run(model, state, 0.5)
    return float(np.abs(state.node_position - before).max())


def on_supports() -> Outcome:
    """Weight on a plane, no creep below the angle of friction, g (sin a - mu cos a) above it."""
    model = free_block(FLOOR)
    force = support_forces(model, rest_state(model)).sum(axis=0)
    rows: list[Row] = [
        compare(
            "block on a plane, force of the support", "statics: the weight",
            expected=float(model.node_mass.sum()) * GRAVITY, measured=float(force[2]), tolerance=1e-3, unit="N",
            note=f"40 x 40 x 20 mm, cell 5 mm; across it {np.hypot(*force[:2]):.1g} N",
        ),
        compare(
            "block on an incline of 20 degrees, creep in 0.5 s", "Coulomb: at rest where tan a < mu", expected=0.0,
            measured=crept(np.radians(20.0), 0.4), tolerance=1e-7, unit="m", absolute=True,
            note="mu 0.4, tan a = 0.364; the node that moves most",
        ),
    ]  # fmt: skip
    for degrees, friction in SLIDES:
        tilt = np.radians(degrees)
        path, speed = slid(tilt, friction)
        rows.append(
            compare(
                f"block on an incline of {degrees:g} degrees, mu {friction:g}, acceleration",
                "Coulomb: g (sin a - mu cos a)", expected=float(GRAVITY * (np.sin(tilt) - friction * np.cos(tilt))),
                measured=path, tolerance=0.02, unit="m/s^2",
                note=f"from the path in {SLIDING_TIME:g} s from rest; {speed:.4g} m/s^2 from the speed at its end",
            )
        )  # fmt: skip
    return Outcome(tuple(rows))
