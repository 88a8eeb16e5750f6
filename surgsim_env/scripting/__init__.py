"""Scripted episodes: steps such as MoveTo and PressUntil, run in an environment, give a Trace in newtons."""

from surgsim_env.scripting.oracle import oracle_script
from surgsim_env.scripting.run import ScriptError, run_script
from surgsim_env.scripting.steps import (
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
from surgsim_env.scripting.trace import StepInterval, Trace
from surgsim_env.scripting.view import View

__all__ = [
    "Control",
    "Declare",
    "Hold",
    "Lift",
    "MoveTo",
    "PressUntil",
    "Script",
    "ScriptError",
    "Step",
    "StepFailed",
    "StepInterval",
    "Trace",
    "View",
    "WaitUntil",
    "oracle_script",
    "run_script",
]
