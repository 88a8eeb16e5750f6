"""The tasks of docs/tutorials/own_task.md, loaded as a user's own files."""

import re
import sys
import types
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "own_task.md"
IDS = {"trace_path": "MyLab/TracePath-v0", "hold_force": "MyLab/HoldForce-v0"}


def own_task_code(name: str) -> str:
    """The tutorial's file of a module."""
    (code,) = re.findall(
        rf'^```python title="{name}.py"\n(.*?)^```$', PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL
    )
    return code


def load_own_task(name: str = "trace_path") -> str:
    """Run the tutorial's file as a module; returns the id that it registers."""
    module = sys.modules[name] = types.ModuleType(name)
    exec(compile(own_task_code(name), f"{name}.py", "exec"), vars(module))
    return IDS[name]
