"""Contents of a scene file as frozen dataclasses, in SI units; comments in the files give sources."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from msdm_core.arithmetic import cos, matmul, norm, sin
from msdm_core.kernels.structure_kernels import ContactLaw
from msdm_core.material.regions import Capsule, Damping, Lesion, Material
from msdm_core.material.stiffness import check_stiffness_rule
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.motion import Motion
from msdm_core.organ.support import Support

Vector = tuple[float, float, float]
Range = tuple[float, float]

# Share of an organ's length that counts as its end, the centre of a motion.
END_SHARE = 0.05


def require_number(entry: str, value: float, least: float, unit: str, *, above: bool = False) -> None:
    """Raise a ValueError unless an entry is finite and at least (or above) a bound."""
    if not (math.isfinite(value) and (value > least if above else value >= least)):
        rule = f"above {least:g}" if above else f"at least {least:g}"
        raise ValueError(f"{entry} is {value:g} {unit}".rstrip() + f"; it must be finite and {rule}")


def require_direction(entry: str, values: Vector) -> None:
    """Raise a ValueError unless a direction and its square are finite and not zero."""
    if not 1e-100 <= math.hypot(*values) <= 1e100:
        raise ValueError(f"{entry} is {values}; it must be a direction such as [0, 0, -1]")


def _require_range(entry: str, bounds: Range) -> None:
    low, high = bounds
    if not 0.0 < low <= high < math.inf:
        raise ValueError(f"{entry} = [{low:g}, {high:g}]; the rule is 0 < low <= high, finite")


@dataclass(frozen=True)
class BlockMesh:
    """A block on a cubic lattice (`box_mesh`): size [m], and cells along x, y, z.

    Without top_nodes the squares of its top face z = size[2] have no node in their middle.
    """

    size: Vector
    cells: tuple[int, int, int]
    top_nodes: bool = True


@dataclass(frozen=True)
class SurfaceMesh:
    """A closed surface file (STL, OBJ, PLY), filled with cells of the given edge [m].

    With a coarse_cell_size of 2 or 4 times that, only cells within fine_depth [m] of the palpable face keep it.
    """

    file: str
    length_unit: str | float
    cell_size: float
    coarse_cell_size: float | None = None
    fine_depth: float = 0.0


@dataclass(frozen=True)
class TetFile:
    """A file of tets (vtu, vtk, gmsh, medit) and its length unit."""

    file: str
    length_unit: str | float


@dataclass(frozen=True)
class FineSurface:
    """A closed surface file (STL, OBJ, PLY) and its length unit, in the axes of the tets."""

    file: str
    length_unit: str | float


@dataclass(frozen=True)
class MeshSource:
    """Source of the organ's tets: exactly one of block, surface, tets.

    Pictures and the live page draw the fine_surface, moving with the tets; without one the tets' boundary, smoothed. It
    changes no force and no contact.
    """

    block: BlockMesh | None = None
    surface: SurfaceMesh | None = None
    tets: TetFile | None = None
    fine_surface: FineSurface | None = None

    def __post_init__(self) -> None:
        if sum(part is not None for part in (self.block, self.surface, self.tets)) != 1:
            raise ValueError("mesh: give exactly one of mesh.block, mesh.surface, mesh.tets")


@dataclass(frozen=True)
class Box:
    """An axis-aligned box: lower and upper corner [m]."""

    lower: Vector
    upper: Vector


@dataclass(frozen=True)
class Ball:
    """A ball: centre [m] and radius [m]."""

    centre: Vector
    radius: float


@dataclass(frozen=True)
class Side:
    """Surface with outward normals less than an angle from a direction; 90 degrees: all of it facing that way."""

    direction: Vector
    angle_deg: float = 90.0

    def __post_init__(self) -> None:
        require_direction("side: direction", self.direction)
        if not 0.0 < self.angle_deg <= 180.0:
            raise ValueError(f"side: angle_deg is {self.angle_deg:g}; it must be above 0 and at most 180")


@dataclass(frozen=True)
class Anchor:
    """Support of the organ at a place, by fixed nodes or by elastic tissue around it.

    Without a stiffness all surface nodes inside are fixed; inside a box, all nodes. With one the surface nodes inside
    lie on springs to the ground, distributed over the area, as on fat or a ligament (`msdm_core.organ.foundation`).

    Args:
        name: of the tissue.
        box, ball, side: the place; exactly one of them.
        stiffness: pressure per displacement along the normal, about E / h of a layer h thick [N/m^3]; None: fixed.
        shear_stiffness: traction per displacement along the surface, about G / h [N/m^3]; given with `stiffness`.
    """

    name: str
    box: Box | None = None
    ball: Ball | None = None
    side: Side | None = None
    stiffness: float | None = None
    shear_stiffness: float | None = None

    def __post_init__(self) -> None:
        owner = f"anchor {self.name!r}"
        if sum(part is not None for part in (self.box, self.ball, self.side)) != 1:
            raise ValueError(f"{owner}: give one of a box, a ball and a side")
        if (self.stiffness is None) != (self.shear_stiffness is None):
            raise ValueError(
                f"{owner}: stiffness and shear_stiffness go together; both for elastic tissue, none for fixed nodes"
            )
        if self.stiffness is not None and self.shear_stiffness is not None:
            require_number(f"{owner}: stiffness", self.stiffness, 0.0, "N/m^3", above=True)
            require_number(f"{owner}: shear_stiffness", self.shear_stiffness, 0.0, "N/m^3")

    @property
    def is_elastic(self) -> bool:
        """True if springs hold the organ in place of fixed nodes."""
        return self.stiffness is not None


@dataclass(frozen=True)
class LibraryMaterial:
    """Material of the library (`load.list_materials`) or of a file of the same form.

    Args:
        name: stem of its file.
        description: one line.
        material: its law and density.
        source: publication or measurement of the numbers.
        condition: specimen, its state and the test.
        interval: spread of the numbers.
    """

    name: str
    material: Material
    description: str = ""
    source: str = "not stated"
    condition: str = "not stated"
    interval: str = "not stated"


@dataclass(frozen=True)
class TissueRegion:
    """Region of the mesh with a material of its own.

    Args:
        name: of the region in the mesh file.
        material: of its tets.
        lesion: True for a demonstration lesion, a target of palpation: healthy organs (pre-operative models, episodes
            with a lesion of their own) do not have it. All organs have other regions.
    """

    name: str
    material: Material
    lesion: bool = False

    @property
    def as_lesion(self) -> Lesion:
        """Region in the form of `compile_organ`."""
        return Lesion(region=self.name, material=self.material, name=self.name)


@dataclass(frozen=True)
class Contact:
    """Contact between tissue and instrument, with the law of msdm_core.kernels.structure_kernels.ContactLaw.

    Args:
        stiffness: pressure per penetration [N/m^3].
        damping: pressure per closing speed [N s/m^3].
        friction: Coulomb coefficient.
    """

    stiffness: float
    damping: float
    friction: float

    def __post_init__(self) -> None:
        require_number("contact.stiffness", self.stiffness, 0.0, "N/m^3", above=True)
        require_number("contact.damping", self.damping, 0.0, "N s/m^3")
        require_number("contact.friction", self.friction, 0.0, "")

    @property
    def law(self) -> ContactLaw:
        """Contact law for the kernels; sticking friction is half as stiff as the normal direction."""
        return ContactLaw(self.stiffness, self.damping, self.friction, 0.5 * self.stiffness)


# Instruments on slides; their models are NAME.xml in scenes/instruments.
CARTESIAN = ("probe", "grasper")
# A probe with a patch of taxels: the scene's, or that of the defaults.
TACTILE_PROBE = "tactile_probe"
# Default pitch of taxels over the tip's radius: four span a press on a face tilted by up to 30 degrees.
PITCH_SHARE = 0.6
TAXELS_MOST = 64
# Instruments of two arms, left and right; for other pairs "LEFT+RIGHT", see `load.pair_names`.
PAIRS = {"psm_pair": ("psm_retractor", "psm_palpator")}


@dataclass(frozen=True)
class Taxels:
    """Patch of taxels, rows x columns square cells of force sensing, on a ball's cap, a flat palpator or a jaw's pads.

    Reading of a taxel: its force on three axes, (1 - c) f + c times the mean of the four neighbours, at the border a
    taxel's own for a missing one, + drift x time + noise, clipped at +-range and flagged.

    Args:
        rows, columns: of a patch.
        pitch: distance between neighbours [m]; by default PITCH_SHARE of the tip's radius.
        noise: standard deviation of each reading on each axis [N].
        drift: largest rate of a taxel's bias [N/s]; each episode draws them uniformly from [-drift, drift].
        cross_talk: c, the share of the neighbours, below 1.
        range: largest reading on each axis [N].
    """

    rows: int = 4
    columns: int = 4
    pitch: float | None = None
    noise: float = 0.001
    drift: float = 0.0
    cross_talk: float = 0.0
    range: float = 5.0

    def __post_init__(self) -> None:
        for name in ("rows", "columns"):
            if not 1 <= getattr(self, name) <= TAXELS_MOST:
                raise ValueError(f"taxels.{name} is {getattr(self, name)}; it must be from 1 to {TAXELS_MOST}")
        if self.pitch is not None:
            require_number("taxels.pitch", self.pitch, 0.0, "m", above=True)
        require_number("taxels.noise", self.noise, 0.0, "N")
        require_number("taxels.drift", self.drift, 0.0, "N/s")
        require_number("taxels.range", self.range, 0.0, "N", above=True)
        if not 0.0 <= self.cross_talk < 1.0:
            raise ValueError(f"taxels.cross_talk is {self.cross_talk:g}; it must be at least 0 and below 1")


@dataclass(frozen=True)
class SceneInstrument:
    """Instrument of a scene, and its direction of approach.

    Args:
        model: MJCF file of a probe or grasper in scenes/instruments, a shipped arm's name, the path of an arm's TOML
            file, or a pair of arms: one of PAIRS, or two as "LEFT+RIGHT".
        tip_radius: of the ball tip [m].
        approach: direction of its motion to the organ, and of its shaft.
        tip_direction: direction of a grasper's jaw and an arm's tip; by default the approach.
        taxels: on the tip or the jaw's pads; of an arm those of its own file.
        joint_errors: True for the errors of joints that an arm's own file states, False for exact joints.
    """

    model: str = "probe.xml"
    tip_radius: float = 0.008
    approach: Vector = (0.0, 0.0, -1.0)
    tip_direction: Vector | None = None
    taxels: Taxels | None = None
    joint_errors: bool = False

    def __post_init__(self) -> None:
        require_number("instrument.tip_radius", self.tip_radius, 0.0, "m", above=True)
        for name in ("approach", "tip_direction"):
            value = getattr(self, name)
            if value is not None:
                require_direction(f"instrument.{name}", value)


@dataclass(frozen=True)
class YieldingWall:
    """Body wall that holds a trocar by springs and dampers, and lets the shaft slide with friction; values chosen.

    Args:
        stiffness_across: across the port's axis [N/m].
        stiffness_along: along it [N/m].
        damping: in each direction [N s/m].
        friction: of the shaft in the trocar [N].
        mass: of wall and trocar that move [kg].
    """

    stiffness_across: float = 1000.0
    stiffness_along: float = 500.0
    damping: float = 10.0
    friction: float = 0.5
    mass: float = 0.05

    def __post_init__(self) -> None:
        for name, unit in (("stiffness_across", "N/m"), ("stiffness_along", "N/m"), ("mass", "kg")):
            require_number(f"wall.{name}", getattr(self, name), 0.0, unit, above=True)
        for name, unit in (("damping", "N s/m"), ("friction", "N")):
            require_number(f"wall.{name}", getattr(self, name), 0.0, unit)


@dataclass(frozen=True)
class Port:
    """Frame of a port: its origin is the trocar, its -z points into the body.

    Args:
        point: the trocar [m], world frame.
        into: direction into the body, any length.
        roll: rotation of the frame about its z axis [rad]; at 0, x is as close to world x (else y) as possible.
        wall: that yields to the shaft; by default the trocar is a point that bears no force.
    """

    point: Vector = (0.0, 0.0, 0.0)
    into: Vector = (0.0, 0.0, -1.0)
    roll: float = 0.0
    wall: YieldingWall | None = None

    def __post_init__(self) -> None:
        if not np.isfinite([*self.point, *self.into, self.roll]).all() or not math.hypot(*self.into) > 0.0:
            raise ValueError(
                f"port at {self.point} into {self.into}, roll {self.roll}: every number must be finite, and `into` a "
                "direction such as [0, 0, -1]"
            )

    @property
    def rotation(self) -> FloatArray:
        """Axes of the port's frame as columns, world frame, (3, 3)."""
        return frame_into(np.array(self.into), self.roll)


def frame_into(into: FloatArray, roll: float = 0.0) -> FloatArray:
    """Right-handed frame with -z along a direction and x near world x (else y), turned by roll [rad], (3, 3)."""
    z = -into / norm(into)
    near = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = near - matmul(near, z) * z
    x /= norm(x)
    y = np.cross(z, x)
    c, s = float(cos(roll)), float(sin(roll))
    return np.stack([c * x + s * y, c * y - s * x, z], axis=1)


# Largest substep over the stable step of the organ at rest; a pressed organ is stiffer and needs the margin. With added
# mass, many nodes are at the limit, also under the tip: on a kidney a press turned tets inside out at 0.9.
STABLE_STEP_SHARE, SCALED_STEP_SHARE = 0.9, 0.75


def scaled_step(haptic_step: float, substep_count: int) -> float:
    """Stable step [s] aimed at by mass scaling for a number of substeps of a haptic step."""
    return haptic_step / (SCALED_STEP_SHARE * substep_count)


def substeps_needed(haptic_step: float, stable_step: float) -> int:
    """Fewest organ substeps of a haptic step, each at most STABLE_STEP_SHARE of the stable step."""
    return math.ceil(haptic_step / (STABLE_STEP_SHARE * stable_step))


@dataclass(frozen=True)
class Timing:
    """Time steps: haptic_step [s], organ substeps per haptic step, haptic steps per control step.

    With mass_scaling, mass is added to nodes in need of more substeps (`msdm_core.organ.stability`).
    """

    haptic_step: float = 0.001
    substep_count: int = 5
    haptic_steps_per_control: int = 50
    mass_scaling: bool = False

    def __post_init__(self) -> None:
        require_number("timing.haptic_step", self.haptic_step, 0.0, "s", above=True)
        require_number("timing.substep_count", self.substep_count, 1, "")
        require_number("timing.haptic_steps_per_control", self.haptic_steps_per_control, 1, "")

    @property
    def control_step(self) -> float:
        """Duration of a control step [s]."""
        return self.haptic_step * self.haptic_steps_per_control

    def with_control_step(self, duration: float) -> "Timing":
        """The same with control steps of another duration [s].

        Raises:
            ValueError: a duration of no whole number of haptic steps.
        """
        count = round(duration / self.haptic_step)
        if count < 1 or abs(count * self.haptic_step - duration) > 1e-6 * duration:
            raise ValueError(
                f"control_step is {duration!r} s; it must be a multiple of the haptic step, {self.haptic_step:g} s"
            )
        return replace(self, haptic_steps_per_control=count)


@dataclass(frozen=True)
class Limits:
    """Force limits [N]: more than soft_force costs reward, more than hard_force ends an episode, as does tearing.

    A jaw's pull above tear_force tears the tissue; by default nothing tears. Contact pressure [Pa], principal strain
    (1) or dose of the tissue, the integral of contact pressure over time at a place [Pa s], beyond pressure, strain or
    dose damages it and also ends an episode; inf measures them only, and None, the default, does not measure them.
    """

    soft_force: float
    hard_force: float
    tear_force: float = math.inf
    pressure: float | None = None
    strain: float | None = None
    dose: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.soft_force < self.hard_force:
            raise ValueError(
                f"limits: 0 < soft_force < hard_force must hold; got {self.soft_force}, {self.hard_force} N"
            )
        if not self.tear_force > 0.0:
            raise ValueError(f"limits.tear_force is {self.tear_force:g} N; it must be above 0")
        for name, unit in (("pressure", " Pa"), ("strain", ""), ("dose", " Pa s")):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(
                    f"limits.{name} is {value:g}{unit}; it must be above 0, inf to measure it only, or left out"
                )

    @property
    def judges_tissue(self) -> bool:
        """True if the largest pressure and strain of the tissue are measured in each control step."""
        return any(limit is not None for limit in (self.pressure, self.strain, self.dose))

    def excess(self, force: float) -> float:
        """Force [N] on a scale from the soft limit (0) to the hard limit (1), not clipped."""
        return (force - self.soft_force) / (self.hard_force - self.soft_force)


@dataclass(frozen=True)
class ForceSensor:
    """A force sensor per axis: reading = held force + bias + drift x time + noise, clipped at +-range and flagged.

    Args:
        noise: standard deviation of each reading [N].
        bias: largest bias [N]; each episode draws one uniformly from [-bias, bias].
        range: largest reading [N].
        drift: largest rate of the bias [N/s]; each episode draws one uniformly from [-drift, drift].
        hysteresis: half the width of the loop of a slow cycle [N]: the held force follows the force with a play of
            +-hysteresis (the play operator, Visintin 1994, Differential Models of Hysteresis, III.2).
    """

    noise: float
    bias: float
    range: float
    drift: float = 0.0
    hysteresis: float = 0.0

    def __post_init__(self) -> None:
        for name, unit in (("drift", "N/s"), ("hysteresis", "N"), ("noise", "N"), ("bias", "N")):
            require_number(f"sensor.{name}", getattr(self, name), 0.0, unit)
        require_number("sensor.range", self.range, 0.0, "N", above=True)


@dataclass(frozen=True)
class PalpationSettings:
    """Settings of palpation.

    Args:
        press_depth: depth of a press along the surface normal [m].
        face_angle_deg: largest angle between the inward normal of a palpable point and the approach [degrees].
        face_margin: least distance of a palpable point from the rim of the palpable face [m].
        thickness_smallest: least thickness of the organ below a palpable point [m].
        site_spacing: of the raster [m].
        clearance: gap between tip and surface before a press [m].
    """

    press_depth: float
    face_angle_deg: float = 35.0
    face_margin: float = 0.0
    thickness_smallest: float = 0.0
    site_spacing: float = 0.010
    clearance: float = 0.001

    def __post_init__(self) -> None:
        require_number("palpation.press_depth", self.press_depth, 0.0, "m", above=True)
        require_number("palpation.site_spacing", self.site_spacing, 0.0, "m", above=True)
        for name in ("face_margin", "thickness_smallest", "clearance"):
            require_number(f"palpation.{name}", getattr(self, name), 0.0, "m")
        if not 0.0 < self.face_angle_deg <= 90.0:
            raise ValueError(f"palpation.face_angle_deg is {self.face_angle_deg}; it must be above 0 and at most 90")


@dataclass(frozen=True)
class LesionDraw:
    """Ranges of an episode's hidden lesion, drawn uniformly below the palpable face.

    Args:
        radius: range of its radius [m].
        cover: range of the distance from its ball to the surface [m].
        modulus_ratio: range of its modulus over the healthy one.
        rim_distance: least distance of its place from the border of the palpable face [m].
    """

    radius: Range
    cover: Range
    modulus_ratio: Range
    rim_distance: float = 0.0

    def __post_init__(self) -> None:
        for name in ("radius", "cover", "modulus_ratio"):
            _require_range(f"lesion.{name}", getattr(self, name))
        require_number("lesion.rim_distance", self.rim_distance, 0.0, "m")


@dataclass(frozen=True)
class FixedLesion:
    """Demonstration lesion below a surface point [m], with cover [m], radius [m] and modulus ratio."""

    name: str
    below: Vector
    radius: float
    cover: float
    modulus_ratio: float


@dataclass(frozen=True)
class Endoscope:
    """Endoscope: position and target of its camera [m], vertical field of view [degrees]."""

    position: Vector
    target: Vector
    fov_deg: float = 60.0

    def __post_init__(self) -> None:
        if not 0.0 < math.dist(self.position, self.target) < math.inf or not 0.0 < self.fov_deg < 180.0:
            raise ValueError(
                f"endoscope: position {self.position}, target {self.target}, fov_deg {self.fov_deg:g}; the rule is two "
                "places that differ and 0 < fov_deg < 180"
            )


@dataclass(frozen=True)
class RetractionCamera:
    """Random displacement of the endoscope in an episode.

    Args:
        shift: radius of the ball of positions, drawn uniformly [m].
        turn_deg: largest rotation of its view about an axis across it [degrees].
    """

    shift: float = 0.0
    turn_deg: float = 0.0


@dataclass(frozen=True)
class Flap:
    """Lifted part of an organ: corners of its box [m]."""

    lower: Vector
    upper: Vector


@dataclass(frozen=True)
class Retraction:
    """Ranges of a retraction's episodes: the lobe, the hidden target, the tip's start.

    The lobe is a block with x along its anchored edge, y from that edge (y = 0) to the free one, and z up; it lies on a
    bed below z = 0. An organ of another shape has a `flap` like that, and its scale and held share are 1.

    Args:
        target_distance: range of the target's distance from the anchored edge, along y [m].
        target_along: range of its position along the edge, x [m].
        start_lower, start_upper: corners of the box of the tip's starts [m].
        target_radius: of the disc to be exposed [m].
        scale: range of the factor on the lobe's lengths, thickness included (cells stay cubic).
        youngs_modulus: range [Pa].
        capsule_share: share of episodes with a capsule on the lobe.
        capsule_stiffness: range of that capsule's modulus times thickness [N/m].
        held_share: range of the held share of the anchored edge, about its middle.
        camera: displacement of the endoscope.
        right_start_lower, right_start_upper: the same for the right one of two tips [m].
        flap: the lifted part of the organ; None: all of it.
    """

    target_distance: Range
    target_along: Range
    start_lower: Vector
    start_upper: Vector
    target_radius: float = 0.008
    scale: Range = (1.0, 1.0)
    youngs_modulus: Range = (5000.0, 5000.0)
    capsule_share: float = 0.0
    capsule_stiffness: Range = (1.0, 1.0)
    held_share: Range = (1.0, 1.0)
    camera: RetractionCamera = RetractionCamera()
    right_start_lower: Vector | None = None
    right_start_upper: Vector | None = None
    flap: Flap | None = None

    def __post_init__(self) -> None:
        for name in ("target_distance", "target_along", "scale", "youngs_modulus", "capsule_stiffness", "held_share"):
            _require_range(f"retract.{name}", getattr(self, name))
        if self.held_share[1] > 1.0:
            raise ValueError(f"retract.held_share = {list(self.held_share)}; no more than 1 can be held")
        if self.flap is not None and (self.scale != (1.0, 1.0) or self.held_share != (1.0, 1.0)):
            raise ValueError(
                f"retract: scale {list(self.scale)} and held_share {list(self.held_share)} go with a whole lobe; with "
                "retract.flap both are [1, 1]"
            )
        require_number("retract.target_radius", self.target_radius, 0.0, "m", above=True)
        if not 0.0 <= self.capsule_share <= 1.0:
            raise ValueError(f"retract.capsule_share is {self.capsule_share:g}; it must be from 0 to 1")


@dataclass(frozen=True)
class CyclicMotion:
    """Repeated motion of anchors, foundations and supports, drawn anew for each episode.

    Args:
        name: as "breathing".
        displacement: of the ground at the top of a cycle of size 1 [m].
        period: range of the mean duration of a cycle [s].
        rise, fall: shares of a cycle for the motion there and back; the ground rests in the remainder.
        size: range of the factor on the displacement.
        variation: standard deviation of the durations and sizes of cycles, as a share of their mean.
        centre: of the moving part of the ground [m]; None: all of it moves alike.
        reach: radius of the moving part about the centre [m].
        side: in place of `centre`: the direction of the organ's end at the centre.
        stops_in_apnoea: True if it rests while the breath is held.
    """

    name: str
    displacement: Vector
    period: Range
    rise: float
    fall: float
    size: Range = (1.0, 1.0)
    variation: float = 0.0
    centre: Vector | None = None
    reach: float = math.inf
    side: Vector | None = None
    stops_in_apnoea: bool = False

    def __post_init__(self) -> None:
        if not 0.0 < self.period[0] <= self.period[1] < math.inf:
            raise ValueError(f"motion {self.name!r}: period is {self.period} s; the rule is 0 < low <= high")
        if not 0.0 <= self.size[0] <= self.size[1] < math.inf:
            raise ValueError(f"motion {self.name!r}: size is {self.size}; the rule is 0 <= low <= high")
        if not (self.rise > 0.0 and self.fall > 0.0 and self.rise + self.fall <= 1.0):
            raise ValueError(
                f"motion {self.name!r}: rise is {self.rise:g}, fall {self.fall:g}; both are shares of a cycle above 0, "
                "together at most 1"
            )
        if not 0.0 <= self.variation <= 0.3:
            raise ValueError(f"motion {self.name!r}: variation is {self.variation:g}; it must be from 0 to 0.3")
        if self.side is not None:
            require_direction(f"motion {self.name!r}: side", self.side)
            if self.centre is not None:
                raise ValueError(f"motion {self.name!r}: give a side or a centre, not both")
        # Checks displacement, centre and reach.
        Motion(self.name, self.displacement, self.side or self.centre, self.reach)

    def ground(self, points: FloatArray) -> Motion:
        """Motion of the ground by a unit of the signal, for an organ with resting nodes [m] (n_node, 3)."""
        if self.side is None:
            return Motion(self.name, self.displacement, self.centre, self.reach)
        along = matmul(points, np.array(self.side) / norm(self.side))
        x, y, z = points[along >= along.max() - END_SHARE * np.ptp(along)].mean(axis=0).tolist()
        return Motion(self.name, self.displacement, (x, y, z), self.reach)


# The parts of a family: for training, selection and evaluation of an agent.
SPLITS = ("train", "validation", "test")
# The factors on lengths of a family lie within this range.
FACTOR_LEAST, FACTOR_MOST = 0.5, 2.0


@dataclass(frozen=True)
class Family:
    """Ranges of smooth random deformations of a scene's organ into a family of organs.

    The organ is stretched, its outline changed, bumped and bent (`surgsim_env.scene.family`), in the directions along
    and across its instrument's approach. In the scene's file, a `template` beside these entries names the file of
    another scene: its entries hold unless this file has its own.

    A member is drawn again if it folds, if its cells become too poor, or if it leaves a box `longest` times as large as
    the template's.

    Args:
        size: range of the factor on all lengths.
        aspect: range of the stretches along the three directions, normalised to keep the volume.
        thickness: range of the factor along the approach.
        curvature: largest curvature of the bend towards or against the approach [1/m].
        edge: largest change of the outline seen along the approach, as a share of the distance from its middle.
        bump_count: number of bumps and dents.
        bump_height: their largest height or depth [m].
        bump_width: range of their standard deviation [m].
        quality_share: least radius ratio of each tet over that of the same tet of the template.
        train, validation, test: number of members of each split.
        entropy: of the random numbers; another value gives other members.
    """

    size: Range = (1.0, 1.0)
    aspect: Range = (1.0, 1.0)
    thickness: Range = (1.0, 1.0)
    curvature: float = 0.0
    edge: float = 0.0
    bump_count: int = 0
    bump_height: float = 0.0
    bump_width: Range = (0.03, 0.03)
    quality_share: float = 0.5
    train: int = 64
    validation: int = 16
    test: int = 16
    entropy: int = 0

    def __post_init__(self) -> None:
        for name in ("size", "aspect", "thickness"):
            low, high = getattr(self, name)
            if not FACTOR_LEAST <= low <= high <= FACTOR_MOST:
                rule = f"{FACTOR_LEAST:g} <= low <= high <= {FACTOR_MOST:g}"
                raise ValueError(f"family.{name} = [{low:g}, {high:g}]; the rule is {rule}")
        _require_range("family.bump_width", self.bump_width)
        require_number("family.curvature", self.curvature, 0.0, "1/m")
        require_number("family.edge", self.edge, 0.0, "")
        require_number("family.bump_height", self.bump_height, 0.0, "m")
        require_number("family.quality_share", self.quality_share, 0.0, "", above=True)
        for name in SPLITS:
            require_number(f"family.{name}", getattr(self, name), 1, "members")

    @property
    def longest(self) -> float:
        """Factor on the sides of the template's box for the box of all members."""
        return self.size[1] * max(self.aspect[1], self.thickness[1])

    def member_count(self, split: str) -> int:
        """Number of members of a split, one of SPLITS."""
        return getattr(self, split)


@dataclass(frozen=True)
class Scene:
    """A scene.

    Args:
        name: stem of its file.
        description: one line.
        folder: of its file; paths in the file are relative to it.
        mesh: source of the organ's tets.
        material: of the healthy tissue.
        damping: of the organ.
        anchors: supports of the organ by fixed nodes or elastic tissue.
        contact: between tissue and instruments.
        instrument: the tool, its tip and its approach.
        timing: of haptic and control steps.
        limits: of forces.
        sensor: of forces on the tool.
        palpation: of the palpable face and presses on it.
        lesion: ranges of an episode's hidden lesion.
        retract: ranges of a retraction's episodes.
        capsule: on the organ's boundary.
        demonstration: lesions of the scene file.
        stiffness_rule: of the springs, "lloyd" or "fitted" (`msdm_core.material.stiffness.spring_network`).
        port: of an arm; None: that of `instruments.arm.arm_instrument.default_port`.
        ports: those of two arms, the left one's first.
        endoscope: camera of retractions.
        gravity: [m/s^2]; the organ is settled under it onto anchors and supports.
        supports: solids below the organ, with the contact law of `contact`.
        regions: of the mesh, with materials of their own.
        retract_scene: file of this organ's retraction scene.
        retract_refusal: reason against retracting this organ.
        motions: of anchors, foundations and supports, in each episode.
        cranial: direction of the patient's head.
        family: makes the organ the template of many; None: it is one organ.
    """

    name: str
    description: str
    folder: Path
    mesh: MeshSource
    material: Material
    damping: Damping
    anchors: tuple[Anchor, ...]
    contact: Contact
    instrument: SceneInstrument
    timing: Timing
    limits: Limits
    sensor: ForceSensor
    palpation: PalpationSettings
    lesion: LesionDraw | None = None
    retract: Retraction | None = None
    capsule: Capsule | None = None
    demonstration: tuple[FixedLesion, ...] = field(default=())
    stiffness_rule: str = "lloyd"
    port: Port | None = None
    ports: tuple[Port, ...] = ()
    endoscope: Endoscope | None = None
    gravity: Vector = (0.0, 0.0, 0.0)
    supports: tuple[Support, ...] = ()
    regions: tuple[TissueRegion, ...] = ()
    retract_scene: str | None = None
    retract_refusal: str | None = None
    motions: tuple[CyclicMotion, ...] = ()
    cranial: Vector = (1.0, 0.0, 0.0)
    family: Family | None = None

    def __post_init__(self) -> None:
        check_stiffness_rule(self.stiffness_rule)
        require_direction("cranial", self.cranial)

    @property
    def has_breath(self) -> bool:
        """True if a motion rests while the breath is held."""
        return any(motion.stops_in_apnoea for motion in self.motions)
