"""The arms in the patient, drawn without GL: both at points that they reach, with the endoscope and the ports."""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_env.arms.arm import Arm
from surgsim_env.evaluation.arm_maps import LEFT, RIGHT, Picture, camera_view
from surgsim_env.evaluation.arm_quantities import SIDES, sides
from surgsim_env.evaluation.arm_results import ArmsEvaluation
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

TISSUE = np.array([0.70, 0.33, 0.28])
SCOPE = "#5c6470"
SCOPE_RADIUS, PORT_RADIUS = 0.005, 0.008
# The endoscope as drawn: this far out of its port, and into the body this share of the way to the organ's middle.
SCOPE_OUTSIDE, SCOPE_INSIDE = 0.18, 0.45
# Each tip is put this far from the middle of the common points, towards its own port [m].
ASIDE = 0.025
# Long shapes are drawn in pieces no longer than this, so that what is in front hides what is behind [m].
PIECE = 0.02


def write_pictures(
    evaluation: ArmsEvaluation, arms: tuple[Arm, Arm], folder: Path, *, name: str = "arms"
) -> list[Picture]:
    """Write a picture of the arms as capsules, which needs no OpenGL, and those that the evaluation brought."""
    given = write_given_pictures(evaluation.pictures, folder, name=name)
    places = poses(evaluation)
    if not places:
        return given
    parts = [_organ(evaluation)]
    for (side, arm), shape, colour in zip(sides(evaluation), arms, (LEFT, RIGHT), strict=True):
        if side in places:
            parts.extend(_capsules(shape.shape_ends(arm.joints[places[side]]), shape.shape_radius, colour))
    parts.extend(_ports(evaluation))
    file = f"{name}.png"
    _draw(evaluation, parts, folder / file)
    told = " and ".join(f"the {side} arm with its tip at point {index}" for side, index in places.items())
    return [
        Picture(
            file,
            "The arms and the endoscope over the organ",
            f"Close to the organ, whole from the front and above, and whole from the side: {told}. Left arm blue, "
            "right arm orange, endoscope grey, dark balls the ports; the body wall is left out.",
        ),
        *given,
    ]


def write_given_pictures(pictures: Mapping[str, NDArray[np.uint8]], folder: Path, *, name: str) -> list[Picture]:
    """Write RGB images by caption as PNG files, numbered from 1."""
    from matplotlib.image import imsave

    written = []
    for number, (caption, image) in enumerate(pictures.items(), start=1):
        file = f"{name}_{number}.png"
        imsave(folder / file, np.ascontiguousarray(image), format="png")
        title = caption[0].upper() + caption[1:]
        written.append(Picture(file, title, "Drawn with OpenGL: each tip is at a point that its arm reaches."))
    return written


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


def _organ(evaluation: ArmsEvaluation) -> tuple[Patches, FloatArray, float]:
    patches = curved_patches(evaluation.surface_points, evaluation.surface_triangles, 2)
    return patches, np.broadcast_to(TISSUE, (len(patches.corners), 3)), 0.2


def _capsules(ends: FloatArray, radius: FloatArray, colour: str) -> list[tuple[Patches, FloatArray, float]]:
    from matplotlib.colors import to_rgb

    parts = []
    for (start, end), thickness in zip(ends, radius, strict=True):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / max(PIECE, 2.0 * thickness))))
        places = np.linspace(start, end, count + 1)
        for low, high in pairwise(places):
            patches = curved_patches(*tube(low, high, float(thickness)), 1)
            parts.append((patches, np.broadcast_to(np.array(to_rgb(colour)), (len(patches.corners), 3)), 0.3))
    return parts


def _ports(evaluation: ArmsEvaluation) -> list[tuple[Patches, FloatArray, float]]:
    parts = []
    middle = evaluation.surface_points.mean(axis=0)
    for name, port in evaluation.ports.items():
        point, into = np.array(port.point), np.array(port.into) / np.linalg.norm(port.into)
        parts.extend(_capsules(np.stack([[point, point]]), np.array([PORT_RADIUS]), INK))
        if name == "endoscope":
            deep = SCOPE_INSIDE * max(0.0, float((middle - point) @ into))
            ends = np.stack([[point - SCOPE_OUTSIDE * into, point + deep * into]])
            parts.extend(_capsules(ends, np.array([SCOPE_RADIUS]), SCOPE))
    return parts


def _draw(evaluation: ArmsEvaluation, parts: list[tuple[Patches, FloatArray, float]], path: Path) -> None:
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
    """Two views across the endoscope's, in which what lies along it points upwards."""
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
