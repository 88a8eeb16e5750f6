"""Forward model: force over depth of a ball pressed quasi-statically into a block of tissue.

The block is bonded to a rigid bed, and the ball slides on it without friction. For a given thickness, Poisson's ratio
and law the force is proportional to Young's modulus: a run per shape serves every site.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

from msdm_core.kernels import FAULT_NONE, ContactLaw, OrganModel
from msdm_core.material import Damping, Material, Stiffening
from msdm_core.mesh import FloatArray
from msdm_core.meshing import box_mesh
from msdm_core.organ import (
    OrganSpec,
    advance_organ,
    compile_organ,
    contact_node_area,
    describe_fault,
    rest_state,
    round_shapes,
    scale_mass,
    stable_dt,
    tissue_load,
)

# Of the run: the modulus [Pa], which cancels, and the density [kg/m^3], without influence on a static press.
MODULUS, DENSITY = 1000.0, 1000.0
# Pressure per penetration over E [1/m]: a pressure of E leaves a gap of 17 um.
CONTACT_STIFFNESS = 6e4
# Cells to a radius of the ball, half the width of the block in radii, and depth of fine cells in radii; cells below may
# be twice as long.
CELLS_TO_RADIUS, HALF_WIDTH, FINE_DEPTH = 4, 2.75, 1.5
# Depths of held presses, denser for small contacts.
KNOT_COUNT, KNOT_POWER = 18, 1.4
# Stable step over that of the block's own masses, by some per cent of mass added: no influence on a static press.
STEP_GAIN = 1.5
# Substep over the stable step at rest; a deeply pressed organ is stiffer.
STEP_SHARE = 0.8
# Durations in slow periods of the block: of the move to the next depth and of the hold; share of it for the reading.
MOVE_PERIODS, HOLD_PERIODS, READ_SHARE = 0.12, 0.45, 0.05


@dataclass(frozen=True)
class PressSetting:
    """Setting of a press: radius of the ball [m], largest depth [m], Poisson's ratio of the tissue.

    Raises:
        ValueError: names the field, its value and its range.
    """

    ball_radius: float = 0.00635
    depth: float = 0.0045
    poisson_ratio: float = 0.45

    def __post_init__(self) -> None:
        if not 1e-4 <= self.ball_radius <= 0.1:
            raise ValueError(f"ball radius is {self.ball_radius:g} m; the rule is 0.0001 to 0.1 m")
        if not 0.0 < self.depth <= 1.2 * self.ball_radius:
            raise ValueError(
                f"the press is {1e3 * self.depth:.3g} mm deep with a ball of {1e3 * self.ball_radius:.3g} mm; the rule "
                "is at most 1.2 radii: is the radius right?"
            )
        if not 0.25 <= self.poisson_ratio < 0.5:
            raise ValueError(f"Poisson's ratio is {self.poisson_ratio:g}; the rule is at least 0.25 and below 0.5")


@dataclass(frozen=True)
class PressShape:
    """Shape of a force-depth curve: thickness of the tissue [m] and law of its springs, linear for a cap of 1."""

    thickness: float
    onset_strain: float = 0.0
    cap_strain: float = 1.0
    tangent_cap: float = 1.0

    def material(self, youngs_modulus: float, poisson_ratio: float) -> Material:
        """Tissue with a modulus [Pa]."""
        law = None
        if self.tangent_cap > 1.0:
            law = Stiffening(float(self.onset_strain), float(self.cap_strain), float(self.tangent_cap))
        return Material(youngs_modulus, DENSITY, poisson_ratio, stiffening=law)


@dataclass(frozen=True, eq=False)
class PressCurve:
    """Static force over modulus of a ball on a block.

    Fields:
        depth: [m], from 0 on, (n_knot,)
        area: force over Young's modulus [m^2], (n_knot,)
        strain: largest equivalent strain of stiffening tissue (`TissueLoad`), (n_knot,)
        volume_ratio_smallest: of any tet at the largest depth
    """

    depth: FloatArray
    area: FloatArray
    strain: FloatArray
    volume_ratio_smallest: float

    def at(self, depth: FloatArray) -> FloatArray:
        """Force over modulus at depths [m^2]; 0 above the surface, not finite beyond the largest depth.

        Between the knots (F / E)^(2/3), straight for Hertz, follows a monotone cubic.
        """
        smooth = PchipInterpolator(self.depth, self.area ** (2.0 / 3.0), extrapolate=False)
        return np.maximum(smooth(np.maximum(depth, 0.0)), 0.0) ** 1.5


def press_block(shape: PressShape, setting: PressSetting, *, cells_to_radius: float = CELLS_TO_RADIUS) -> PressCurve:
    """Curve of a ball pressed into the middle of a block and held at each depth until rest.

    Raises:
        ValueError: the block faults; says at which depth, and the way out.
    """
    model, top = _block(shape, setting, cells_to_radius)
    law = ContactLaw(CONTACT_STIFFNESS * MODULUS, 0.0, 0.0, 0.0)
    model = _even_mass(model, law, top, setting)
    dt = STEP_SHARE * stable_dt(model, law)
    # The slowest shear mode of the bonded block, w = pi / (2 h) sqrt(G / rho), is damped critically.
    density = float(model.node_mass.sum() / model.tet_rest_volume.sum())
    shear = MODULUS / (2.0 * (1.0 + setting.poisson_ratio))
    omega = 0.5 * math.pi / shape.thickness * math.sqrt(shear / density)
    model = model._replace(alpha=2.0 * omega)
    period = 2.0 * math.pi / omega / dt
    moving, holding = (math.ceil(share * period) for share in (MOVE_PERIODS, HOLD_PERIODS))
    reading = math.ceil(READ_SHARE * holding)
    state = rest_state(model, shape_count=1)
    centre = np.array([*top[:2], top[2] + setting.ball_radius])
    shapes = round_shapes([[centre, centre]], setting.ball_radius)
    knots = setting.depth * np.linspace(0.0, 1.0, KNOT_COUNT + 1) ** KNOT_POWER
    area, strain, wrench = np.zeros(len(knots)), np.zeros(len(knots)), np.zeros((1, 6))
    for knot in range(1, len(knots)):
        speed = (knots[knot] - knots[knot - 1]) / (moving * dt)
        for count, velocity in ((moving, -speed), (holding, 0.0), (reading, 0.0)):
            shapes.tool_twist[0, 2] = velocity
            fault = advance_organ(model, state, shapes, law, dt, count, wrench)
            if fault != FAULT_NONE:
                raise ValueError(
                    f"the model of the press fails at {1e3 * knots[knot]:.2f} mm of {1e3 * setting.depth:.2f} mm in "
                    f"tissue {1e3 * shape.thickness:.3g} mm thick ({describe_fault(model, state, fault)}): thicker "
                    "tissue or a larger ball may be nearer to what was pressed"
                )
        area[knot] = wrench[0, 2] / MODULUS
        strain[knot] = tissue_load(model, state, shapes, law).equivalent_strain
    return PressCurve(knots, np.maximum.accumulate(area), strain, float(state.volume_ratio_smallest[0]))


def _block(shape: PressShape, setting: PressSetting, cells_to_radius: float) -> tuple[OrganModel, FloatArray]:
    """The block, and the point in the middle of its top [m]."""
    fine = FINE_DEPTH * setting.ball_radius
    coarsening = 1 if shape.thickness < 1.3 * fine else 2
    layers = max(2, coarsening * round(shape.thickness / (setting.ball_radius / cells_to_radius * coarsening)))
    cell = shape.thickness / layers
    across = 4 * math.ceil(HALF_WIDTH * setting.ball_radius / (2.0 * cell))
    size = (across * cell, across * cell, shape.thickness)
    graded = {} if coarsening == 1 else {"coarsening": coarsening, "fine_depth": cell * math.ceil(fine / cell)}
    mesh = box_mesh(size, (across, across, layers), **graded)
    model = compile_organ(
        OrganSpec(
            mesh,
            shape.material(MODULUS, setting.poisson_ratio),
            anchors=np.flatnonzero(mesh.points[:, 2] < 1e-9),
            damping=Damping(alpha=0.0),
        )
    )
    return scale_mass(model, STEP_GAIN * model.stable_step), np.array([0.5 * size[0], 0.5 * size[1], size[2]])


def _even_mass(model: OrganModel, law: ContactLaw, top: FloatArray, setting: PressSetting) -> OrganModel:
    """The block with mass added to nodes in reach of the ball, for contact without a shorter step.

    Mass has no influence on a static press.
    """
    distance = np.linalg.norm(model.node_rest_position - top, axis=1)
    near = distance < 1.6 * setting.ball_radius
    contact = np.where(near, law.stiffness * contact_node_area(model), 0.0)
    mass = model.node_mass + 0.5 * contact * model.stable_step**2
    inverse = np.where(model.node_inverse_mass > 0.0, 1.0 / mass, 0.0)
    reachable = near[model.surface_triangles].all(axis=1)
    triangles = np.ascontiguousarray(model.surface_triangles[reachable])
    areas = np.ascontiguousarray(model.surface_rest_area[reachable])
    for array in (mass, inverse, triangles, areas):
        array.setflags(write=False)
    return model._replace(
        node_mass=mass, node_inverse_mass=inverse, surface_triangles=triangles, surface_rest_area=areas
    )
