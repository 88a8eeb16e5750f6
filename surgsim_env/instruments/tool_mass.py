"""Minimum mass of a tool: with a lighter one the explicit force exchange is unstable."""

from dataclasses import dataclass

import mujoco
import numpy as np

from msdm_core.errors import OrganError
from msdm_core.kernels.structure_kernels import ContactLaw
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.tool_bodies import ToolBodies


@dataclass(frozen=True)
class ToolMass:
    """Effective mass of a tool at its contact shapes, and the minimum that the exchange needs.

    Args:
        name: the tool's body.
        stiffness: its largest contact stiffness [N/m].
        damping: its largest contact damping [N s/m].
        mass: its least effective mass over the ends of its contact shapes and all directions [kg].
        damped_mass: the same for M + (dt / 2) D, with the damping D of its joints [kg].
        least_mass: minimum of `damped_mass` [kg].
        least_damping: joint damping along the lightest direction that makes up for the mass [N s/m].
    """

    name: str
    stiffness: float
    damping: float
    mass: float
    damped_mass: float
    least_mass: float
    least_damping: float


def contact_area(tools: ToolBodies, tool: int) -> float:
    """Largest surface area that can push a tool [m^2]: the cross-sections of its shapes, pi r^2 + 2 r l + w (2 r + l).

    l and w are length and width of the core, 0 for a ball, w = 0 for a capsule.

    A surface pressed by k_p per area and penetration holds a shape with k_p int (e . u)^2 dA along u, e being the
    direction of the pressure. For a ball in a flat surface up to its centre that is half of pi r^2, for one with
    tissue wrapped around its lower half two thirds; for a capsule's side pi / 4 of 2 r l. What the turning of the
    pressure adds is smaller by penetration / radius.
    """
    mine = tools.shapes.shape_tool == tool
    radius = tools.shapes.shape_radius[mine]
    length = np.linalg.norm(np.diff(tools.shapes.shape_ends[mine], axis=1)[:, 0], axis=1)
    width = 2.0 * np.linalg.norm(tools.shapes.shape_span[mine], axis=1)
    return float((np.pi * radius**2 + 2.0 * radius * (length + width) + width * length).sum())


def tool_masses(tools: ToolBodies, contact: ContactLaw, surface_area: float) -> list[ToolMass]:
    """Effective and minimum mass of each tool at the tools' current pose.

    In the worst case a tool of mass m touches tissue too heavy to move within a haptic step dt: a spring k = k_p A and
    a damper c = c_p A, where A is `contact_area`, at most the organ's whole surface; k_t replaces k_p where sticking
    friction is stiffer. An explicit exchange takes the force at the mean place x_n + v_n dt / 2 of a twist held through
    the step, v_(n+1) = v_n - (dt / m) (k (x_n + v_n dt / 2) + c v_n), x_(n+1) = x_n + dt v_(n+1). Its characteristic
    polynomial leaves the unit circle at z = -1, where 4 m = 2 k dt^2 + 2 c dt:

        m + b dt / 2 >= (k dt + c) dt / 2,

    where b is the joints' damping, which MuJoCo takes implicitly: m > k dt^2 / 2 without damping, or else
    b > k dt + c - 2 m / dt. (The minimum mass of Brown & Colgate 1998, "Minimum mass for haptic display simulations",
    for this integrator; the damping is Colgate & Schenkel's b > k T / 2, moved from the device to the tool.) As tools
    here respond within the step, the actual limit is lower, 0.25 to 0.33 k dt^2 depending on the number of substeps,
    and the bound is safe by a factor of 1.5 to 2. The damping of servos is not counted, because servos saturate, nor is
    their stiffness.

    Args:
        tools: of one model; the derived quantities of its `data` are updated.
        contact: the scene's contact law.
        surface_area: of the organ's touchable surface [m^2].
    """
    mujoco.mj_forward(tools.model, tools.data)
    tools.read_shapes()
    dt = tools.model.opt.timestep
    stiffest = max(contact.stiffness, contact.tangential_stiffness if contact.friction > 0.0 else 0.0)
    found: list[ToolMass] = []
    for tool, name in enumerate(tools.tool_names):
        area = min(contact_area(tools, tool), surface_area)
        stiffness, damping = stiffest * area, contact.damping * area
        mass, damped = (effective_mass(tools, tool, tools.damped_inertia(share * dt)) for share in (0.0, 0.5))
        least = 0.5 * dt * (stiffness * dt + damping)
        found.append(ToolMass(name, stiffness, damping, mass, damped, least, max(0.0, 2.0 * (least - mass) / dt)))
    return found


def effective_mass(tools: ToolBodies, tool: int, inertia: FloatArray) -> float:
    """Least mass of a tool at the ends of its shapes' axes, 1 / max eig(J M^-1 J^T) [kg], M (nv, nv) as given."""
    jacobian = tools.jacobian(tool)
    mobility = 0.0
    mine = tools.shapes.shape_tool == tool
    ends, span = tools.shapes.shape_ends[mine], tools.shapes.shape_span[mine][:, None]
    for end in np.concatenate([ends - span, ends + span]).reshape(-1, 3):
        x, y, z = end - tools.shapes.tool_centre[tool]
        # Velocity of that end: v + omega x (x, y, z).
        there = jacobian[:3] + np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]) @ jacobian[3:]
        mobility = max(mobility, float(np.linalg.eigvalsh(there @ np.linalg.solve(inertia, there.T))[-1]))
    return 1.0 / mobility if mobility > 0.0 else np.inf


def check_tool_masses(scene: str, tools: ToolBodies, contact: ContactLaw, surface_area: float) -> None:
    """Refuse a tool that is too light for a stable exchange.

    Raises:
        OrganError: a tool is too light (names it, its mass, the minimum mass, and the damping that would do instead).
    """
    for found in tool_masses(tools, contact, surface_area):
        if found.damped_mass < found.least_mass:
            raise OrganError(
                f"scene {scene!r}: tool {found.name!r} weighs {found.mass * 1e3:.3g} g at its tip, too little for a "
                f"contact as stiff as {found.stiffness:.3g} N/m at steps of {tools.model.opt.timestep * 1e3:g} ms: the "
                f"exchange would be unstable. Give it at least {found.least_mass * 1e3:.3g} g, or joints damped with "
                f"{found.least_damping:.3g} N s/m, or lower contact.stiffness or timing.haptic_step"
            )
