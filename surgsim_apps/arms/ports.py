"""Ports of two arms and the endoscope: a ports file, its defaults, and the body wall."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from msdm_core.mesh import FloatArray, IntArray
from msdm_core.mesh_files import LengthUnit, read_surface
from surgsim_apps.patient.label_image import is_image
from surgsim_apps.patient.label_surface import read_label_surface
from surgsim_env.instruments import check_port_outside
from surgsim_env.scene import Anatomy, Port, fill, read_toml, tangent_axes

Vector = tuple[float, float, float]
# The camera's port lies 10 to 20 cm from the target, the instruments' 8 cm beside it (6 to 10 cm), all on a line across
# the line of sight (port placement for da Vinci, aischannel 2019).
CAMERA_DISTANCE, PORT_SPACING = 0.15, 0.08


@dataclass(frozen=True)
class PortPlace:
    """An instrument's port.

    Args:
        point: the trocar [m].
        into: direction into the body, or
        target: the point on the instrument's line [m].
        roll: turn of the arm's base about that direction [rad].
    """

    point: Vector
    into: Vector | None = None
    target: Vector | None = None
    roll: float = 0.0

    def __post_init__(self) -> None:
        if (self.into is None) == (self.target is None):
            raise ValueError(f"port at {self.point}: give exactly one of into and target")
        self.port  # noqa: B018  raises for an invalid port

    @property
    def port(self) -> Port:
        """The port's frame."""
        return Port(self.point, self.into or _towards(self.point, self.target), self.roll)


@dataclass(frozen=True)
class EndoscopePort:
    """The port of the endoscope and the point in its line of sight [m]."""

    point: Vector
    target: Vector

    def __post_init__(self) -> None:
        _towards(self.point, self.target)


@dataclass(frozen=True)
class InnerTarget:
    """A target of both arms inside the patient [m]."""

    point: Vector


@dataclass(frozen=True)
class SurfaceSource:
    """A triangle surface in the scene's frame.

    Args:
        file: STL, OBJ or PLY, or an image of labels.
        length_unit: of the former, "m", "cm", "mm" or metres per unit.
        label: in the image, a number or a name of the file.
    """

    file: str
    length_unit: LengthUnit = "m"
    label: str = ""

    def __post_init__(self) -> None:
        if is_image(Path(self.file)) != bool(self.label):
            raise ValueError(f"surface {self.file}: label is {self.label!r}; the rule is one for an image, else none")

    def read(self) -> tuple[FloatArray, IntArray]:
        """Points (n, 3) [m] and triangles (m, 3)."""
        if self.label:
            return read_label_surface(Path(self.file), self.label)
        return read_surface(self.file, length_unit=self.length_unit)


@dataclass(frozen=True)
class Wall:
    """The insufflated body wall, its middle through the trocars: a dome (of a sphere), a plate or a patient's skin.

    Args:
        thickness: [m].
        hole: radius of the free passage at a trocar [m].
        radius: of the dome [m]; 20 cm is chosen for an insufflated abdomen.
        centre: of the dome's sphere [m]; by default beneath both ports.
        plate: an infinite plate instead of the dome.
        skin: a surface instead of the dome.
    """

    thickness: float = 0.02
    hole: float = 0.03
    radius: float = 0.20
    centre: Vector | None = None
    plate: bool = False
    skin: SurfaceSource | None = None

    def __post_init__(self) -> None:
        if self.plate and self.skin is not None:
            raise ValueError("wall: plate and skin are given; leave one out")
        if not (0.0 <= self.thickness < math.inf and 0.5 * self.thickness < self.hole < math.inf):
            raise ValueError(
                f"wall: thickness {self.thickness:g} m, hole {self.hole:g} m; the rule is "
                "0 <= thickness < 2 hole, finite"
            )


@dataclass(frozen=True)
class Ports:
    """A ports file: two instruments, the endoscope, inner targets, the wall and what else arms must clear."""

    left: PortPlace
    right: PortPlace
    endoscope: EndoscopePort
    targets: tuple[InnerTarget, ...] = ()
    wall: Wall = Wall()
    obstacles: tuple[SurfaceSource, ...] = ()

    def __post_init__(self) -> None:
        if math.dist(self.left.point, self.right.point) < 1e-3:
            raise ValueError(f"the left and the right port both lie at {self.left.point}: move them apart")
        apart = math.dist(self.left.point, self.right.point)
        if self.has_dome and self.wall.centre is None and not 0.5 * apart < self.wall.radius:
            raise ValueError(
                f"the ports lie {apart * 1e3:.0f} mm apart, more than the dome is wide: raise wall.radius above "
                f"{0.5 * apart:.3f} m, or use wall.plate = true"
            )

    @property
    def has_dome(self) -> bool:
        """True if the wall is a dome."""
        return not self.wall.plate and self.wall.skin is None

    @property
    def dome_centre(self) -> FloatArray:
        """Middle of the dome's sphere [m] (3,), by default below both ports along the wall's normal."""
        if self.wall.centre is not None:
            return np.array(self.wall.centre)
        left, right = np.array(self.left.point), np.array(self.right.point)
        depth = math.sqrt(self.wall.radius**2 - 0.25 * float((right - left) @ (right - left)))
        return 0.5 * (left + right) - depth * self.wall_normal

    @property
    def wall_normal(self) -> FloatArray:
        """Out of the body (3,): across the line of both ports, against their mean direction inwards."""
        line = np.array(self.right.point) - np.array(self.left.point)
        line /= np.linalg.norm(line)
        out = self.left.port.rotation[:, 2] + self.right.port.rotation[:, 2]
        out = out - (out @ line) * line
        length = float(np.linalg.norm(out))
        if length < 1e-6:
            raise ValueError("both ports point along the line through them, which defines no wall: turn them")
        return out / length

    @property
    def frames(self) -> dict[str, Port]:
        """The frames of all three ports by name; the endoscope's looks at its target."""
        scope = self.endoscope
        direction = _towards(scope.point, scope.target)
        return {"left": self.left.port, "right": self.right.port, "endoscope": Port(scope.point, direction)}

    def in_folder(self, folder: Path) -> "Ports":
        """These ports with the files of their surfaces in a folder."""

        def placed(source: SurfaceSource) -> SurfaceSource:
            return replace(source, file=str(folder / source.file))

        skin = self.wall.skin
        wall = self.wall if skin is None else replace(self.wall, skin=placed(skin))
        return replace(self, wall=wall, obstacles=tuple(map(placed, self.obstacles)))

    def check_outside(self, anatomy: Anatomy) -> None:
        """Refuse a port inside the organ.

        Raises:
            ValueError: names the port, its place and the organ.
        """
        for name, port in self.frames.items():
            check_port_outside(port, anatomy, name=f"the {name} port")


def read_ports(path: str | Path) -> Ports:
    """Ports of a TOML file.

    Raises:
        ValueError: an unreadable file, or its wrong entry.
    """
    ports = ports_from_table(read_toml(Path(path), "ports"), name=Path(path).stem)
    return ports.in_folder(Path(path).parent)


def ports_from_table(table: dict[str, Any], *, name: str) -> Ports:
    """Ports from the table of a TOML file."""
    return fill(Ports, table, f"ports {name!r}")


def default_ports(anatomy: Anatomy) -> Ports:
    """Ports by the rules of laparoscopy: the camera 15 cm before the palpable face, the others 8 cm to both sides.

    All three lie on a line across the line of sight (the scene's approach) and look at the middle of the face.
    """
    face = anatomy.face
    corners = face.points[face.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    target = area @ corners.mean(axis=1) / area.sum()
    aside, _ = tangent_axes(face.approach)
    camera = target - CAMERA_DISTANCE * face.approach
    return Ports(
        left=PortPlace(vector(camera - PORT_SPACING * aside), target=vector(target)),
        right=PortPlace(vector(camera + PORT_SPACING * aside), target=vector(target)),
        endoscope=EndoscopePort(vector(camera), vector(target)),
    )


def vector(values: FloatArray) -> Vector:
    """Three numbers as a tuple."""
    x, y, z = values.tolist()
    return x, y, z


def _towards(point: Vector, target: Vector | None) -> Vector:
    if target is None or not np.isfinite([*point, *target]).all() or math.dist(point, target) < 1e-6:
        raise ValueError(f"port at {point}: its target {target} must be another, finite point")
    return vector(np.array(target) - np.array(point))
