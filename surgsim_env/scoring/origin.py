"""Where a score comes from: versions, digests of the environment, of the scores' own code and of the agent's files.

Two results with equal digests of the environment were played on the same organs by the same physics.
"""

import hashlib
import platform
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from surgsim_env.palpation.job import package_version
from surgsim_env.palpation.scores import ERROR_LINE, presses_to_line
from surgsim_env.scene.digest import content_digest
from surgsim_env.scoring.results import SITES, Result
from surgsim_env.training import site_agent

PACKAGES = ("numpy", "mujoco", "gymnasium", "numba")
# Code that plays episodes and computes scores.
SCORING = (Path(__file__).with_name("episodes.py"), Path(site_agent.__file__))
FILE_DIGEST_SIZE = 32
# Of the errors in a file, half of their last digit [m].
ROUNDING = 5e-6


def describe_origin(env: Any, files: Sequence[Path], dtype: str) -> dict[str, Any]:
    """The entry `origin` of a result.

    Args:
        env: a single environment, as it was played.
        files: that the agent consists of; a file is named by its name alone.
        dtype: of the lanes.
    """
    return {
        "versions": versions(),
        "environment": {**env.unwrapped.digests(), "scoring": content_digest(*SCORING)},
        "agent": {path.name: file_digest(path) for path in files},
        "dtype": dtype,
    }


def versions() -> dict[str, str]:
    """Versions of what computes an episode."""
    return {
        "surgsim": package_version(),
        "python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
    }


def file_digest(path: Path) -> str:
    """BLAKE2b of a file, as `b2sum -l 256` prints it."""
    return hashlib.blake2b(path.read_bytes(), digest_size=FILE_DIGEST_SIZE).hexdigest()


def check_origin(result: Result, agent_files: Sequence[Path] = ()) -> Iterator[str]:
    """What speaks against comparing a result with those made here, one sentence each.

    The environment is made again for it; episodes are not played.

    Args:
        result: of a file.
        agent_files: those of the agent that are here; compared by name.
    """
    if not result.origin:
        yield "it names no versions and digests: an earlier version wrote it"
        return
    env = gym.make(result.env_id, **result.env_kwargs)
    here = describe_origin(env, agent_files, result.origin["dtype"])
    env.close()
    for part in ("environment", "versions", "agent"):
        for name, digest in result.origin[part].items():
            own = here[part].get(name)
            if own != digest and not (part == "agent" and own is None):
                yield f"{part}: {name} is {digest}, here {own}"
    yield from _against_itself(result)


def _against_itself(result: Result) -> Iterator[str]:
    """Figures that do not follow from the episodes that the file lists."""
    counted = {"seeds": len(result.seeds), "successes": len(result.successes)}
    if result.env_id == SITES:
        counted |= {"errors_mm": len(result.errors_mm), "lesion_counts": len(result.lesion_counts)}
    if len(set(counted.values())) > 1:
        yield "it lists " + ", ".join(f"{count} {name}" for name, count in counted.items()) + ": one each per episode"
        return
    share = sum(result.successes) / len(result.successes)
    told = {"success": (share, share)}
    if result.env_id == SITES and any(result.lesion_counts):
        errors = 0.001 * np.array(result.errors_mm)[np.array(result.lesion_counts) > 0]
        # Errors are written rounded.
        low, high = (presses_to_line(errors, 50.0, ERROR_LINE + slack) for slack in (ROUNDING, -ROUNDING))
        told["presses_to_median"] = (low, high)
    for name, (low, high) in told.items():
        figure = result.figures[name].value
        if figure is None or not low - 1e-4 <= figure <= high + 1e-4:
            yield f"figure {name} is {figure}; its episodes give {low:.5g}" + f" to {high:.5g}" * (low != high)
