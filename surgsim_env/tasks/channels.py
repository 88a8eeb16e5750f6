"""Observation channels and reward values shared by tasks."""

import math

from surgsim_env.instruments.instrument import Instrument
from surgsim_env.tasks.declaration import SPEED_FULL_SCALE, Channel, ControlStep
from surgsim_env.tasks.task import Task

# Scale of observed lengths [m], near the radius of a tip.
LENGTH_SCALE = 0.01
# Bounds of the tip beyond its workspace [m] and on its speed [m/s].
POSITION_SLACK = 0.005
SPEED_BOUND = 0.5


def force_scale(task: Task, instrument: Instrument | None) -> float:
    """Scale of observed forces [N]: the scene's soft limit."""
    return task.limits.soft_force


TIP_POSITION = Channel(
    "tip_position", 3, "m",
    low=lambda task, instrument: instrument.lower - POSITION_SLACK,
    high=lambda task, instrument: instrument.upper + POSITION_SLACK,
    read=lambda task, simulation: simulation.instrument.tip_reading,
    meaning="tip position", bounds_text="the organ's bounding box with a margin",
    scale=LENGTH_SCALE, origin=lambda task, instrument: 0.5 * (instrument.lower + instrument.upper),
)  # fmt: skip
TIP_VELOCITY = Channel(
    "tip_velocity", 3, "m/s", -SPEED_BOUND, SPEED_BOUND,
    read=lambda task, simulation: simulation.instrument.tip_velocity,
    meaning="tip velocity", scale=SPEED_FULL_SCALE,
)  # fmt: skip
CONTACT_FORCE = Channel(
    "contact_force", 3, "N", sensor=1.0,
    read=lambda task, simulation: simulation.contact_force,
    meaning="contact force on the tip, mean of the last haptic step, through the sensor model",
    scale=force_scale, scale_text="soft limit",
)  # fmt: skip
TAXELS = Channel(
    "taxels", lambda task: math.prod(task.taxel_shape), "N", taxels=True,
    read=lambda task, simulation: simulation.taxels.ravel(),
    meaning="force on each taxel of the instrument, row by row: along the row, along the column and into the tool, "
    "mean of the last haptic step, through the taxels' sensor model",
    size_text="3 a taxel", scale=force_scale, scale_text="soft limit",
)  # fmt: skip
TIME_LEFT = Channel(
    "time_left", 1, "", 0.0, 1.0,
    read=lambda task, simulation: 1.0 - task.step_count / task.episode_steps,
    meaning="share of the time left",
)  # fmt: skip


def soft_force_share(task: Task, step: ControlStep) -> float:
    """Position of the largest contact force between the soft (0) and the hard limit (1)."""
    return min(max(task.limits.excess(step.force_peak), 0.0), 1.0)
