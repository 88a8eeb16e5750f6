"""Links and speed limits of a URDF file."""

from xml.etree import ElementTree

import numpy as np

from msdm_core.arithmetic import eigh
from msdm_core.mesh import FloatArray
from surgsim_env.instruments import MOMENTS

# Smallest mass [kg] and moments [kg m^2] of moving bodies in MuJoCo (mjMINVAL).
INERTIA_LEAST = 1e-15


def faulty_links(root: ElementTree.Element) -> dict[str, tuple[float, FloatArray]]:
    """Links refused by MuJoCo, with their stated mass [kg], 0 for none, and centre of mass [m] (3,).

    A link moved by a joint needs a mass and a positive definite inertia; another link needs zero moments or those of a
    body. MuJoCo needs all of mass and moments, or none.
    """
    moved = {
        joint.find("child").get("link", "")  # type: ignore[union-attr]
        for joint in root.findall("joint")
        if joint.get("type") != "fixed" and joint.find("child") is not None
    }
    faulty = {}
    for link in root.findall("link"):
        name, inertial = link.get("name", ""), link.find("inertial")
        if inertial is None:
            if name in moved:
                faulty[name] = (0.0, np.zeros(3))
            continue
        mass, centre, matrix = _inertial(inertial)
        least = float(eigh(matrix)[0][0]) if np.isfinite(matrix).all() else -1.0
        massive = INERTIA_LEAST < mass < np.inf
        wrong = least < 0.0 or not (massive or (mass == 0.0 and not matrix.any())) or not _is_complete(inertial)
        if wrong or (name in moved and not (massive and least > INERTIA_LEAST)):
            faulty[name] = (mass if massive else 0.0, centre)
    return faulty


def _is_complete(inertial: ElementTree.Element) -> bool:
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    return mass is not None and "value" in mass.attrib and inertia is not None and inertia.attrib.keys() >= set(MOMENTS)


def _inertial(element: ElementTree.Element) -> tuple[float, FloatArray, FloatArray]:
    """Stated mass [kg], centre [m] (3,) and matrix of inertia [kg m^2] (3, 3); 0 if not stated."""
    mass, origin, inertia = element.find("mass"), element.find("origin"), element.find("inertia")
    stated = {} if inertia is None else inertia.attrib
    xx, xy, xz, yy, yz, zz = (float(stated.get(name, 0.0)) for name in MOMENTS)
    centre = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
    value = 0.0 if mass is None else float(mass.get("value", 0.0))
    return (
        value,
        np.array([float(part) for part in centre.split()]),
        np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]),
    )


def speed_limits(root: ElementTree.Element) -> dict[str, float]:
    """Stated speed limits of a URDF's joints above 0 [rad/s or m/s]; MuJoCo drops them."""
    limits = {joint.get("name", ""): joint.find("limit") for joint in root.findall("joint")}
    speeds = {name: float(limit.get("velocity", 0.0)) for name, limit in limits.items() if limit is not None}
    return {name: speed for name, speed in speeds.items() if 0.0 < speed < np.inf}
