"""surgsim_env: soft organs and robotic instruments as Gymnasium environments; importing it registers their ids."""

from pathlib import Path

import msdm_core
from msdm_core import numba_cache

with numba_cache.kernel_cache(Path(msdm_core.__file__).parent, Path(__file__).parent):
    # First of all: what is compiled is cached where it was decorated.
    from surgsim_env import haptic_kernels, lane_haptic_kernels, visibility_kernels  # noqa: F401
from surgsim_env.rendering.gl import import_mujoco

import_mujoco()
from surgsim_env.arms.arm import load_arm  # noqa: E402
from surgsim_env.arms.description import list_arms  # noqa: E402
from surgsim_env.arms.port import Port  # noqa: E402
from surgsim_env.registration import register  # noqa: E402
from surgsim_env.scenes import list_scenes, make_scene  # noqa: E402

__all__ = ["Port", "list_arms", "list_scenes", "load_arm", "make_scene", "register"]

register()
