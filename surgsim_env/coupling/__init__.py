"""The force exchange between organ and instrument, the simulation that steps both, and groups of lanes."""

from surgsim_env.coupling import mujoco_library
from surgsim_env.coupling.exchange import haptic_steps
from surgsim_env.coupling.lane_group import core_count
from surgsim_env.coupling.motion import draw_drive, signals
from surgsim_env.coupling.mujoco_library import runs_compiled
from surgsim_env.coupling.sensors import ForceReading
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.coupling.tip_forces import tip_wrench
from surgsim_env.coupling.tracking import SurfaceTracker

__all__ = [
    "ForceReading",
    "Simulation",
    "SurfaceTracker",
    "core_count",
    "draw_drive",
    "haptic_steps",
    "mujoco_library",
    "runs_compiled",
    "signals",
    "tip_wrench",
]
