"""Scripted episodes: steps such as MoveTo and PressUntil, run in an environment, give a Trace in newtons."""

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
    Until,
    View,
    WaitUntil,
)
from surgsim_env.scripting.trace import StepInterval, Trace

__all__ = [
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
    "Until",
    "View",
    "WaitUntil",
    "oracle_script",
    "run_script",
]
