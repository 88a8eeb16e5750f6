"""A URDF file prepared for MuJoCo: its meshes found where they lie, faulty links given mass and inertia.

URDF files refer to meshes by ROS packages or by folders of another computer, and often state moments of inertia of
zero, which MuJoCo refuses for bodies that move.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import numpy as np

from msdm_core.arithmetic import eigh
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.arm_description import LinkInertia
from surgsim_env.scene.load import nearest

# Keep visual shapes and every link as a body of its own; the file names of meshes are whole (`find_mesh`).
COMPILER = {"discardvisual": "false", "fusestatic": "false", "balanceinertia": "true"}
# Formats of meshes that MuJoCo reads.
MESH_FORMATS = (".stl", ".obj", ".msh")
# Number of folders above the URDF's in which meshes are looked for.
FOLDERS_ABOVE = 4
# Smaller masses [kg] and moments [kg m^2] are refused by MuJoCo for bodies that move (mjMINVAL).
INERTIA_LEAST = 1e-15


def prepare_urdf(
    root: ElementTree.Element, path: Path, inertias: Sequence[LinkInertia], dropped_meshes: Sequence[str]
) -> None:
    """Change a URDF's elements so that MuJoCo can read them.

    Args:
        root: its root element, changed in place.
        path: of the file.
        inertias: of links, in place of the file's own.
        dropped_meshes: file names of meshes, as the file gives them, whose shapes are left out.

    Raises:
        ValueError: a mesh that is not found, a format that MuJoCo does not read, a link or mesh that is not there.
    """
    _drop_meshes(root, path, dropped_meshes)
    compiler = root.find("mujoco/compiler")
    if compiler is None:
        own = root.find("mujoco")
        own = ElementTree.SubElement(root, "mujoco") if own is None else own
        compiler = ElementTree.SubElement(own, "compiler", COMPILER)
    folder = compiler.attrib.pop("meshdir", "")
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        found = find_mesh(path, name, folder)
        if found is None:
            place = path.parent / folder / PurePosixPath(name).name
            raise ValueError(
                f"mesh file {place} is missing: put it there, or take the mesh out of {path.name}, or list {name!r} "
                "in dropped_meshes"
            )
        if found.suffix.lower() not in MESH_FORMATS:
            raise ValueError(
                f"mesh file {found} is of a format that MuJoCo does not read: convert it to STL or OBJ, or list "
                f"{name!r} in dropped_meshes"
            )
        mesh.set("filename", str(found.absolute()))
    compiler.set("strippath", "false")
    _set_inertias(root, inertias)


def mesh_names(root: ElementTree.Element) -> list[str]:
    """File names of a URDF's meshes as it gives them, each once."""
    return list(dict.fromkeys(mesh.get("filename", "") for mesh in root.iter("mesh")))


def find_mesh(path: Path, name: str, folder: str = "") -> Path | None:
    """The file of a mesh that a URDF names, or None.

    Args:
        path: of the URDF.
        name: such as meshes/link.stl, /home/them/link.stl or package://arm/meshes/link.stl.
        folder: in which the URDF says that its meshes are.
    """
    return next((place for place in _places(path, name, folder) if place.is_file()), None)


def _places(path: Path, name: str, folder: str) -> Iterator[Path]:
    """Where a mesh may lie: as it is named, below folders above the URDF, then by less and less of its path."""
    scheme, separator, rest = name.rpartition("://")
    parts = PurePosixPath((rest if separator else name).replace("\\", "/")).parts
    if not parts:
        return
    if not separator or scheme == "file":
        yield path.parent / Path(*parts)
    above = [path.parent.absolute(), *path.parent.absolute().parents][: FOLDERS_ABOVE + 1]
    yield path.parent / folder / parts[-1]
    endings = [parts[start:] for start in range(len(parts)) if parts[start] not in ("/", "..", ".")]
    for ending in endings:
        yield from (place.joinpath(*ending) for place in above)
    yield from (place / "meshes" / parts[-1] for place in above)


def _drop_meshes(root: ElementTree.Element, path: Path, names: Iterable[str]) -> None:
    known = mesh_names(root)
    for name in names:
        if name not in known:
            raise ValueError(f"dropped_meshes: {path.name} has no mesh {name!r}{nearest(name, known)}")
    gone = set(names)
    for link in root.findall("link"):
        for shape in [part for part in link if part.tag in ("visual", "collision")]:
            mesh = shape.find("geometry/mesh")
            if mesh is not None and mesh.get("filename", "") in gone:
                link.remove(shape)


def _set_inertias(root: ElementTree.Element, inertias: Sequence[LinkInertia]) -> None:
    links = {link.get("name", ""): link for link in root.findall("link")}
    for one in inertias:
        if one.link not in links:
            raise ValueError(f"inertias: the model has no link {one.link!r}{nearest(one.link, list(links))}")
        link = links[one.link]
        for old in link.findall("inertial"):
            link.remove(old)
        new = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(new, "origin", {"xyz": " ".join(map(repr, one.centre)), "rpy": "0 0 0"})
        ElementTree.SubElement(new, "mass", {"value": repr(one.mass)})
        moments = dict(zip(("ixx", "iyy", "izz"), map(repr, one.moments), strict=True))
        ElementTree.SubElement(new, "inertia", {**moments, "ixy": "0", "ixz": "0", "iyz": "0"})


def faulty_links(root: ElementTree.Element) -> dict[str, tuple[float, FloatArray]]:
    """Links that MuJoCo would refuse, with the mass [kg] and centre of mass [m] (3,) that they state; mass 0: none.

    A link that a joint moves needs a mass and a positive definite inertia; any other one must not have moments that are
    neither zero nor those of a body.
    """
    moved = {
        joint.find("child").get("link", "")  # type: ignore[union-attr]
        for joint in root.findall("joint")
        if joint.get("type") != "fixed" and joint.find("child") is not None
    }
    found = {}
    for link in root.findall("link"):
        name, inertial = link.get("name", ""), link.find("inertial")
        if inertial is None:
            if name in moved:
                found[name] = (0.0, np.zeros(3))
            continue
        mass, centre, matrix = _inertial(inertial)
        least = float(eigh(matrix)[0][0]) if np.isfinite(matrix).all() else -1.0
        wrong = least < 0.0 or (matrix.any() and not mass > INERTIA_LEAST)
        if wrong or (name in moved and not (mass > INERTIA_LEAST and least > INERTIA_LEAST)):
            found[name] = (mass if mass > INERTIA_LEAST else 0.0, centre)
    return found


def _inertial(element: ElementTree.Element) -> tuple[float, FloatArray, FloatArray]:
    """Mass [kg], centre [m] (3,) and matrix of inertia [kg m^2] (3, 3) as stated; 0 for what is not."""
    mass, origin, inertia = element.find("mass"), element.find("origin"), element.find("inertia")
    stated = {} if inertia is None else inertia.attrib
    xx, xy, xz, yy, yz, zz = (float(stated.get(f"i{pair}", 0.0)) for pair in ("xx", "xy", "xz", "yy", "yz", "zz"))
    centre = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
    value = 0.0 if mass is None else float(mass.get("value", 0.0))
    return value, np.array([float(one) for one in centre.split()]), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def speed_limits(root: ElementTree.Element) -> dict[str, float]:
    """Speed limits that a URDF states for its joints, above 0 [rad/s or m/s]; MuJoCo does not keep them."""
    limits = {joint.get("name", ""): joint.find("limit") for joint in root.findall("joint")}
    speeds = {name: float(limit.get("velocity", 0.0)) for name, limit in limits.items() if limit is not None}
    return {name: speed for name, speed in speeds.items() if 0.0 < speed < np.inf}
