"""MuJoCo's own deformable bodies (flexcomp) at the press: full and trilinear, implicit and explicit."""

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.bench.measurement import Cells
from surgsim_env.bench.presses import (
    DENSITY,
    MODULUS,
    POISSON,
    RADIUS,
    SIZE,
    Clock,
    Contender,
    DivergedError,
    Pressed,
    ball_height,
    step_count,
)

# Half thickness of flex vertices [m]: the ball meets the surface higher by this.
SKIN = 0.0005
# The hardest contact without noise: penetration stays below 0.05 mm.
CONTACT = 'condim="1" solref="0.002 1" solimp="0.99 0.999 0.0001"'
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
        """This setting, compiled and ready to press."""
        kind = "full" if self.trilinear is None else "trilinear " + "x".join(map(str, self.trilinear))
        model = self._compile()
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
                dt=self.dt, integrator=self.integrator, radius=RADIUS, contact=CONTACT, skin=SKIN, dof=dof,
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
        # Without a handler MuJoCo writes a log file into the working folder.
        mujoco.set_mju_user_warning(lambda text: None)
        try:
            clock = Clock()
            for step in range(steps):
                height = SIZE[2] + SKIN + RADIUS + ball_height((step + 1) * self.dt)
                data.mocap_pos[0] = place, place, height
                mujoco.mj_step(model, data)
                if data.warning.number.any():
                    raise DivergedError(f"{_warning(data)} after {step + 1} steps of {1e3 * self.dt:g} ms")
            times = clock.read()
        finally:
            mujoco.set_mju_user_warning(None)
        return Pressed(abs(float(contact_force(model, data)[2])), *times, steps * self.dt)


def _warning(data: mujoco.MjData) -> str:
    kinds = range(mujoco.mjtWarning.mjNWARNING)
    return ", ".join(mujoco.mjtWarning(kind).name for kind in kinds if data.warning[kind].number)


def contact_force(model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
    """Sum of all contact forces of the last step [N], shape (3,): the ball is the only thing that is touched."""
    total, one = np.zeros(3), np.zeros(6)
    for number in range(data.ncon):
        mujoco.mj_contactForce(model, data, number, one)
        total += data.contact[number].frame.reshape(3, 3).T @ one[:3]
    return total


# Explicit steps that are tried for the default integrator [s], the longest first.
EXPLICIT_STEPS = (5e-4, 2e-4, 1e-4, 5e-5)
# Elastic damping of the explicit integrator [s]: the implicit one's would ask for far shorter steps.
EXPLICIT_DAMPING = 0.0003
# Longer implicit steps need more iterations than the default lets them have.
LONG_ITERATIONS = 1000


def longest_explicit(grid: Cells) -> Flex:
    """The default integrator (Euler) at the longest step that bears the press; DivergedError with what was tried."""
    tried: list[str] = []
    for dt in EXPLICIT_STEPS:
        flex = Flex(grid, "Euler", dt, EXPLICIT_DAMPING)
        try:
            flex.contender().press(0.0)
            return flex
        except DivergedError as fault:
            tried.append(str(fault))
    raise DivergedError("; ".join(tried))


def fastest_within(
    base: Flex, force: float, steps: tuple[int, ...], share: float, offset: float = 0.0
) -> tuple[Flex | None, list[str]]:
    """`base` at the step that takes least time while its force stays within a share of a force, and all that was tried.

    The steps are multiples of `base`'s, tried once each.
    """
    best, best_time, tried = None, np.inf, []
    for multiple in steps:
        flex = replace(base, dt=multiple * base.dt, iterations=LONG_ITERATIONS)
        try:
            pressed = flex.contender().press(offset)
        except DivergedError as fault:
            tried.append(f"{1e3 * flex.dt:g} ms: {fault}")
            continue
        off = pressed.force / force - 1.0
        tried.append(f"{1e3 * flex.dt:g} ms: force {100.0 * off:+.1f} %")
        if abs(off) <= share and pressed.processor < best_time:
            best, best_time = flex, pressed.processor
    return best, tried
