"""Preparation of URDF files for MuJoCo: paths of meshes, masses and moments of faulty links.

URDF files refer to meshes by ROS packages or by folders of another computer, and often state moments of inertia of
zero, which MuJoCo refuses for moving bodies.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

from surgsim_env.scene.arm_description import LinkInertia
from surgsim_env.scene.load import nearest

# Keeps visual shapes and each link as a body of its own; file names of meshes are whole paths (`find_mesh`).
COMPILER = {"discardvisual": "false", "fusestatic": "false", "balanceinertia": "true"}
# Mesh formats of MuJoCo.
MESH_FORMATS = (".stl", ".obj", ".msh")
# Number of folders above the URDF's to be searched for meshes.
FOLDERS_ABOVE = 4


def prepare_urdf(
    root: ElementTree.Element, path: Path, inertias: Sequence[LinkInertia], dropped_meshes: Sequence[str]
) -> None:
    """Change a URDF's elements for MuJoCo.

    Args:
        root: its root element, changed in place.
        path: of the file.
        inertias: of links, in place of the file's own.
        dropped_meshes: file names in the URDF of meshes to be left out with their shapes.

    Raises:
        ValueError: a missing mesh file, a format unknown to MuJoCo, an unknown link or mesh.
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
        file = find_mesh(path, name, folder)
        if file is None:
            place = path.parent / folder / PurePosixPath(name).name
            raise ValueError(
                f"mesh file {place} is missing: put it there, or take the mesh out of {path.name}, or list {name!r} "
                "in dropped_meshes"
            )
        if file.suffix.lower() not in MESH_FORMATS:
            raise ValueError(
                f"mesh file {file} is of a format that MuJoCo does not read: convert it to STL or OBJ, or list "
                f"{name!r} in dropped_meshes"
            )
        mesh.set("filename", str(file.absolute()))
    compiler.set("strippath", "false")
    _set_inertias(root, inertias)


def mesh_names(root: ElementTree.Element) -> list[str]:
    """Distinct file names of a URDF's meshes."""
    return list(dict.fromkeys(mesh.get("filename", "") for mesh in root.iter("mesh")))


def find_mesh(path: Path, name: str, folder: str = "") -> Path | None:
    """Path of a mesh by its name in a URDF, or None.

    Args:
        path: of the URDF.
        name: such as meshes/link.stl, /home/them/link.stl or package://arm/meshes/link.stl.
        folder: of the meshes by the URDF's compiler element.
    """
    return next((place for place in _places(path, name, folder) if place.is_file()), None)


def _places(path: Path, name: str, folder: str) -> Iterator[Path]:
    """Candidate paths of a mesh: as named, below folders above the URDF, then by less and less of its path."""
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
    for inertia in inertias:
        if inertia.link not in links:
            raise ValueError(f"inertias: the model has no link {inertia.link!r}{nearest(inertia.link, list(links))}")
        link = links[inertia.link]
        for old in link.findall("inertial"):
            link.remove(old)
        new = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(new, "origin", {"xyz": " ".join(map(repr, inertia.centre)), "rpy": "0 0 0"})
        ElementTree.SubElement(new, "mass", {"value": repr(inertia.mass)})
        moments = dict(zip(("ixx", "iyy", "izz"), map(repr, inertia.moments), strict=True))
        ElementTree.SubElement(new, "inertia", {**moments, "ixy": "0", "ixz": "0", "iyz": "0"})
