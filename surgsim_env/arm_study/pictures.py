"""Pictures of both arms in the patient: drawn with OpenGL where there is one, and without it as capsules.

In all of them each arm has its tip at the point that `poses` names; an arm that reaches nothing stands at home, or is
left out where it is drawn as capsules.
"""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.arm_study.maps import LEFT, RIGHT, camera_view
from surgsim_env.arm_study.ports import Ports
from surgsim_env.arm_study.results import SIDES, ArmsEvaluation, sides
from surgsim_env.instruments.arm.arm import Arm
from surgsim_env.palpation.surface_drawing import (
    INK,
    PAPER,
    Patches,
    View,
    curved_patches,
    draw_patches,
    save_png,
    tube,
)
from surgsim_env.rendering.cameras import Camera
from surgsim_env.rendering.still import Capsule, draw_still
from surgsim_env.reports.html_page import Picture

SIZE = 960, 720
TISSUE = np.array([0.70, 0.33, 0.28])
SCOPE, PORT, WALL = "#5c6470", "#f2bf33", (0.85, 0.65, 0.55, 0.18)
SCOPE_RADIUS, PORT_RADIUS = 0.005, 0.008
# The endoscope is drawn this far out of its port [m]; as capsules, also into the body by this share of the way to the
# organ's middle.
SCOPE_OUTSIDE, SCOPE_INSIDE = 0.18, 0.45
# Fields of view of the camera beside the table and of the endoscope [degrees]; how far inside its port the latter's
# camera is [m].
BESIDE_FOV, SCOPE_FOV, SCOPE_TIP = 35.0, 70.0, 0.02
# Each tip is put this far from the middle of the common points, towards its own port [m].
ASIDE = 0.025
# Long shapes are drawn in pieces no longer than this, so that what is in front hides what is behind [m].
PIECE = 0.02

# Patches, their colours and gloss.
Part = tuple[Patches, FloatArray, float]


def poses(evaluation: ArmsEvaluation) -> dict[str, int]:
    """The point at which each arm is drawn: of those that both reach, beside their middle towards its own port."""
    found = {}
    for (side, arm), other in zip(sides(evaluation), SIDES[::-1], strict=True):
        mask = evaluation.both if evaluation.both.any() else arm.reachable
        known = np.flatnonzero(mask)
        if not len(known):
            continue
        middle = evaluation.points[known].mean(axis=0)
        if side in evaluation.ports and other in evaluation.ports:
            apart = np.array(evaluation.ports[side].point) - np.array(evaluation.ports[other].point)
            middle = middle + ASIDE * apart / max(float(np.linalg.norm(apart)), 1e-9)
        found[side] = int(known[np.argmin(np.linalg.norm(evaluation.points[known] - middle, axis=1))])
    return found


def draw_arms(evaluation: ArmsEvaluation, arms: tuple[Arm, Arm], ports: Ports) -> dict[str, NDArray[np.uint8]]:
    """Pictures (height, width, 3) by caption: from beside the table and through the endoscope's port.

    Raises:
        NoGLError: there is no OpenGL; names what is missing.
    """
    from matplotlib.colors import to_rgba

    places = poses(evaluation)
    joints = [
        reach.joints[places[side]] if side in places else arm.home
        for (side, reach), arm in zip(sides(evaluation), arms, strict=True)
    ]
    capsules = [
        Capsule(ends, radius, to_rgba(colour)) for ends, radius, colour in _fittings(evaluation, PORT, inside=0.0)
    ]
    if not ports.wall.plate:
        # Not seen by the endoscope's camera, which stands inside the dome: OpenGL leaves out the backs of surfaces.
        capsules.append(Capsule(np.stack([ports.dome_centre] * 2), ports.wall.radius, WALL))
    line = np.array(ports.right.point) - np.array(ports.left.point)
    point, target = np.array(ports.endoscope.point), np.array(ports.endoscope.target)
    ahead = (target - point) / np.linalg.norm(target - point)
    position, centre = _beside(evaluation, arms, joints, ports)
    cameras = {
        "The arms at their ports": Camera.looking(position, centre, ports.wall_normal, BESIDE_FOV),
        # The right arm comes from the right.
        "Through the endoscope": Camera.looking(point + SCOPE_TIP * ahead, target, np.cross(line, ahead), SCOPE_FOV),
    }
    posed = [_posed(arm, values) for arm, values in zip(arms, joints, strict=True)]
    surface = evaluation.surface_points, evaluation.surface_triangles
    frames = draw_still(surface, posed, capsules, list(cameras.values()), SIZE)
    return dict(zip(cameras, frames, strict=True))


def _posed(arm: Arm, joints: FloatArray) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """An arm's model, and data with its kinematics at joint values."""
    data = mujoco.MjData(arm.model)
    arm.write(data, joints)
    mujoco.mj_kinematics(arm.model, data)
    return arm.model, data


def _beside(
    evaluation: ArmsEvaluation, arms: tuple[Arm, Arm], joints: list[FloatArray], ports: Ports
) -> tuple[FloatArray, FloatArray]:
    """A camera's position and target [m]: on the side away from the arms' bases, so far that it sees all shapes."""
    ends = np.concatenate([arm.shape_ends(one).reshape(-1, 3) for arm, one in zip(arms, joints, strict=True)])
    middle = evaluation.points[~evaluation.inner].mean(axis=0)
    line = np.array(ports.right.point) - np.array(ports.left.point)
    away = np.cross(line, ports.wall_normal)
    away /= np.linalg.norm(away)
    if (ends.mean(axis=0) - middle) @ away > 0.0:
        away = -away
    everything = np.concatenate([ends, middle[None]])
    centre = 0.5 * (everything.min(axis=0) + everything.max(axis=0))
    radius = float(np.linalg.norm(everything - centre, axis=1).max())
    direction = 0.88 * away + 0.48 * ports.wall_normal + 0.15 * line / np.linalg.norm(line)
    direction /= np.linalg.norm(direction)
    return centre + 1.05 * radius / np.sin(np.radians(0.5 * BESIDE_FOV)) * direction, centre


def _fittings(evaluation: ArmsEvaluation, port_colour: str, *, inside: float) -> list[tuple[FloatArray, float, str]]:
    """Ends [m] (2, 3), radius [m] and colour of the ports and the endoscope.

    The endoscope goes into the body by a share `inside` of the way to the organ's middle.
    """
    found = []
    middle = evaluation.surface_points.mean(axis=0)
    for name, port in evaluation.ports.items():
        point, into = np.array(port.point), np.array(port.into) / np.linalg.norm(port.into)
        found.append((np.stack([point, point]), PORT_RADIUS, port_colour))
        if name == "endoscope":
            depth = inside * max(0.0, float((middle - point) @ into))
            found.append((np.stack([point - SCOPE_OUTSIDE * into, point + depth * into]), SCOPE_RADIUS, SCOPE))
    return found


def write_pictures(
    evaluation: ArmsEvaluation, arms: tuple[Arm, Arm], folder: Path, *, name: str = "arms"
) -> list[Picture]:
    """Write a picture of the arms as capsules, which needs no OpenGL, and those that the evaluation contains."""
    given = write_given_pictures(evaluation.pictures, folder, name=name)
    places = poses(evaluation)
    if not places:
        return given
    parts = [_organ(evaluation)]
    for (side, reach), arm, colour in zip(sides(evaluation), arms, (LEFT, RIGHT), strict=True):
        if side in places:
            ends = arm.shape_ends(reach.joints[places[side]])
            for one, radius in zip(ends, arm.shape_radius, strict=True):
                parts.extend(_capsule(one, float(radius), colour))
    for ends, radius, colour in _fittings(evaluation, INK, inside=SCOPE_INSIDE):
        parts.extend(_capsule(ends, radius, colour))
    path = folder / f"{name}.png"
    _write_views(evaluation, parts, path)
    tips = " and ".join(f"the {side} arm with its tip at point {index}" for side, index in places.items())
    description = (
        f"Close to the organ, whole from the front and above, and whole from the side: {tips}. Left arm blue, "
        "right arm orange, endoscope grey, dark balls the ports; the body wall is left out."
    )
    return [Picture.of_file(path, "The arms and the endoscope over the organ", description), *given]


def write_given_pictures(pictures: Mapping[str, NDArray[np.uint8]], folder: Path, *, name: str) -> list[Picture]:
    """Write RGB images by caption as PNG files, numbered from 1."""
    from matplotlib.image import imsave

    written = []
    for number, (caption, image) in enumerate(pictures.items(), start=1):
        path = folder / f"{name}_{number}.png"
        imsave(path, np.ascontiguousarray(image), format="png")
        title = caption[0].upper() + caption[1:]
        written.append(Picture.of_file(path, title, "Drawn with OpenGL: each tip is at a point that its arm reaches."))
    return written


def _organ(evaluation: ArmsEvaluation) -> Part:
    patches = curved_patches(evaluation.surface_points, evaluation.surface_triangles, 2)
    return patches, np.broadcast_to(TISSUE, (len(patches.corners), 3)), 0.2


def _capsule(ends: FloatArray, radius: float, colour: str) -> list[Part]:
    """A capsule about an axis (2, 3) [m] in short pieces."""
    from matplotlib.colors import to_rgb

    start, end = ends
    count = max(1, int(np.ceil(np.linalg.norm(end - start) / max(PIECE, 2.0 * radius))))
    parts = []
    for low, high in pairwise(np.linspace(start, end, count + 1)):
        patches = curved_patches(*tube(low, high, radius), 1)
        parts.append((patches, np.broadcast_to(np.array(to_rgb(colour)), (len(patches.corners), 3)), 0.3))
    return parts


def _write_views(evaluation: ArmsEvaluation, parts: list[Part], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 4.8), dpi=100, facecolor=PAPER, layout="constrained")
    front, side = _views(evaluation)
    titles = ("the organ and the ports", "from the front and above", "from the side")
    near = np.concatenate([evaluation.surface_points, *(np.array([port.point]) for port in evaluation.ports.values())])
    for axes, view, title in zip(figure.subplots(1, 3), (front, front, side), titles, strict=True):
        draw_patches(axes, parts, view)
        axes.set_title(title, fontsize=10, color=INK)
        axes.set_aspect("equal")
        axes.margins(0.03)
        axes.set_axis_off()
        if title == titles[0]:
            (left, low), (right, high) = view.flat(near).min(axis=0) - 15.0, view.flat(near).max(axis=0) + 15.0
            axes.set(xlim=(left, right), ylim=(low, high))
    save_png(figure, path)


def _views(evaluation: ArmsEvaluation) -> tuple[View, View]:
    """Two views across the endoscope's line of sight, along which the picture's upward direction lies."""
    into, right = -camera_view(evaluation).towards, camera_view(evaluation).right
    if {"left", "right"} <= evaluation.ports.keys():
        across = np.array(evaluation.ports["left"].point) - np.array(evaluation.ports["right"].point)
        across = across - (across @ into) * into
        if np.linalg.norm(across) > 1e-6:
            right = across / np.linalg.norm(across)
    front = np.cross(right, into)
    head = np.array([0.0, 0.0, 1.0])
    front = front if front @ head > 0.0 else -front
    return View.along(0.8 * front + 0.6 * into, -into), View.along(right, -into)
