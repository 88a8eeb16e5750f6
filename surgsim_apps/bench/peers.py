"""Other simulators at the press: MuJoCo's own deformable bodies (flexcomp), and optionally Newton.

Flex is full or trilinear, implicit or explicit; Newton (the `newton` package, on the CPU) has an explicit solver and
vertex block descent.
"""

import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_apps.bench.measurement import Cells
from surgsim_apps.bench.presses import (
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
from surgsim_apps.bench.report import AbsentError

# Half thickness of flex vertices, radius of a particle [m]; the ball's surface is higher by this at contact.
SKIN = 0.0005
# The hardest contact without noise: penetration stays below 0.05 mm.
FLEX_CONTACT = 'condim="1" solref="0.002 1" solimp="0.99 0.999 0.0001"'
NEWTON_CONTACT = 2e3  # [N/m] per particle; penetration 0.05 mm
SMITH = MODULUS / (2.0 * (1.0 + POISSON))
LAME = MODULUS * POISSON / ((1.0 + POISSON) * (1.0 - 2.0 * POISSON))
# Explicit steps to be tried for flex's default integrator [s], the longest first, and its elastic damping [s]: that of
# the implicit one needs far shorter steps.
EXPLICIT_STEPS = (5e-4, 2e-4, 1e-4, 5e-5)
EXPLICIT_DAMPING = 0.0003
# Longer implicit steps need more iterations than the default.
LONG_ITERATIONS = 1000
MODEL = """<mujoco>
<option timestep="{dt}" integrator="{integrator}" solver="CG" iterations="{iterations}" tolerance="1e-8"
  gravity="0 0 0"/>
<size memory="500M"/>
<worldbody>
<body name="ball" mocap="true" pos="0 0 1"><geom type="sphere" size="{radius}" {contact}/></body>
<flexcomp name="block" type="grid" dim="3" count="{count}" spacing="{spacing}" pos="0 0 {middle}" mass="{mass}"
  radius="{skin}" {dof}>
<contact {contact} selfcollide="none"/>
<elasticity young="{young}" poisson="{poisson}" damping="{damping}"/>
<pin gridrange="0 0 0 {last}"/>
</flexcomp>
</worldbody>
</mujoco>"""


@dataclass(frozen=True)
class Flex:
    """One setting of flexcomp.

    Nodes of its grid, integrator, step [s], elastic damping [s], cells of trilinear, and the most iterations of its
    solvers (100 is MuJoCo's default).
    """

    grid: Cells
    integrator: str = "discrete"
    dt: float = 1e-3
    damping: float = 0.005
    trilinear: Cells | None = None
    iterations: int = 100

    def contender(self) -> Contender:
        """This setting, compiled and ready to press; AbsentError if MuJoCo refuses it."""
        kind = "full" if self.trilinear is None else "trilinear " + "x".join(map(str, self.trilinear))
        try:
            model = self._compile()
        except ValueError as refused:
            raise AbsentError(f"this MuJoCo refuses the model: {refused}") from None
        nodes, tets = self.grid[0] * self.grid[1] * self.grid[2], int(model.flex_elemnum[0])
        setting = f"{self.integrator}, {1e3 * self.dt:g} ms, CG, at most {self.iterations} iterations"
        setting += f", damping {self.damping:g} s, {model.nv} dof"
        name = f"MuJoCo flex {kind}, {self.integrator} {1e3 * self.dt:g} ms"
        return Contender(name, setting, f"{nodes} nodes, {tets} tets", lambda offset: self._press(model, offset))

    def _compile(self) -> mujoco.MjModel:
        cells = self.trilinear
        pinned = self.grid if cells is None else tuple(count + 1 for count in cells)
        dof = "" if cells is None else f'dof="trilinear" cellcount="{" ".join(map(str, cells))}"'
        spacing = [size / (count - 1) for size, count in zip(SIZE, self.grid)]
        return mujoco.MjModel.from_xml_string(
            MODEL.format(
                dt=self.dt, integrator=self.integrator, radius=RADIUS, contact=FLEX_CONTACT, skin=SKIN, dof=dof,
                count=" ".join(map(str, self.grid)), spacing=" ".join(map(str, spacing)), middle=0.5 * SIZE[2],
                iterations=self.iterations,
                mass=DENSITY * float(np.prod(SIZE)), young=MODULUS, poisson=POISSON, damping=self.damping,
                last=f"{pinned[0] - 1} {pinned[1] - 1} 0",
            )
        )  # fmt: skip

    def _press(self, model: mujoco.MjModel, offset: float) -> Pressed:
        data = mujoco.MjData(model)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        place = offset * SIZE[0] / (self.grid[0] - 1)
        steps = step_count(self.dt)
        clock = Clock()
        for step in range(steps):
            height = SIZE[2] + SKIN + RADIUS + ball_height((step + 1) * self.dt)
            data.mocap_pos[0] = place, place, height
            mujoco.mj_step(model, data)
            if data.warning.number.any():
                raise DivergedError(f"{_warning(data)} after {step + 1} steps of {1e3 * self.dt:g} ms")
        times = clock.read()
        return Pressed(abs(float(contact_force(model, data)[2])), *times, steps * self.dt)


def _warning(data: mujoco.MjData) -> str:
    kinds = range(mujoco.mjtWarning.mjNWARNING)
    return ", ".join(mujoco.mjtWarning(kind).name for kind in kinds if data.warning[kind].number)


def contact_force(model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
    """Sum of all contact forces of the last step [N], shape (3,), all of them on the ball."""
    total, wrench = np.zeros(3), np.zeros(6)
    for number in range(data.ncon):
        mujoco.mj_contactForce(model, data, number, wrench)
        total += data.contact[number].frame.reshape(3, 3).T @ wrench[:3]
    return total


def longest_stable(settings: "Iterable[Flex | Newton]") -> Contender:
    """The first stable setting in the press, of those with the longest step first; it lists the tried ones."""
    tried: list[str] = []
    for setting in settings:
        contender = setting.contender()
        try:
            contender.press(0.0)
            return replace(contender, setting="; ".join([contender.setting, *tried]))
        except DivergedError as fault:
            tried.append(str(fault))
    raise DivergedError("diverged: " + "; ".join(tried))


def fastest_within(base: Flex, force: float, steps: tuple[int, ...], share: float) -> tuple[Flex | None, list[str]]:
    """`base` at its fastest step with a force within a share of `force`, and a text on each tried step.

    The steps are multiples of `base`'s, tried once each.
    """
    best, best_time, tried = None, np.inf, []
    for multiple in steps:
        flex = replace(base, dt=multiple * base.dt, iterations=LONG_ITERATIONS)
        try:
            pressed = flex.contender().press(0.0)
        except DivergedError as fault:
            tried.append(f"{1e3 * flex.dt:g} ms: {fault}")
            continue
        off = pressed.force / force - 1.0
        tried.append(f"{1e3 * flex.dt:g} ms: force {100.0 * off:+.1f} %")
        if abs(off) <= share and pressed.processor < best_time:
            best, best_time = flex, pressed.processor
    return best, tried


@dataclass(frozen=True)
class Newton:
    """One setting: nodes of the grid, "explicit" or "vbd", step [s], iterations of vbd, viscosity of tets."""

    grid: Cells
    solver: str
    dt: float
    iterations: int = 10
    damping: float = 1.0

    def contender(self) -> Contender:
        """Ready to press; AbsentError without Newton."""
        newton, wp = modules()
        with wp.ScopedDevice("cpu"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model, ball = self._build(newton, wp)
        if self.solver == "explicit":
            name, extra = "SolverSemiImplicit", f"k_damp {self.damping:g}"
        else:
            name, extra = "SolverVBD", f"{self.iterations} iterations, k_damp {self.damping:g}"
        setting = f"{name}, {1e3 * self.dt:g} ms, {extra}, float32, contact {NEWTON_CONTACT:g} N/m at particles"
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
        material = newton.ModelBuilder.ShapeConfig(density=0.0, ke=NEWTON_CONTACT, kd=0.0, kf=0.0, mu=0.0)
        builder.add_shape_sphere(ball, radius=RADIUS, cfg=material)
        if self.solver != "explicit":
            builder.color()
        model = builder.finalize(device="cpu")
        model.soft_contact_ke, model.soft_contact_kd = NEWTON_CONTACT, 0.0
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
                options = {} if force is None else {"observables": force if step == steps - 1 else None}
                solver.step(now, then, control, contacts, self.dt, **options)
                now, then = then, now
            times = clock.read()
            # After the swap `then` is the state with the forces of the last step.
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
    """Fault of a state: numbers not finite, tets inside out; "" without one.

    The explicit solver is silent about a too long step: its result may be finite, and means nothing.
    """
    if not np.isfinite(points).all():
        return "positions are not finite"
    corners = points[tets].astype(np.float64)
    inverted = int((np.linalg.det(corners[:, 1:] - corners[:, :1]) <= 0.0).sum())
    return f"{inverted} tets inside out" if inverted else ""


def modules() -> tuple[Any, Any]:
    """`newton` and `warp`; AbsentError without them."""
    try:
        wp = import_module("warp")
        # Warnings and worse: not the machine's devices, nor each compiled module.
        wp.config.log_level = max(wp.config.log_level, 30)
        return import_module("newton"), wp
    except ImportError as error:
        raise AbsentError(f"not installed ({error}): pip install 'surgsim[bench]'") from None
