"""Scripted episodes: steps such as MoveTo and PressUntil, run in an environment and recorded in a Trace."""

from surgsim_env.scripting.motion_file import TIP_PREFIX, motion_columns, read_motion
from surgsim_env.scripting.observations import selected_observations, stacked_observations
from surgsim_env.scripting.oracle import oracle_script
from surgsim_env.scripting.run import ScriptError, run_script
from surgsim_env.scripting.steps import (
    AwaitEnd,
    CloseJaw,
    Control,
    Declare,
    Follow,
    Hold,
    Lift,
    MayEnd,
    MoveTo,
    OfArm,
    OpenJaw,
    PressSupport,
    PressUntil,
    Script,
    Step,
    StepFailed,
    Tracked,
    Until,
    View,
    WaitUntil,
)
from surgsim_env.scripting.trace import StepInterval, Trace

__all__ = [
    "TIP_PREFIX",
    "AwaitEnd",
    "CloseJaw",
    "Control",
    "Declare",
    "Follow",
    "Hold",
    "Lift",
    "MayEnd",
    "MoveTo",
    "OfArm",
    "OpenJaw",
    "PressSupport",
    "PressUntil",
    "Script",
    "ScriptError",
    "Step",
    "StepFailed",
    "StepInterval",
    "Trace",
    "Tracked",
    "Until",
    "View",
    "WaitUntil",
    "motion_columns",
    "oracle_script",
    "read_motion",
    "run_script",
    "selected_observations",
    "stacked_observations",
]
