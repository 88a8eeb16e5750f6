"""A free ball in MuJoCo and a small organ, exchanging forces as a scene does, and the energy of both."""

import mujoco
import numpy as np

from msdm_core.errors import OrganDivergedError, OrganError
from msdm_core.kernels.structure_kernels import ContactLaw, OrganModel, OrganState
from msdm_core.material.regions import Damping, Material
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.measure import contact_energy, kinetic_energy, potential_energy
from msdm_core.organ.stability import stable_dt
from surgsim_env.coupling.exchange import haptic_steps
from surgsim_env.coupling.mujoco_library import runs_compiled
from surgsim_env.instruments.tool_bodies import ToolBodies
from surgsim_env.scene.model import substeps_needed

HAPTIC_STEP = 1e-3  # [s]
GRAVITY = 9.81  # [m/s^2], on the tool alone
BLOCK = (0.03, 0.03, 0.02)  # [m]
CELLS = (6, 6, 4)
MODULUS = 15e3  # [Pa]
# A scene's contact with nothing that takes energy.
ELASTIC = ContactLaw(stiffness=2e7, damping=0.0, friction=0.0, tangential_stiffness=1e7)

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


def small_block(damping: Damping) -> OrganModel:
    """30 x 30 x 20 mm of 5 mm cells, bonded below."""
    mesh = box_mesh(BLOCK, CELLS)
    held = np.flatnonzero(mesh.points[:, 2] < 1e-9)
    return compile_organ(OrganSpec(mesh, Material(MODULUS, 1060.0, 0.45), anchors=held, damping=damping))


FREE = "<freejoint/>"
# A heavy ball rolls off a soft block: this one goes straight up and down above it.
UPRIGHT = '<joint type="slide" axis="0 0 1"/>'


def free_ball(mass: float, radius: float, drop: float, *, joint: str = FREE, gravity: float = GRAVITY) -> ToolBodies:
    """A solid ball of a mass [kg] and radius [m] at rest, `drop` [m] above the block's middle (and off it by 1 %)."""
    inertia = 0.4 * mass * radius**2
    place = f"{0.51 * BLOCK[0]} {0.49 * BLOCK[1]} {BLOCK[2] + radius + drop}"
    text = BALL.format(
        step=HAPTIC_STEP, pull=-gravity, joint=joint, place=place, mass=mass, inertia=inertia, radius=radius
    )
    return ToolBodies(mujoco.MjModel.from_xml_string(text))


class Coupled:
    """An organ and a free ball that exchange forces."""

    def __init__(self, model: OrganModel, ball: ToolBodies, contact: ContactLaw = ELASTIC) -> None:
        """Start with the organ at rest and the ball as it is."""
        self.model, self.ball, self.contact = model, ball, contact
        mujoco.mj_forward(ball.model, ball.data)  # its inertia, which `energy` reads
        self.state: OrganState = rest_state(model, shape_count=1)
        self.wrench: FloatArray = np.zeros((1, 6))
        self._ground = BLOCK[2] + float(ball.shapes.shape_radius[0])
        self._count = substeps_needed(HAPTIC_STEP, stable_dt(model, contact))

    def step(self) -> None:
        """Advance by one haptic step.

        Raises:
            OrganDivergedError: an inverted tet, a number that is not finite, or a force beyond FORCE_CAP.
        """
        dt, compiled = HAPTIC_STEP / self._count, runs_compiled()
        taken = haptic_steps(
            self.model, self.state, self.ball, self.contact, dt, self._count, self.wrench, compiled=compiled
        )
        if taken.fault:
            raise OrganDivergedError(taken.fault)

    def energy(self) -> float:
        """Kinetic and potential energy of ball and organ and that of contact, all of the same instant [J].

        After a haptic step coordinates and velocities of both are those of the step's end; the shapes are read anew,
        because MuJoCo has placed the ball anew. The ball's height counts from where it would touch the block at rest.
        """
        ball, mass = self.ball, float(self.ball.model.body_mass[1])
        mujoco.mj_kinematics(ball.model, ball.data)
        ball.read_shapes()
        kinetic = 0.5 * float(ball.damped_inertia(0.0).diagonal() @ ball.data.qvel**2)
        lift = -mass * float(ball.model.opt.gravity[2]) * (float(ball.data.xipos[1, 2]) - self._ground)
        organ = kinetic_energy(self.model, self.state) + potential_energy(self.model, self.state)
        return kinetic + lift + organ + contact_energy(self.model, self.state, ball.shapes, self.contact)

    def followed(self, duration: float) -> FloatArray:
        """Energy at the start and after every haptic step of a duration [s], shape (n + 1,) [J].

        Raises:
            OrganError: the ball left the organ sideways, so that nothing was measured.
        """
        energies = [self.energy()]
        for _ in range(round(duration / HAPTIC_STEP)):
            self.step()
            energies.append(self.energy())
        if self.ball.data.xipos[1, 2] < 0.0:
            raise OrganError(f"the ball rolled off the block: it is at {self.ball.data.xipos[1]} m")
        return np.array(energies)
