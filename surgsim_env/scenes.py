"""Scenes: one TOML file each, read into frozen dataclasses. All values SI; the file's comments give their sources."""

import math
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from msdm_core.damping import Damping
from msdm_core.kernels import ContactLaw
from msdm_core.regions import Capsule, Material
from msdm_core.stiffness import check_stiffness_rule
from msdm_core.support import Support, SupportLaw
from surgsim_env.anchors import Anchor, Ball, Bed, Box
from surgsim_env.arms.description import list_arms
from surgsim_env.arms.port import Port
from surgsim_env.retraction import Flap, Retraction, RetractionCamera
from surgsim_env.scene_files import scenes_folder
from surgsim_env.tissue_region import TissueRegion
from surgsim_env.toml_tables import fill, nearest, read_toml

# Instruments carried by slides; their models are NAME.xml in scenes/instruments.
CARTESIAN = ("probe", "grasper")
# Instruments of two arms: what stands left and right. Any two arms are a pair as "LEFT+RIGHT", see `pair_names`.
PAIRS = {"psm_pair": ("psm_retractor", "psm_palpator")}

Vector = tuple[float, float, float]
Range = tuple[float, float]


@dataclass(frozen=True)
class BlockMesh:
    """A block on a cubic lattice: size [m], cells along x, y, z, and how it coarsens from the top down: `box_mesh`."""

    size: Vector
    cells: tuple[int, int, int]
    coarsening: int = 1
    fine_depth: float | None = None


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
class MeshSource:
    """Where the organ's tets come from: exactly one of block, surface, tets."""

    block: BlockMesh | None = None
    surface: SurfaceMesh | None = None
    tets: TetFile | None = None

    def __post_init__(self) -> None:
        if sum(part is not None for part in (self.block, self.surface, self.tets)) != 1:
            raise ValueError("mesh: give exactly one of mesh.block, mesh.surface, mesh.tets")


@dataclass(frozen=True)
class Instrument:
    """The instrument that touches the organ.

    Args:
        model: MJCF file of a probe or grasper in scenes/instruments, a shipped arm's name, the path of an arm's TOML
            file, or a pair of arms: one of PAIRS, or two as "LEFT+RIGHT".
        tip_radius: of the ball tip [m].
        approach: direction in which it comes to the organ; the shaft lies along it.
        tip_direction: where a grasper's jaw and an arm's tip point; along the approach if it is not given.
    """

    model: str = "probe.xml"
    tip_radius: float = 0.008
    approach: Vector = (0.0, 0.0, -1.0)
    tip_direction: Vector | None = None

    def __post_init__(self) -> None:
        _require("instrument.tip_radius", self.tip_radius, 0.0, "m", above=True)
        for name in ("approach", "tip_direction"):
            value = getattr(self, name)
            if value is not None and not 0.0 < math.hypot(*value) < math.inf:
                raise ValueError(f"instrument.{name} is {value}; it must be a direction such as [0, 0, -1]")


@dataclass(frozen=True)
class Timing:
    """Rates: haptic_step [s], organ substeps in one, haptic steps in one control step.

    With mass_scaling, nodes that would need more substeps get some mass (`msdm_core.mass_scaling`).
    """

    haptic_step: float = 0.001
    substep_count: int = 5
    haptic_steps_per_control: int = 50
    mass_scaling: bool = False

    def __post_init__(self) -> None:
        _require("timing.haptic_step", self.haptic_step, 0.0, "s", above=True)
        _require("timing.substep_count", self.substep_count, 1, "")
        _require("timing.haptic_steps_per_control", self.haptic_steps_per_control, 1, "")

    @property
    def control_step(self) -> float:
        """Duration of a control step [s]."""
        return self.haptic_step * self.haptic_steps_per_control


@dataclass(frozen=True)
class Limits:
    """Forces on the tissue [N]: above soft_force costs reward, above hard_force ends an episode; so does tearing.

    tear_force is what a jaw may pull; without one nothing tears.
    """

    soft_force: float
    hard_force: float
    tear_force: float = math.inf

    def __post_init__(self) -> None:
        if not 0.0 < self.soft_force < self.hard_force:
            raise ValueError(
                f"limits: 0 < soft_force < hard_force must hold; got {self.soft_force}, {self.hard_force} N"
            )
        if not self.tear_force > 0.0:
            raise ValueError(f"limits.tear_force is {self.tear_force:g} N; it must be above 0")

    def excess(self, force: float) -> float:
        """How far a force [N] is on its way from the soft limit (0) to the hard one (1); below 0 and above 1 beyond."""
        return (force - self.soft_force) / (self.hard_force - self.soft_force)


@dataclass(frozen=True)
class ForceSensor:
    """A force sensor per axis: reading = force + bias + noise, cut at +-range (and flagged).

    Args:
        noise: standard deviation of each reading [N].
        bias: the bias of an episode is drawn uniformly from +- this [N].
        range: largest reading [N].
    """

    noise: float
    bias: float
    range: float

    def __post_init__(self) -> None:
        _require("sensor.noise", self.noise, 0.0, "N")
        _require("sensor.bias", self.bias, 0.0, "N")
        _require("sensor.range", self.range, 0.0, "N", above=True)


@dataclass(frozen=True)
class Palpation:
    """How the organ is palpated.

    Args:
        press_depth: how deep the tip is pressed along the surface normal [m].
        face_angle_deg: a surface point is palpable where its inward normal is within this of the approach direction.
        face_margin: distance a palpable point keeps from the rim of the palpable face [m].
        thickness_smallest: a palpable point has at least this much organ below it [m].
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
        _require("palpation.press_depth", self.press_depth, 0.0, "m", above=True)
        _require("palpation.site_spacing", self.site_spacing, 0.0, "m", above=True)
        for name in ("face_margin", "thickness_smallest", "clearance"):
            _require(f"palpation.{name}", getattr(self, name), 0.0, "m")
        if not 0.0 < self.face_angle_deg <= 90.0:
            raise ValueError(f"palpation.face_angle_deg is {self.face_angle_deg}; it must be above 0 and at most 90")


@dataclass(frozen=True)
class LesionDraw:
    """The lesion an episode hides, drawn evenly below the palpable face.

    Args:
        radius: range of its radius [m].
        cover: range of the distance from its ball to the surface [m].
        modulus_ratio: range of its modulus over the healthy one.
        rim_distance: distance its place keeps from the border of the palpable face [m].
    """

    radius: Range
    cover: Range
    modulus_ratio: Range
    rim_distance: float = 0.0

    def __post_init__(self) -> None:
        for name in ("radius", "cover", "modulus_ratio"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high < math.inf:
                raise ValueError(f"lesion: {name} = [{low}, {high}]; the rule is 0 < low <= high, finite")
        _require("lesion.rim_distance", self.rim_distance, 0.0, "m")


@dataclass(frozen=True)
class FixedLesion:
    """A lesion of the demonstration: below a surface point [m], with cover [m], radius [m] and modulus ratio."""

    name: str
    below: Vector
    radius: float
    cover: float
    modulus_ratio: float


@dataclass(frozen=True)
class Contact:
    """Contact between tissue and instrument, see msdm_core.kernels.ContactLaw.

    Args:
        stiffness: pressure per penetration [N/m^3].
        damping: pressure per closing speed [N s/m^3].
        friction: Coulomb coefficient.
    """

    stiffness: float
    damping: float
    friction: float

    def __post_init__(self) -> None:
        _require("contact.stiffness", self.stiffness, 0.0, "N/m^3", above=True)
        _require("contact.damping", self.damping, 0.0, "N s/m^3")
        _require("contact.friction", self.friction, 0.0, "")

    @property
    def law(self) -> ContactLaw:
        """What the kernels read; sticking friction is half as stiff as the normal direction."""
        return ContactLaw(self.stiffness, self.damping, self.friction, 0.5 * self.stiffness)


@dataclass(frozen=True)
class Endoscope:
    """Where the endoscope camera stands and looks [m], and its vertical field of view [degrees]."""

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
class Scene:
    """A whole scene; `name` is the file's stem, `stiffness_rule` one of msdm_core.stiffness.STIFFNESS_RULES.

    The organ is settled under `gravity` [m/s^2] onto its anchors and `supports`, which push as contact does where no
    `support_law` is given. `port` is where an arm enters the body; if it is not given,
    `arms.port_placement.default_port` finds one. `ports` are those of two arms, the left one's first. `regions` of
    the mesh have materials of their own. `retract_scene` names the file of the scene of the same organ that a
    retraction takes, `retract_refusal` says why there is none.
    """

    name: str
    description: str
    folder: Path
    mesh: MeshSource
    material: Material
    damping: Damping
    anchors: tuple[Anchor, ...]
    contact: Contact
    instrument: Instrument
    timing: Timing
    limits: Limits
    sensor: ForceSensor
    palpation: Palpation
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
    support_law: SupportLaw | None = None
    regions: tuple[TissueRegion, ...] = ()
    retract_scene: str | None = None
    retract_refusal: str | None = None

    def __post_init__(self) -> None:
        check_stiffness_rule(self.stiffness_rule)


def _require(what: str, value: float, least: float, unit: str, *, above: bool = False) -> None:
    """ValueError naming an entry that is not finite and at least (or above) a bound."""
    if not (math.isfinite(value) and (value > least if above else value >= least)):
        rule = f"above {least:g}" if above else f"at least {least:g}"
        raise ValueError(f"{what} is {value:g} {unit}".rstrip() + f"; it must be finite and {rule}")


# The tables that a scene file may have.
_TABLES = (
    *(Scene, MeshSource, BlockMesh, SurfaceMesh, TetFile, Material, Capsule, Damping, Anchor, Box, Ball, Bed),
    *(Contact, Instrument, Timing, Limits, ForceSensor, Palpation, LesionDraw, FixedLesion, Endoscope, Port),
    *(Retraction, RetractionCamera, Flap, Support, SupportLaw, TissueRegion),
)


def list_scenes() -> list[str]:
    """Names of the scenes that are shipped."""
    return sorted(path.stem for path in (scenes_folder() / "organs").glob("*.toml"))


def make_scene(name: str | Path) -> Scene:
    """The scene of a name (see `list_scenes`) or of a TOML file's path.

    Raises:
        ValueError: an unknown name (lists the known, suggests the nearest) or a file that breaks the format.
    """
    if not isinstance(name, str | Path):
        raise ValueError(f"scene is {name!r}; it must be a scene's name or the path of a scene file")
    name = str(name)
    if name.endswith(".toml"):
        return load_scene(Path(name))
    known = list_scenes()
    if name not in known:
        close = get_close_matches(name, known, n=1, cutoff=0.4)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"scene {name!r} is unknown; the scenes are {', '.join(known)}{hint}")
    return load_scene(scenes_folder() / "organs" / f"{name}.toml")


def with_instrument(scene: Scene, instrument: str | None) -> Scene:
    """The scene with another instrument: one of CARTESIAN or PAIRS, an arm, its path, two of these; None: its own."""
    if instrument is None:
        return scene
    if not isinstance(instrument, str | Path):
        raise ValueError(f"instrument is {instrument!r}; it must be an instrument's name or the path of a TOML file")
    known = [*CARTESIAN, *list_arms(), *PAIRS]
    if Path(instrument).suffix != ".toml" and instrument not in known and pair_names(str(instrument)) is None:
        raise ValueError(
            f"instrument {str(instrument)!r} is unknown{nearest(str(instrument), known)}; the instruments are "
            f"{', '.join(known)}, the path of an arm's TOML file, or two arms as LEFT+RIGHT"
        )
    model = f"{instrument}.xml" if instrument in CARTESIAN else str(instrument)
    return replace(scene, instrument=replace(scene.instrument, model=model))


def pair_names(model: str) -> tuple[str, str] | None:
    """The left and the right arm of an instrument that is a pair: of PAIRS, or two arms joined by "+"; else None."""
    known = list_arms()
    for place in (place for place, sign in enumerate(model) if sign == "+"):
        left, right = model[:place], model[place + 1 :]
        if all(name in known or Path(name).suffix == ".toml" for name in (left, right)):
            return left, right
    return PAIRS.get(model)


def load_scene(path: Path) -> Scene:
    """Read one scene file; ValueError names the file, the entry and what is wrong with it."""
    return scene_from_table(read_toml(path, "scene"), name=path.stem, folder=path.parent)


def scene_from_table(table: dict[str, Any], *, name: str, folder: Path) -> Scene:
    """A scene from a table such as a TOML file holds; paths in it are relative to `folder`."""
    return fill(Scene, {**table, "name": name, "folder": folder}, f"scene {name!r}", _TABLES)
