"""A strip held between the two pads of a jaw: reaction force, stretch, and the load at which it slips."""

from dataclasses import dataclass

import numpy as np

from msdm_core.kernels.structure_kernels import FAULT_NONE, ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.material.regions import Damping, Material
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.stability import stable_dt
from msdm_core.organ.stepping import advance_organ, describe_fault, round_shapes
from surgsim_env.validation.row import Outcome, compare

WIDTH, LENGTH = 0.010, 0.060  # [m]
MODULUS, POISSON, DENSITY = 20e3, 0.45, 1060.0
# Between the pads, and from where to where the strain is measured: a width away from pads and weight [m].
HELD, WEIGHT_HEIGHT = 0.010, 0.005
GAUGE = (0.015, 0.040)
WEIGHT = 0.004  # [kg]
PAD_RADIUS = 0.0015  # [m]
LAW = ContactLaw(stiffness=3e7, damping=100.0, friction=0.2, tangential_stiffness=1.5e7)
# Of the pads, which are rougher than the law.
FRICTION = 0.4
# The load grows in steps of this share until the strip slips: the resolution of the slip load.
LOAD_STEP = 0.02
# A sticking strip moves by less than 2 mm; a strip that slips goes on falling [m].
SLIPPED = 0.002


@dataclass(frozen=True, eq=False)
class HangingStrip:
    """A strip between two pads that close along x; each run has its own gravity.

    Args:
        model, state: of the strip.
        pads: tools 0 and 1.
        dt: of a substep [s].
    """

    model: OrganModel
    state: OrganState
    pads: ContactShapes
    dt: float

    def run(
        self, duration: float, *, gravity: float = 0.0, tilt: float = 0.0, closing: float = 0.0, turning: float = 0.0
    ) -> FloatArray:
        """Advance by a time; returns the last wrenches on the pads [N, N m], shape (2, 6).

        Args:
            duration: [s].
            gravity: pulls along -z [m/s^2].
            tilt: of gravity about x [rad].
            closing: of each pad [m/s].
            turning: of both about x, around their middle [rad/s].

        Raises:
            ValueError: the simulation of the strip ended with a fault.
        """
        pull = -gravity * np.array([0.0, -np.sin(tilt), np.cos(tilt)])
        pull.setflags(write=False)
        model, wrench = self.model._replace(gravity=pull), np.zeros((2, 6))
        self.pads.tool_twist[:] = 0.0
        self.pads.tool_twist[:, 0] = closing, -closing
        self.pads.tool_twist[:, 3] = turning
        if turning:
            arm = self.pads.tool_centre - self.pads.tool_centre.mean(axis=0)
            self.pads.tool_twist[:, :3] += np.cross([turning, 0.0, 0.0], arm)
        for _ in range(round(duration / (5 * self.dt))):
            fault = advance_organ(model, self.state, self.pads, LAW, self.dt, 5, wrench)
            if fault != FAULT_NONE:
                raise ValueError(describe_fault(model, self.state, fault))
        return wrench

    def height(self, level: float) -> float:
        """Mean present position of the nodes that rest at a level [m]."""
        nodes = np.abs(self.model.node_rest_position[:, 2] - level) < 1e-6
        return float(self.state.node_position[nodes, 2].mean())

    @property
    def gauge_length(self) -> float:
        """Present distance of the two levels of GAUGE [m]."""
        return self.height(GAUGE[1]) - self.height(GAUGE[0])

    def carried(self, gravity: float) -> float:
        """Weight below, averaged over the gauge's levels: the tension that stretches it [N]."""
        rest = self.model.node_rest_position[:, 2]
        return gravity * float(
            np.mean([self.model.node_mass[rest < level].sum() for level in np.linspace(*GAUGE, 101)])
        )


def grip(wrench: FloatArray) -> float:
    """Mean of the normal forces on both pads [N]."""
    return float(0.5 * (wrench[1, 0] - wrench[0, 0]))


def gripped_strip(friction: float = FRICTION) -> HangingStrip:
    """A strip 10 x 10 x 60 mm, its lowest 5 mm heavier by 4 g, gripped with 0.33 N without gravity, at rest."""
    box = box_mesh((WIDTH, WIDTH, LENGTH), (4, 4, 24))
    low = box.points[box.tets].mean(axis=1)[:, 2] < WEIGHT_HEIGHT
    mesh = TetMesh(box.points, box.tets, np.where(low, 1, 0), {0: "strip", 1: "weight"})
    heavy = Material(MODULUS, DENSITY + WEIGHT / (WIDTH * WIDTH * WEIGHT_HEIGHT), POISSON)
    materials = {"strip": Material(MODULUS, DENSITY, POISSON), "weight": heavy}
    model = compile_organ(OrganSpec(mesh=mesh, materials=materials, damping=Damping(alpha=40.0)))
    middle, half = LENGTH - 0.5 * HELD, 0.5 * HELD
    reach = (-0.001 + PAD_RADIUS, WIDTH + 0.001 - PAD_RADIUS)
    ends = [[[x, y, middle] for y in reach] for x in (-PAD_RADIUS, WIDTH + PAD_RADIUS)]
    span = [[0.0, 0.0, half - PAD_RADIUS]] * 2
    pads = round_shapes(ends, [PAD_RADIUS] * 2, span=span, friction=friction / LAW.friction, tool=[0, 1])
    strip = HangingStrip(model, rest_state(model, shape_count=2), pads, 0.9 * stable_dt(model, LAW))
    strip.run(0.2, closing=0.004)
    strip.run(0.3)
    return strip


def slip(strip: HangingStrip, gravity: float) -> tuple[float, float]:
    """Largest load that the jaw held and the grip at that load [N], starting from a gravity [m/s^2].

    Raises:
        ValueError: the strip never slipped.
    """
    mass = float(strip.model.node_mass.sum())
    held = strip.run(0.6, gravity=gravity)
    hung = strip.height(LENGTH)
    for _ in range(40):
        wrench = strip.run(0.1, gravity=gravity * (1.0 + LOAD_STEP))
        if strip.height(LENGTH) < hung - SLIPPED:
            return gravity * mass, grip(held)
        gravity, held = gravity * (1.0 + LOAD_STEP), wrench
    raise ValueError(f"the strip never slipped, up to {gravity * mass:.3f} N")


def grasped_strip(gravity: float = 8.5) -> Outcome:
    """Hung on its jaw: reaction against weight, strain against F / (E A), and the load at which it slips."""
    strip = gripped_strip()
    resting = strip.gauge_length
    wrench = strip.run(0.6, gravity=gravity)
    weight = gravity * float(strip.model.node_mass.sum())
    note = f"10 x 10 x 60 mm, cell 2.5 mm, two pads of 10 mm, grip {grip(wrench):.2f} N each"
    reaction = compare(
        "grasped strip, force on the jaw", "statics: the weight", expected=weight, measured=-float(wrench[:, 2].sum()),
        tolerance=0.001, unit="N", note=note,
    )  # fmt: skip
    strain = compare(
        "grasped strip, strain", "Hooke: F / (E A)", expected=strip.carried(gravity) / (MODULUS * WIDTH**2),
        measured=strip.gauge_length / resting - 1.0, tolerance=0.10,
        note="between levels a width away from pads and weight; formula (6) is some 7 % too stiff near the faces of "
        "so thin a lattice (row \"bar in tension\"), small strains in the reference",
    )  # fmt: skip
    load, held = slip(gripped_strip(), 12.0)
    slipping = compare(
        "grasped strip, load at which it slips", "Coulomb: 2 mu N", expected=2.0 * FRICTION * held, measured=load,
        tolerance=0.05, unit="N",
        note=f"mu {FRICTION:g}, N the grip as it is then; the load grows by {100.0 * LOAD_STEP:g} % at a time",
    )  # fmt: skip
    return Outcome((reaction, strain, slipping))
