"""Newton (the `newton` package, on the CPU) at the press: its explicit solver and vertex block descent. Optional."""

import math
import warnings
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from surgsim_env.bench.measurement import Cells
from surgsim_env.bench.presses import (
    DENSITY,
    MODULUS,
    POISSON,
    RADIUS,
    SIZE,
    SPEED,
    Clock,
    Contender,
    DivergedError,
    Pressed,
    ball_height,
    step_count,
)
from surgsim_env.bench.report import AbsentError

SKIN = 0.0005  # [m] radius of a particle: the ball meets the surface that much higher
CONTACT = 2e3  # [N/m] per particle; penetration 0.05 mm
SMITH = MODULUS / (2.0 * (1.0 + POISSON))
LAME = MODULUS * POISSON / ((1.0 + POISSON) * (1.0 - 2.0 * POISSON))


@dataclass(frozen=True)
class Newton:
    """One setting: nodes of the grid, "explicit" or "vbd", step [s], iterations of vbd, viscosity of tets."""

    grid: Cells
    solver: str
    dt: float
    iterations: int = 10
    damping: float = 1.0

    def contender(self) -> Contender:
        """Ready to press; AbsentError where Newton is not installed."""
        newton, wp = modules()
        with wp.ScopedDevice("cpu"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model, ball = self._build(newton, wp)
        if self.solver == "explicit":
            name, extra = "SolverSemiImplicit", f"k_damp {self.damping:g}"
        else:
            name, extra = "SolverVBD", f"{self.iterations} iterations, k_damp {self.damping:g}"
        setting = f"{name}, {1e3 * self.dt:g} ms, {extra}, float32, contact {CONTACT:g} N/m at particles"
        mesh = f"{model.particle_count} nodes, {model.tet_count} tets"
        return Contender(
            f"Newton {self.solver}, {1e3 * self.dt:g} ms", setting, mesh,
            lambda offset: self._press(newton, wp, model, ball, offset),
        )  # fmt: skip

    def _build(self, newton: Any, wp: Any) -> tuple[Any, int]:
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        x, y, z = (count - 1 for count in self.grid)
        shear, bulk = SMITH, LAME
        if self.solver == "explicit":
            # The explicit solver takes the constants of Smith et al. 2018; vertex block descent converts by itself.
            shear, bulk = 4.0 / 3.0 * SMITH, LAME + 5.0 / 6.0 * SMITH
        builder.add_soft_grid(
            pos=wp.vec3(-0.5 * SIZE[0], -0.5 * SIZE[1], 0.0), rot=wp.quat_identity(), vel=wp.vec3(0.0, 0.0, 0.0),
            dim_x=x, dim_y=y, dim_z=z, cell_x=SIZE[0] / x, cell_y=SIZE[1] / y, cell_z=SIZE[2] / z, density=DENSITY,
            k_mu=shear, k_lambda=bulk, k_damp=self.damping, particle_radius=SKIN, add_surface_mesh_edges=False,
        )  # fmt: skip
        for particle in np.flatnonzero(np.array(builder.particle_q)[:, 2] < 1e-6):
            builder.particle_mass[particle] = 0.0
            builder.particle_flags[particle] &= ~newton.ParticleFlags.ACTIVE
        # A body with a joint keeps its contact force from the state of the explicit solver; vbd wants the joint.
        add = builder.add_link if self.solver == "explicit" else builder.add_body
        ball = add(xform=wp.transform(wp.vec3(0.0, 0.0, 1.0), wp.quat_identity()), mass=1.0, is_kinematic=True)
        material = newton.ModelBuilder.ShapeConfig(density=0.0, ke=CONTACT, kd=0.0, kf=0.0, mu=0.0)
        builder.add_shape_sphere(ball, radius=RADIUS, cfg=material)
        if self.solver != "explicit":
            builder.color()
        model = builder.finalize(device="cpu")
        model.soft_contact_ke, model.soft_contact_kd = CONTACT, 0.0
        model.soft_contact_kf, model.soft_contact_mu = 0.0, 0.0
        model.particle_grid = None
        return model, ball

    def _press(self, newton: Any, wp: Any, model: Any, ball: int, offset: float) -> Pressed:
        place = offset * SIZE[0] / (self.grid[0] - 1)
        kind = newton.solvers.SolverBase.ObservableKind.CONTACT_F
        with wp.ScopedDevice("cpu"):
            explicit = self.solver == "explicit"
            solver = (
                newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
                if explicit
                else newton.solvers.SolverVBD(model, iterations=self.iterations)
            )
            pipeline = newton.CollisionPipeline(model, broad_phase="explicit", soft_contact_gap=0.002)
            now, then, contacts = model.state(), model.state(), pipeline.contacts()
            control = model.control()
            force = None if explicit else solver.observables([kind], contacts=contacts)
            steps = step_count(self.dt)
            clock = Clock()
            for step in range(-1, steps):
                # The first step, in the air, compiles.
                if step == 0:
                    clock = Clock()
                height = SIZE[2] + SKIN + RADIUS + ball_height((step + 1) * self.dt)
                self._place(now, then, ball, (place, place, height), step)
                now.clear_forces()
                pipeline.collide(now, contacts)
                given = {} if force is None else {"observables": force if step == steps - 1 else None}
                solver.step(now, then, control, contacts, self.dt, **given)
                now, then = then, now
            times = clock.read()
            # After the swap `then` is the state whose forces made the last step.
            total = then.body_f.numpy()[ball, 2] if force is None else force.contact_f.numpy()[:, 2].sum()
        fault = _fault(now.particle_q.numpy(), model.tet_indices.numpy())
        if fault or not math.isfinite(total):
            raise DivergedError(f"{fault or 'the force is not finite'} at steps of {1e3 * self.dt:g} ms")
        return Pressed(abs(float(total)), *times, steps * self.dt)

    def _place(self, now: Any, then: Any, ball: int, centre: tuple[float, float, float], step: int) -> None:
        going = 0 <= step and ball_height((step + 1) * self.dt) > ball_height(math.inf)
        for state in (now, then):
            state.body_q.numpy()[ball] = (*centre, 0.0, 0.0, 0.0, 1.0)
            state.body_qd.numpy()[ball] = (0.0, 0.0, -SPEED if going else 0.0, 0.0, 0.0, 0.0)


def _fault(points: Any, tets: Any) -> str:
    """What is wrong with a state: numbers that are not finite, tets inside out; "" where nothing is.

    The explicit solver says nothing when its step is too long: what it has left may be finite, and means nothing.
    """
    if not np.isfinite(points).all():
        return "positions are not finite"
    corners = points[tets].astype(np.float64)
    inverted = int((np.linalg.det(corners[:, 1:] - corners[:, :1]) <= 0.0).sum())
    return f"{inverted} tets inside out" if inverted else ""


def modules() -> tuple[Any, Any]:
    """`newton` and `warp`; AbsentError where they are not installed."""
    try:
        wp = import_module("warp")
        # Warnings and worse: not the machine's devices, nor each module that is compiled.
        wp.config.log_level = max(wp.config.log_level, 30)
        return import_module("newton"), wp
    except ImportError as why:
        raise AbsentError(f"not installed ({why}): pip install 'surgsim[bench]'") from None
