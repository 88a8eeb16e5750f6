"""Whether control steps run in one compiled call or in the plain Python loop; the bits are the same."""

import os
import warnings
from functools import cache

from surgsim_env import mujoco_library

# "python": control steps run in the plain loop, as they do by themselves where MuJoCo's functions cannot be linked.
LOOP_VARIABLE = "SURGSIM_LOOP"


def runs_compiled() -> bool:
    """Whether a new simulation runs compiled, by the environment's variable and by what can be linked.

    Raises:
        ValueError: the variable has another value than its two.
    """
    loop = os.environ.get(LOOP_VARIABLE, "compiled")
    if loop not in ("compiled", "python"):
        raise ValueError(f'{LOOP_VARIABLE} is {loop!r}; it is "compiled" or "python"')
    return loop == "compiled" and not _warn_of_missing_library(mujoco_library.missing())


@cache
def _warn_of_missing_library(missing: str) -> bool:
    """Say once that, and why, control steps run in the plain loop; False where nothing is missing."""
    if missing:
        warnings.warn(f"control steps run in the plain Python loop, more slowly: {missing}", RuntimeWarning, 2)
    return bool(missing)
