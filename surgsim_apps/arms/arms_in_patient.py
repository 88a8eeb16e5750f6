"""Two arms at a point of an organ: a scene that turns."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.ports import Ports
from surgsim_apps.arms.reach import BothArms
from surgsim_apps.arms.reach_kinds import PORT_COLOURS, REACH_KINDS, reach_kinds
from surgsim_apps.arms.results import ArmsEvaluation
from surgsim_apps.arms.wording import share_text
from surgsim_apps.reports.surface_drawing import INK, OrthographicView
from surgsim_apps.reports.turning_scene import SolidPart, TurningScene, capsules_part, marks_part, turning_scene
from surgsim_env.instruments import SIDES, Arm
from surgsim_env.scene import tangent_axes

ORGAN, WALL, OBSTACLE, GIVEN = "#b8584a", "#d9a68c", "#8c8c8c", "#f0e442"
ORGAN_OPACITY, WALL_OPACITY, SKIN_OPACITY = 0.6, 0.3, 0.15
SCOPE_RADIUS, PORT_RADIUS = 0.005, 0.008
# Length of the drawn endoscope outside its port, and of the drawn wall beyond the ports [m].
SCOPE_OUTSIDE, WALL_BEYOND = 0.18, 0.05
# Points with a mark in the scene, spread over the organ, and radius of a mark over their usual spacing.
MARKS_MOST, MARK_SHARE = 1000, 0.18


@dataclass(frozen=True)
class ArmsInPatient:
    """Two arms in a patient.

    Fields:
        evaluation: of both
        arms: left and right
        joints: of each [rad or m]
        ports: theirs and the endoscope's
        given: other ports, to show beside them
    """

    evaluation: ArmsEvaluation
    arms: tuple[Arm, ...]
    joints: tuple[FloatArray, ...]
    ports: Ports
    given: Ports | None = None

    @classmethod
    def at_middle(
        cls, evaluation: ArmsEvaluation, arms: tuple[Arm, ...], both: BothArms, ports: Ports, given: Ports | None = None
    ) -> "ArmsInPatient":
        """Both tips at a point that both reach at once, nearest to the middle of these; without one both at home."""
        rows = np.flatnonzero(both.reachable & ~evaluation.inner)
        if not rows.size:
            return cls(evaluation, arms, tuple(arm.home for arm in arms), ports, given)
        points = evaluation.points[rows]
        row = rows[np.linalg.norm(points - points.mean(axis=0), axis=1).argmin()]
        joints = tuple(values[row] for values in both.joints)
        return cls(evaluation, arms, joints, ports, given)

    def scene(self) -> TurningScene:
        """A scene that turns: organ, points in the colours of REACH_KINDS, arms as they are evaluated, ports, wall."""
        evaluation, wall, parts = self.evaluation, self.ports.wall, []
        spacing = KDTree(evaluation.points[:MARKS_MOST]).query(evaluation.points[:MARKS_MOST], k=2)[0][:, 1]
        radius = MARK_SHARE * float(np.median(spacing))
        for index, kind in enumerate(REACH_KINDS):
            of_kind = reach_kinds(evaluation) == index
            for name, mask, size in (
                (kind.name, of_kind & ~evaluation.inner & (np.arange(len(of_kind)) < MARKS_MOST), radius),
                (f"{kind.name}, targets inside", of_kind & evaluation.inner, 2.0 * radius),
            ):
                if mask.any():
                    parts.append(marks_part(name, evaluation.points[mask], size, kind.colour))
        for side, arm, ends in zip(SIDES, self.arms, self._shape_ends(), strict=True):
            parts.append(capsules_part(f"{side} arm", ends, arm.shape_radius, PORT_COLOURS[side]))
        for name, ends, radius, colour in self._endoscope_and_ports():
            parts.append(capsules_part(name, [ends], [radius], colour))
        if self.given is not None:
            for name, port in self.given.frames.items():
                parts.append(marks_part(f"given {name} port", np.array([port.point]), PORT_RADIUS, GIVEN))
        parts.append(SolidPart("organ", evaluation.surface_points, evaluation.surface_triangles, ORGAN, ORGAN_OPACITY))
        if self.ports.has_dome:
            parts.append(self._dome())
        if wall.skin is not None:
            parts.append(SolidPart("body wall", *wall.skin.read(), WALL, SKIN_OPACITY))
        for source in self.ports.obstacles:
            parts.append(SolidPart(Path(source.file).stem, *source.read(), OBSTACLE))
        away, up = self._view()
        view, outer = OrthographicView.along(-away, up), ~evaluation.inner
        legend = [
            (f"{kind.name}: {share_text(reach_kinds(evaluation)[outer] == index)}", kind.colour)
            for index, kind in enumerate(REACH_KINDS)
        ]
        description = (
            "Both arms with their tips at a point that both reach, or at home without one, as the shapes that are "
            "evaluated, in the colours of what each reaches alone. Yellow: given ports, where others are reported."
        )
        return turning_scene(parts, view, description, legend)

    def _dome(self) -> SolidPart:
        """The part of the dome around the ports."""
        from trimesh.creation import revolve

        out, radius = self.ports.wall_normal, self.ports.wall.radius
        beside = 0.5 * math.dist(self.ports.left.point, self.ports.right.point) + WALL_BEYOND
        angle = np.linspace(math.asin(min(beside / radius, 1.0)), 0.0, 12)
        cap = revolve(radius * np.stack([np.sin(angle), np.cos(angle)], axis=1), sections=64)
        points = self.ports.dome_centre + cap.vertices @ np.stack([*tangent_axes(-out), out])
        return SolidPart("body wall", points, np.asarray(cap.faces, dtype=np.int32), WALL, WALL_OPACITY)

    def _endoscope_and_ports(self) -> list[tuple[str, FloatArray, float, str]]:
        """Capsules: name, ends (2, 3) and radius [m], colour."""
        ports = self.evaluation.ports
        capsules = [
            (f"{name} port", np.stack([np.array(port.point)] * 2), PORT_RADIUS, PORT_COLOURS[name])
            for name, port in ports.items()
        ]
        point, into = np.array(ports["endoscope"].point), np.array(ports["endoscope"].into)
        outside = point - SCOPE_OUTSIDE * into / np.linalg.norm(into)
        return [*capsules, ("endoscope", np.stack([outside, point]), SCOPE_RADIUS, INK)]

    def _shape_ends(self) -> list[FloatArray]:
        return [arm.shape_ends(joints) for arm, joints in zip(self.arms, self.joints, strict=True)]

    def _view(self) -> tuple[FloatArray, FloatArray]:
        """Towards the viewer beside the table, on the side away from the arms' bases, and up."""
        line, up = np.array(self.ports.right.point) - np.array(self.ports.left.point), self.ports.wall_normal
        away = np.cross(line, up) / np.linalg.norm(line)
        ends = np.concatenate([ends.reshape(-1, 3) for ends in self._shape_ends()])
        if (ends.mean(axis=0) - self.evaluation.surface_points.mean(axis=0)) @ away > 0.0:
            away = -away
        return 0.88 * away + 0.48 * up, up
