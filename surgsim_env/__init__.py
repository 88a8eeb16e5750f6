"""surgsim_env: soft organs and robotic instruments as Gymnasium environments; importing it registers their ids."""

import importlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msdm_core
from msdm_core import numba_cache

try:
    # It loads the OpenGL of MUJOCO_GL, which only pictures need: without that, the first picture says why.
    importlib.import_module("mujoco")
except Exception:  # each missing library raises its own type
    if (_opengl := os.environ.get("MUJOCO_GL")) is None:
        raise
    os.environ["MUJOCO_GL"] = "disabled"
    try:
        importlib.import_module("mujoco")
    finally:
        os.environ["MUJOCO_GL"] = _opengl

with numba_cache.kernel_cache(Path(msdm_core.__file__).parent, Path(__file__).parent):
    # Before anything else imports them: compiled code is cached where it was when it was decorated.
    from surgsim_env.coupling import haptic_kernels  # noqa: F401
    from surgsim_env.instruments import mujoco_kernels, tool_kernels  # noqa: F401
    from surgsim_env.tasks import visibility_kernels  # noqa: F401
from msdm_core.errors import MeshError, OrganDivergedError, OrganError
from msdm_core.organ.support import Support
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.envs.ids import register, register_task
from surgsim_env.envs.surgical_env import SurgicalEnv
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import (
    list_arms,
    list_materials,
    list_scenes,
    load_scene,
    make_material,
    make_scene,
)
from surgsim_env.scene.model import Port, Scene
from surgsim_env.tasks.bimanual_retract import BimanualRetractTask
from surgsim_env.tasks.channels import CONTACT_FORCE, TAXELS, TIME_LEFT, TIP_POSITION, TIP_VELOCITY
from surgsim_env.tasks.declaration import Channel, Command, ControlStep, Reward, Setup
from surgsim_env.tasks.palpate import PalpateTask
from surgsim_env.tasks.palpate_sites import PalpateSitesTask
from surgsim_env.tasks.retract import RetractTask
from surgsim_env.tasks.slide import SlideTask
from surgsim_env.tasks.task import Task

if TYPE_CHECKING:
    from surgsim_env import scripting
    from surgsim_env.envs.bimanual_parallel import BimanualRetractParallelEnv
    from surgsim_env.envs.stable_baselines import VectorEnvForStableBaselines
    from surgsim_env.instruments.arm.arm import load_arm
    from surgsim_env.rendering.gl import NoGLError
    from surgsim_env.rendering.options import RenderOptions

__all__ = [
    "CONTACT_FORCE",
    "TAXELS",
    "TIME_LEFT",
    "TIP_POSITION",
    "TIP_VELOCITY",
    "BimanualRetractParallelEnv",
    "BimanualRetractTask",
    "Channel",
    "Command",
    "ControlStep",
    "MeshError",
    "NoGLError",
    "OrganDivergedError",
    "OrganError",
    "PalpateSitesTask",
    "PalpateTask",
    "Port",
    "RenderOptions",
    "RetractTask",
    "Reward",
    "Scene",
    "Setup",
    "Simulation",
    "SlideTask",
    "Support",
    "SurgicalEnv",
    "Task",
    "VectorEnvForStableBaselines",
    "list_arms",
    "list_materials",
    "list_scenes",
    "load_anatomy",
    "load_arm",
    "load_scene",
    "make_material",
    "make_scene",
    "register",
    "register_task",
    "scripting",
]

# Imported on first use: they need extras, or time that `import surgsim_env` should not take.
_LAZY = {
    "BimanualRetractParallelEnv": "surgsim_env.envs.bimanual_parallel",
    "NoGLError": "surgsim_env.rendering.gl",
    "RenderOptions": "surgsim_env.rendering.options",
    "VectorEnvForStableBaselines": "surgsim_env.envs.stable_baselines",
    "load_arm": "surgsim_env.instruments.arm.arm",
}
_EXTRAS = {"BimanualRetractParallelEnv": "pettingzoo", "VectorEnvForStableBaselines": "agents"}


def __getattr__(name: str) -> Any:
    if name == "scripting":
        return importlib.import_module("surgsim_env.scripting")
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = importlib.import_module(_LAZY[name])
    except ModuleNotFoundError as error:
        if name not in _EXTRAS:
            raise
        missing = (error.name or "").partition(".")[0]
        text = f"surgsim_env.{name} needs {missing}: pip install 'surgsim[{_EXTRAS[name]}]'"
        raise ImportError(text, name=missing) from None
    return getattr(module, name)


register()
