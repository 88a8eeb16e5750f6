"""A played press on an organ that moves: how far control lets the shaft leave its trocar while the tip goes along."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from surgsim_env.arm_study.results import ArmsEvaluation, Tell
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.arm.arm import Arm
from surgsim_env.palpation.press import PressPhase, SitePress, press_phases
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.load import with_instrument
from surgsim_env.scene.model import CyclicMotion


@dataclass(frozen=True)
class TrackedPress:
    """A press by one arm with the organ's moving surface, held for a whole cycle; NaN where nothing was measured.

    Fields:
        side: of the arm
        arm: its name
        point: that was pressed, -1 without a press
        duration: [s]
        trocar_error: largest distance of the shaft's axis from the trocar at the end of any control step [m]
        force_peak: largest contact force in any haptic step [N]
        left_out: why nothing was played; "" where a press was
        end: why it ended early; "" where it did not
    """

    side: str
    arm: str
    point: int = -1
    duration: float = math.nan
    trocar_error: float = math.nan
    force_peak: float = math.nan
    left_out: str = ""
    end: str = ""

    @property
    def text(self) -> str:
        """In a sentence."""
        if self.left_out:
            return f"No press was played with the {self.side} arm, {self.arm}: {self.left_out}."
        ended = f", which ended early ({self.end})" if self.end else ""
        return (
            f"The {self.side} arm, {self.arm}, pressed point {self.point} while the organ moved, its tip going with "
            f"the surface as markers show it, for {self.duration:.1f} s{ended}: the shaft's axis left the trocar by "
            f"{self.trocar_error * 1e3:.3f} mm at the most, the largest contact force was {self.force_peak:.2f} N. The "
            "force on the trocar is not computed: in the simulation the trocar bears none."
        )


def tracked_presses(
    sources: tuple[str, str], arms: tuple[Arm, Arm], evaluation: ArmsEvaluation, anatomy: Anatomy, tell: Tell
) -> list[TrackedPress]:
    """A press by each arm; none by one whose mechanism keeps the shaft in the trocar, none for a still patient.

    Args:
        sources: the left and the right arm's name or TOML file.
        arms: these arms at their ports.
        evaluation: theirs.
        anatomy: of the organ.
        tell: called with the current work and the share of the whole that is done.
    """
    if evaluation.cycle is None:
        return []
    presses = []
    for (side, follower), source, arm in zip(evaluation.cycle.arms, sources, arms, strict=True):
        name = arm.description.name
        if arm.remote_centre_fixed:
            presses.append(TrackedPress(side, name, left_out="its mechanism keeps the shaft in the trocar"))
            continue
        rows = np.flatnonzero(follower.follows & ~evaluation.inner)
        if not rows.size:
            presses.append(TrackedPress(side, name, left_out="it can follow no point"))
            continue
        middle = evaluation.points[rows].mean(axis=0)
        point = int(rows[np.argmin(np.linalg.norm(evaluation.points[rows] - middle, axis=1))])
        tell(f"a press by the {side} arm on the moving organ", 0.0)
        try:
            simulation = Simulation(_pressed_by(anatomy, source, arm))
            presses.append(_played(simulation, TrackedPress(side, name, point), evaluation, tell))
        except ValueError as error:
            presses.append(TrackedPress(side, name, left_out=" ".join(str(error).split())))
    return presses


def plain_presses(presses: Sequence[TrackedPress]) -> dict[str, Any]:
    """The entry `tracked_presses` of summary.json, SI units; empty for a patient who holds still."""
    return {"tracked_presses": [asdict(one) for one in presses]} if presses else {}


def _pressed_by(anatomy: Anatomy, source: str, arm: Arm) -> Anatomy:
    """The anatomy with an arm at its port, each motion always in its largest and quickest cycle."""
    motions = tuple(_largest(one) for one in anatomy.scene.motions)
    # A file is that of the command, not one of the same name beside the scene.
    scene = with_instrument(anatomy.scene, str(Path(source).resolve()) if Path(source).suffix == ".toml" else source)
    return replace(anatomy, scene=replace(scene, port=arm.port, motions=motions))


def _largest(motion: CyclicMotion) -> CyclicMotion:
    size, period = motion.size[1], motion.period[0]
    return replace(motion, size=(size, size), period=(period, period), variation=0.0)


def _played(simulation: Simulation, planned: TrackedPress, evaluation: ArmsEvaluation, tell: Tell) -> TrackedPress:
    """A press that is held for a whole cycle."""
    scene, cycle = simulation.anatomy.scene, evaluation.cycle
    assert cycle is not None
    timing, cycle_time = scene.timing, float(cycle.period[0])
    count = timing.haptic_steps_per_control
    hold = PressPhase(count, False, scene.limits.hard_force, read=True, command=count)
    phases = [one for one in press_phases(scene) if one.inward]
    phases += [hold] * math.ceil(cycle_time / timing.control_step)
    # Before its first cycle a motion rests for up to one period.
    press = SitePress(
        simulation, evaluation.points[planned.point], evaluation.normals[planned.point], elapsed=cycle_time
    )
    missed = float(simulation.instrument.trocar_residual or 0.0)
    for number, phase in enumerate(phases):
        if press.begin(phase):
            press.end(phase, simulation.control_step(phase.count, phase.force_limit))
            missed = max(missed, float(simulation.instrument.trocar_residual or 0.0))
        tell(f"a press by the {planned.side} arm on the moving organ", number / len(phases))
    result, end = press.result(), simulation.fault
    if not end and press.force_peak > scene.limits.hard_force:
        end = f"force limit {scene.limits.hard_force:g} N"
    return replace(planned, duration=result.duration, trocar_error=missed, force_peak=result.force_peak, end=end)
