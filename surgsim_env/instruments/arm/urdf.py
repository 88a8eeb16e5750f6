"""Preparation of URDF files for MuJoCo: numbers, meshes, shapes without extent, masses and moments of faulty links.

URDF files refer to meshes by ROS packages or by folders of another computer, and often state moments of inertia of
zero, which MuJoCo refuses for moving bodies.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh_files import checked_content, parsed
from surgsim_env.scene.arm_description import LinkInertia
from surgsim_env.scene.load import nearest

# Defaults that keep visual shapes; a file's own entries are kept.
COMPILER = {"discardvisual": "false", "balanceinertia": "true"}
# Mesh formats of MuJoCo; trimesh reads others.
MESH_FORMATS = (".stl", ".obj", ".msh")
# Number of folders above the URDF's to be searched for meshes.
FOLDERS_ABOVE = 4
# Sizes of the primitive shapes, and names of moments of inertia.
SIZES = {
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
    "sphere": ("radius",),
}
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
# Attributes of links and joints that are numbers, with their count.
NUMBERS = {"xyz": 3, "rpy": 3, "size": 3, "scale": 3, "rgba": 4}
NUMBERS |= dict.fromkeys(("radius", "length", "value", "multiplier", "offset", "damping", "friction", *MOMENTS), 1)
NUMBERS |= dict.fromkeys(("lower", "upper", "effort", "velocity"), 1)
# Elements whose numbers may be infinite or nan: their shapes are left out, their inertias replaced.
REPLACED = ("inertia", "mass", *SIZES)


def check_numbers(root: ElementTree.Element, path: Path) -> None:
    """Check that a URDF is no xacro template and has numbers where it needs them.

    Raises:
        ValueError: names link or joint, attribute and text.
    """
    if any("xacro}" in element.tag for element in root.iter()):
        raise ValueError(f"model file {path} is a xacro template: expand it (xacro {path.name} > arm.urdf), name that")
    for part in (*root.findall("link"), *root.findall("joint"), *root.findall("material")):
        for element in part.iter():
            for name, text in element.attrib.items():
                where = f"model file {path}: {part.tag} {part.get('name', '')}: {element.tag} {name} is {text!r}"
                if "${" in text or "$(" in text:
                    raise ValueError(f"{where}: run xacro first")
                count = NUMBERS.get(name) if name != "value" or element.tag == "mass" else None
                if count and not _are_numbers(text, count, element.tag):
                    raise ValueError(f"{where}; numbers to be written there, with blanks between them: {count}")


def _are_numbers(text: str, count: int, tag: str) -> bool:
    """True for as many numbers; those of limits may be infinite."""
    try:
        values = np.array(text.split(), dtype=np.float64)
    except ValueError:
        return False
    finite = ~np.isnan(values) if tag == "limit" else np.isfinite(values)
    return len(values) == count and (tag in REPLACED or bool(finite.all()))


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
        ValueError: a missing mesh file, an unknown link or mesh.
    """
    files = mesh_files(root, path)
    for name in dropped_meshes:
        if name not in files:
            raise ValueError(f"dropped_meshes: {path.name} has no mesh {name!r}{nearest(name, list(files))}")
    for link, shape in _shapes(root):
        mesh = shape.find("geometry/mesh")
        if shape_fault(shape) or (mesh is not None and mesh.get("filename", "") in dropped_meshes):
            link.remove(shape)
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        file = files[name]
        if file is None:
            raise ValueError(
                f"mesh file {name} is missing: put it beside {path.name}, or take the mesh out of that, or list "
                f"{name!r} in dropped_meshes"
            )
        mesh.set("filename", str(file.absolute()))
    compiler = _child(_child(root, "mujoco"), "compiler")
    # The file's folders are in the whole paths; each link stays a body of its own.
    for name in ("meshdir", "assetdir"):
        compiler.attrib.pop(name, None)
    compiler.attrib.update({**COMPILER, **compiler.attrib, "fusestatic": "false", "strippath": "false"})
    _set_inertias(root, inertias)


def _child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    """The first child of a tag, made if there is none."""
    child = element.find(tag)
    return ElementTree.SubElement(element, tag) if child is None else child


def _shapes(root: ElementTree.Element) -> list[tuple[ElementTree.Element, ElementTree.Element]]:
    """Links and their visual and collision elements, in pairs."""
    return [(link, part) for link in root.findall("link") for part in link if part.tag in ("visual", "collision")]


def shape_fault(shape: ElementTree.Element) -> str | None:
    """Reason for leaving out a visual or collision element, whatever its mesh; None for a shape with an extent."""
    geometry = shape.find("geometry")
    solid = None if geometry is None else next(iter(geometry), None)
    if solid is None:
        return "no geometry"
    if solid.tag == "mesh":
        scale = solid.get("scale", "1 1 1")
        return None if all(map(float, scale.split())) else f"scale {scale!r}"
    if solid.tag not in SIZES:
        return f"{solid.tag}: unknown to MuJoCo"
    sizes = [solid.get(name, "") for name in SIZES[solid.tag]]
    values = [float(value) for text in sizes for value in text.split()]
    if all(sizes) and all(0.0 < value < math.inf for value in values):
        return None
    return f"{solid.tag} of {', '.join(f'{name} {text!r}' for name, text in solid.attrib.items())}"


def shape_faults(root: ElementTree.Element, path: Path) -> tuple[list[str], dict[str, list[str]]]:
    """File names in a URDF of meshes that cannot be read, and links and meshes of shapes to be left out, by reason."""
    files = mesh_files(root, path)
    dropped: list[str] = []
    faults: dict[str, list[str]] = {}
    for link, shape in _shapes(root):
        mesh, fault, where = shape.find("geometry/mesh"), shape_fault(shape), link.get("name", "")
        if mesh is not None:
            name = mesh.get("filename", "")
            where = f"{where}: {name}"
            if not fault:
                fault = _mesh_fault(files[name], [float(part) for part in mesh.get("scale", "1 1 1").split()])
                dropped += [name] if fault else []
        if fault:
            faults.setdefault(fault, []).append(where)
    return list(dict.fromkeys(dropped)), {fault: list(dict.fromkeys(places)) for fault, places in faults.items()}


def _mesh_fault(file: Path | None, scale: list[float]) -> str | None:
    """MuJoCo's reason against a mesh, or that of its reader; None for a good one."""
    if file is None:
        return "not found"
    spec = mujoco.MjSpec()
    try:
        mesh = spec.add_mesh(name="mesh", file=str(file.absolute()), scale=scale)
        import_mesh(mesh, file)
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
        spec.compile()
    except ValueError as error:
        text = str(error).removeprefix(str(file)).split("\nElement")[0].removeprefix("Error: ").strip(": ")
        if "coplanar" in text:
            return "flat"
        return "without volume: open, or scaled twice" if "too small" in text else " ".join(text.split())
    return None


def import_mesh(mesh: Any, file: Path) -> None:
    """Give an `MjsMesh` the triangles of a file that MuJoCo does not read itself, such as an STL in letters.

    Raises:
        ValueError: a stand-in for the file, or none that trimesh reads.
    """
    checked_content(file)
    suffix, size = file.suffix.lower(), file.stat().st_size
    with file.open("rb") as stream:
        count = int.from_bytes(stream.read(84)[80:], "little")
    if suffix in MESH_FORMATS and (suffix != ".stl" or size == 84 + 50 * count):
        return
    vertices, triangles = parsed(file, _triangles, "convert it to STL or OBJ")
    if not len(triangles):
        raise ValueError(f"{file} has no triangles: export it again")
    mesh.name = mesh.name or file.stem
    mesh.file, mesh.uservert, mesh.userface = "", vertices.ravel(), triangles.ravel()


def _triangles(path: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices [m] (n, 3) and triangles (m, 3) of a file, in metres if it states its unit."""
    import trimesh

    surface: Any = trimesh.load(path, force="mesh")
    if surface.units is not None:
        surface.convert_units("meters")
    return surface.vertices, surface.faces


def mesh_files(root: ElementTree.Element, path: Path) -> dict[str, Path | None]:
    """Paths of a URDF's meshes by their file names in it; None for those that are not found."""
    compiler = root.find("mujoco/compiler")
    stated = {} if compiler is None else compiler.attrib
    folder = stated.get("meshdir", stated.get("assetdir", ""))
    strip = stated.get("strippath") != "false"
    names = dict.fromkeys(mesh.get("filename", "") for mesh in root.iter("mesh"))
    return {name: next(filter(Path.is_file, _places(path, name, folder, strip)), None) for name in names}


def _places(path: Path, name: str, folder: str, strip: bool) -> Iterator[Path]:
    """Candidate paths of a mesh: in its stated folder, as named, by less and less of its path below folders above.

    Args:
        path: of the URDF.
        name: such as meshes/link.stl, /home/them/link.stl or package://arm/meshes/link.stl.
        folder: of the meshes by the URDF's compiler element.
        strip: True if that element takes folders off their names, as by default.
    """
    scheme, separator, rest = name.rpartition("://")
    parts = PurePosixPath((rest if separator else name).replace("\\", "/")).parts
    if not parts:
        return
    if folder:
        yield path.parent / folder / Path(*parts[-1:] if strip else parts)
    if not separator or scheme == "file":
        yield path.parent / Path(*parts)
    above = [path.parent.absolute(), *path.parent.absolute().parents][: FOLDERS_ABOVE + 1]
    yield path.parent / folder / parts[-1]
    endings = [parts[start:] for start in range(len(parts)) if parts[start] not in ("/", "..", ".")]
    for ending in endings:
        yield from (place.joinpath(*ending) for place in above)
    yield from (place / "meshes" / parts[-1] for place in above)


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
