"""Description of an arm in a TOML file beside its MJCF or URDF model: contact geoms, tip, trocar, control."""

import math
from dataclasses import dataclass, field
from pathlib import Path

from surgsim_env.scene.load import fill, list_arms, nearest, read_toml, require_known, scenes_folder
from surgsim_env.scene.model import Taxels, Vector, require_direction, require_number

KINDS = ("palpator", "grasper")
CONTROL_MODES = ("position", "servo")


@dataclass(frozen=True)
class Tip:
    """Controlled point of an arm: a site of the model, or a body and an offset in it.

    Args:
        site: a site of the model.
        body: a body of the model, for models without sites, as in URDF.
        offset: of the tip in that body's frame [m].
        direction: of the tip, in the frame of the site or body.
        ball: the geom (a sphere) with a radius set by the scene.
    """

    site: str | None = None
    body: str | None = None
    offset: Vector = (0.0, 0.0, 0.0)
    direction: Vector = (0.0, 0.0, 1.0)
    ball: str | None = None

    def __post_init__(self) -> None:
        if (self.site is None) == (self.body is None):
            raise ValueError("tip: give exactly one of tip.site and tip.body (with tip.offset)")
        require_direction("tip.direction", self.direction)


@dataclass(frozen=True)
class Trocar:
    """Passage of the shaft through the body wall.

    Args:
        shaft_body: the body with the straight shaft.
        shaft_point: a point of the shaft's axis in that body's frame [m].
        shaft_axis: direction of the shaft's axis in that frame, towards the tip.
        point: the trocar in the model's own world frame [m].
        into: direction into the patient in that frame.
        fixed: True if the mechanism holds the shaft there (remote centre of motion), False if control does.
        tolerance: largest distance of the shaft's axis from the trocar [m], at home, or in all poses with `fixed`.
    """

    shaft_body: str
    shaft_point: Vector = (0.0, 0.0, 0.0)
    shaft_axis: Vector = (0.0, 0.0, 1.0)
    point: Vector = (0.0, 0.0, 0.0)
    into: Vector = (0.0, 0.0, -1.0)
    fixed: bool = False
    tolerance: float = 0.001

    def __post_init__(self) -> None:
        require_direction("trocar.into", self.into)
        require_direction("trocar.shaft_axis", self.shaft_axis)
        require_number("trocar.tolerance", self.tolerance, 0.0, "m", above=True)


@dataclass(frozen=True)
class JointControl:
    """Drive of the joints: "position" by the model's own actuators, "servo" by added ones.

    Args:
        mode: "position" or "servo".
        speed_limit: of each joint [rad/s or m/s].
        stiffness: of each added servo [N m/rad or N/m].
        damping: of each added servo [N m s/rad or N s/m].
        effort: largest torque or force of each added servo [N m or N].
        armature: rotor inertia of each joint with an added servo [kg m^2 or kg]; the model's by default.
    """

    mode: str
    speed_limit: tuple[float, ...]
    stiffness: tuple[float, ...] = ()
    damping: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()
    armature: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.mode not in CONTROL_MODES:
            raise ValueError(f"control.mode is {self.mode!r}; it must be one of {', '.join(CONTROL_MODES)}")
        for name in ("stiffness", "damping", "effort"):
            if bool(getattr(self, name)) != (self.mode == "servo"):
                rule = "must be given" if self.mode == "servo" else "must be left out"
                raise ValueError(f"control.{name} {rule} with control.mode = {self.mode!r}")
        if self.armature and self.mode != "servo":
            raise ValueError(f"control.armature must be left out with control.mode = {self.mode!r}")


@dataclass(frozen=True)
class JointErrors:
    """Errors of joints whose encoders sit at the motors, behind cables; one number a joint.

    Args:
        offset: largest constant error [rad or m]; each episode draws one from [-offset, offset].
        play: half the width of the loop of a joint that turns back [rad or m].
        drift: largest rate of the offset [rad/s or m/s], drawn likewise.
    """

    offset: tuple[float, ...]
    play: tuple[float, ...]
    drift: tuple[float, ...]


@dataclass(frozen=True)
class AddedShape:
    """Capsule or ball added to the model: tissue contacts spheres and capsules, not meshes.

    Args:
        name: of the added geom.
        body: the body with the geom.
        start: end of the capsule's axis, or the middle of the ball, in that body's frame [m].
        radius: [m].
        end: the other end of the capsule's axis [m]; none for a ball.
    """

    name: str
    body: str
    start: Vector
    radius: float
    end: Vector | None = None


@dataclass(frozen=True)
class LinkInertia:
    """Mass and moments of inertia of a URDF link, in place of missing or unphysical ones.

    Args:
        link: its name.
        mass: [kg].
        centre: centre of mass in the link's frame [m].
        moments: about the axes of that frame through the centre [kg m^2].
    """

    link: str
    mass: float
    centre: Vector
    moments: Vector


@dataclass(frozen=True)
class ArmDescription:
    """An arm and its instrument.

    Args:
        name: the TOML file's stem.
        folder: of that file; `model` is relative to it.
        model: MJCF or URDF file.
        kind: "palpator" or "grasper".
        joints: the driven joints, from base to tip; joints that follow them by the model's couplings are not named.
        contact: geoms in contact with tissue (spheres and capsules).
        links: other geoms of the arm (spheres and capsules), for clearances only.
        tip, trocar, control: see there.
        home: value of each joint with the shaft in the trocar [rad or m].
        jaw: joints whose sum is the jaw's opening angle; none for a rigid tip.
        limits: least and largest value of joints [rad or m], in place of the model's.
        held: fixed joints and their values [rad or m]; their couplings and actuators are left out.
        shapes: added spheres and capsules.
        inertias: of links of a URDF file, in place of its own.
        dropped_meshes: file names of left out meshes of a URDF, as in the URDF.
        description: one line.
        taxels: on the tip or the jaw's pads; a scene takes them into its `instrument`.
        joint_errors: for scenes with `instrument.joint_errors`; None: the joints are exact there too.
    """

    name: str
    folder: Path
    model: str
    kind: str
    joints: tuple[str, ...]
    contact: tuple[str, ...]
    tip: Tip
    trocar: Trocar
    control: JointControl
    home: dict[str, float]
    links: tuple[str, ...] = ()
    jaw: tuple[str, ...] = ()
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    held: dict[str, float] = field(default_factory=dict)
    shapes: tuple[AddedShape, ...] = ()
    inertias: tuple[LinkInertia, ...] = ()
    dropped_meshes: tuple[str, ...] = ()
    description: str = ""
    taxels: Taxels | None = None
    joint_errors: JointErrors | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind is {self.kind!r}; it must be one of {', '.join(KINDS)}")
        if self.kind == "grasper" and not self.jaw:
            raise ValueError('a grasper needs a jaw: name its joints, such as jaw = ["jaw"]')
        for name in ("joints", "contact"):
            if not getattr(self, name):
                raise ValueError(f"{name} is empty; name at least one")
        _require_distinct("contact and links", (*self.contact, *self.links))
        _require_distinct("joints, jaw and held", (*self.joints, *self.jaw, *self.held))
        self._check_control()
        self._check_home()
        if self.joint_errors is not None:
            for name, values in vars(self.joint_errors).items():
                if len(values) != len(self.joints) or not all(0.0 <= value < math.inf for value in values):
                    raise ValueError(
                        f"joint_errors.{name} is {list(values)} for {len(self.joints)} joints; the rule is a finite "
                        "number from 0 on for each"
                    )

    def _check_control(self) -> None:
        control = self.control
        for name in ("speed_limit", "stiffness", "damping", "effort", "armature"):
            values = getattr(control, name)
            if not values and (name == "armature" or (control.mode == "position" and name != "speed_limit")):
                continue
            if len(values) != len(self.joints):
                raise ValueError(f"control.{name} has {len(values)} numbers for {len(self.joints)} joints; one each")
            for joint, value in zip(self.joints, values, strict=True):
                # A joint may have no rotor inertia.
                if not (0.0 < value < math.inf or (name == "armature" and value == 0.0)):
                    raise ValueError(f"control.{name} of joint {joint!r} is {value:g}; it must be finite and above 0")

    def _check_home(self) -> None:
        for joint in self.joints:
            if joint not in self.home:
                raise ValueError(f"home gives no value for joint {joint!r}; it needs one for each of joints")
        for joint in self.home:
            if joint not in self.joints:
                raise ValueError(f"home names {joint!r}, which is not among joints{nearest(joint, list(self.joints))}")


def read_description(source: str | Path) -> ArmDescription:
    """Read a description by a shipped arm's name (see `list_arms`) or a TOML file's path.

    Raises:
        ValueError: an unknown name (lists the known ones), an unreadable file, a missing or wrong entry.
    """
    path = Path(source)
    if path.suffix != ".toml":
        require_known("arm", str(source), list_arms())
        path = scenes_folder() / "instruments" / f"{source}.toml"
    table = read_toml(path, "arm")
    place = {"name": path.stem, "folder": path.parent}
    return fill(ArmDescription, {**table, **place}, f"arm {path.stem!r}")


def _require_distinct(entry: str, names: tuple[str, ...]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{entry} name {name!r} twice; each may be named once")
