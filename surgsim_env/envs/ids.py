"""The environments' ids: the shipped classes, and environments of a user's own tasks."""

import copyreg
import os
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from surgsim_env.envs.palpate_sites_env import PalpateSitesEnv
from surgsim_env.envs.surgical_env import SurgicalEnv
from surgsim_env.tasks.bimanual_retract import BimanualRetractTask
from surgsim_env.tasks.palpate import PalpateTask
from surgsim_env.tasks.palpate_sites import PalpateSitesTask
from surgsim_env.tasks.retract import RetractTask
from surgsim_env.tasks.slide import SlideTask
from surgsim_env.tasks.task import Task

# The task of each registered id.
TASKS: dict[str, type[Task]] = {}


class PalpateEnv(SurgicalEnv):
    """SurgSim/Palpate-v0."""

    task_class = PalpateTask
    task: PalpateTask


class RetractEnv(SurgicalEnv):
    """SurgSim/Retract-v0."""

    task_class = RetractTask
    task: RetractTask


class BimanualRetractEnv(SurgicalEnv):
    """SurgSim/BimanualRetract-v0."""

    task_class = BimanualRetractTask
    task: BimanualRetractTask


class Arguments(dict[str, Any]):
    """Arguments of a spec: those of `gym.make` and `gym.make_vec` enter in the form that `EnvSpec.to_json` takes."""

    def update(self, *others: Any, **arguments: Any) -> None:
        """As of any dictionary, with paths, modes of autoreset and `dtype` as text, numpy's numbers as Python's."""
        super().update({name: _plain(name, value) for name, value in dict(*others, **arguments).items()})


def _plain(name: str, value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, AutoresetMode):
        return value.value
    if name == "dtype" and isinstance(value, type | np.dtype):
        return np.dtype(value).name
    return value.item() if isinstance(value, np.generic) else value


def register_task(id: str, task_class: type[Task], *, lanes: bool = True) -> None:
    """Make a task a Gymnasium environment: `gym.make(id)`, and `gym.make_vec(id, ...)` for many side by side.

    The environment takes the arguments of `SurgicalEnv` and the task's own. Registering an id again replaces it, so
    that its file can be reloaded.

    Args:
        id: "Namespace/Name-v0".
        task_class: declares channels and rewards (`surgsim_env.Task`).
        lanes: whether its instrument can act in many environments side by side: one arm can, a pair cannot.
    """
    TASKS[id] = task_class
    gym.registry.pop(id, None)
    gym.register(
        id=id,
        entry_point=f"surgsim_env.envs.ids:{id}",
        vector_entry_point=f"surgsim_env.envs.vector_env:{id}" if lanes else None,
        max_episode_steps=task_class.setup.episode_steps,
        kwargs=Arguments(),
    )


def __getattr__(name: str) -> Any:
    """The environment class of a task of a user's own, whose entry point has its id as the name."""
    if name not in TASKS:
        hint = "; register_task has not run for it in this process: import the file that calls it" * ("/" in name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
    return environment_class(TASKS[name])


@cache
def environment_class(task_class: type[Task]) -> type[SurgicalEnv]:
    """The environment class of a task: a shipped one, or a new one."""
    for shipped in (PalpateEnv, RetractEnv, BimanualRetractEnv, PalpateSitesEnv):
        if shipped.task_class is task_class:
            return shipped
    name = task_class.__name__.removesuffix("Task") + "Env"
    made = type(name, (SurgicalEnv,), {"task_class": task_class, "__module__": task_class.__module__})
    copyreg.pickle(made, _pickled)  # no module has the class under its name; subclasses have modules of their own
    return made


def _pickled(env: SurgicalEnv) -> tuple[Any, ...]:
    """An environment of `environment_class`, by its task's class."""
    return _blank, (type(env).task_class,), vars(env)


def _blank(task_class: type[Task]) -> SurgicalEnv:
    return object.__new__(environment_class(task_class))


def register() -> None:
    """Register the shipped ids with Gymnasium; importing `surgsim_env` does it."""
    register_task("SurgSim/Palpate-v0", PalpateTask)
    register_task("SurgSim/Retract-v0", RetractTask)
    register_task("SurgSim/BimanualRetract-v0", BimanualRetractTask, lanes=False)
    register_task("SurgSim/PalpateSites-v0", PalpateSitesTask)
    register_task("SurgSim/Slide-v0", SlideTask)
