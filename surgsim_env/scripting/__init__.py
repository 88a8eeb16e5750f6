"""Scripted episodes: steps such as MoveTo and PressUntil, run in an environment, give a Trace in newtons."""

from surgsim_env.scripting.jaw_steps import CloseJaw, OpenJaw
from surgsim_env.scripting.oracle import oracle_script
from surgsim_env.scripting.run import ScriptError, run_script
from surgsim_env.scripting.steps import (
    AwaitEnd,
    Control,
    Declare,
    Hold,
    Lift,
    MoveTo,
    PressUntil,
    Script,
    Step,
    StepFailed,
    WaitUntil,
)
from surgsim_env.scripting.support_steps import PressSupport
from surgsim_env.scripting.trace import StepInterval, Trace
from surgsim_env.scripting.view import View
from surgsim_env.scripting.wrapped_steps import MayEnd, OfArm, Until

__all__ = [
    "AwaitEnd",
    "CloseJaw",
    "Control",
    "Declare",
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
