"""What trainers rely on: `is_success` at each end, specs as JSON for every argument, ids without an import."""

import inspect
import subprocess
import sys
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

from surgsim_env.envs.ids import TASKS, register_task
from surgsim_env.envs.surgical_env import SurgicalEnv
from surgsim_env.envs.vector_env import LaneVectorEnv
from surgsim_env.rendering.options import RenderOptions
from surgsim_env.scene.load import scenes_folder
from surgsim_env.tasks.runtime import setting_names
from tests.envs.own_task import load_own_task
from tests.envs.walks import rollout

OWN = load_own_task()
IDS = [*sorted(env_id for env_id in gym.registry if env_id.startswith("SurgSim/")), OWN]
LANES = [env_id for env_id in IDS if gym.spec(env_id).vector_entry_point]
SMALL = {"scene": scenes_folder() / "organs" / "phantom_small.toml"}
SCENES = {env_id: {} if "Retract" in env_id else SMALL for env_id in IDS}


def end_all_with(name: str, env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make an environment's next control step the last, with an end of a name."""
    monkeypatch.setattr(env.task, "end", lambda step: name)
    monkeypatch.setattr(env.task, "_error", 0.0, raising=False)


def successes(env_id: str) -> list[str]:
    return [term.name for term in TASKS[env_id].rewards if term.per == "success"]


@pytest.mark.parametrize("env_id", IDS)
def test_each_last_info_says_whether_it_is_a_success(env_id, monkeypatch):
    env = gym.make(env_id, **SCENES[env_id])
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    ends = {"success": True, **dict.fromkeys(successes(env_id), True), "hard_force": False, "": False}
    for name, expected in ends.items():
        _, info = env.reset(seed=1)
        assert info["is_success"] is False
        end_all_with(name, env.unwrapped, monkeypatch)
        _, _, terminated, _, info = env.step(still)
        assert terminated is bool(name) and info["is_success"] is info["success"] is expected, name


@pytest.mark.parametrize("mode", ["vector_entry_point", "sync"])
@pytest.mark.parametrize("env_id", LANES)
def test_final_info_says_it_of_each_lane(env_id, mode, monkeypatch):
    same = {"autoreset_mode": "SameStep"}
    given = same if mode == "vector_entry_point" else {"vector_kwargs": same}
    envs = gym.make_vec(env_id, num_envs=3, vectorization_mode=mode, **given, **SCENES[env_id])
    envs.reset(seed=1)
    for lane, name in ((1, "hard_force"), (2, "success")):
        end_all_with(name, envs.envs[lane].unwrapped, monkeypatch)
    *_, terminated, _, infos = envs.step(np.zeros(envs.action_space.shape, dtype=np.float32))
    assert terminated.tolist() == infos["_final_info"].tolist() == [False, True, True]
    assert infos["final_info"]["is_success"].tolist() == [False, False, True]
    envs.close()


# ---- specs -----------------------------------------------------------------------------------------------------------

# A value of each argument that is not its default, in any form that the environment takes.
VALUES = {
    **SMALL,
    "instrument": scenes_folder() / "instruments" / "psm_palpator.toml",
    "obs_mode": "state",
    "scaled": np.False_,
    "observe_force": False,
    "looks": "test",
    "measure_tissue": True,
    "render_mode": "rgb_array",
    "camera": "side",
    "width": np.int64(64),
    "height": 48,
    "show_force": False,
    "show_lesion": True,
    "cut_away": True,
    "smooth_edges": False,
    "paint": "stress",
    "style": "plain",
    "motion": "calm",
    "level": "hard",
    "split": None,
    "control_step": np.float64(0.1),
    "shaping": np.float64(10.0),
    "failure_share": 0.5,
    "memory": np.True_,
    "frame": "face",
    "face": True,
    "episode_steps": np.int32(50),
    "budget": np.int64(12),
    "track_motion": False,
    # Of vector environments.
    "num_envs": 2,
    "autoreset_mode": AutoresetMode.SAME_STEP,
    "dtype": np.float32,
    "threads": np.int64(1),
    "max_episode_steps": 7,
}
OTHERS = {
    "SurgSim/Palpate-v0": {"scene": scenes_folder() / "organs" / "kidney_family.toml", "split": "test"},
    # Without a potential.
    "SurgSim/PalpateSites-v0": {"shaping": 0.0},
    "SurgSim/Slide-v0": {"shaping": 0.0},
    "SurgSim/Retract-v0": {
        "shaping": 0.0,
        "scene": scenes_folder() / "organs" / "lobe.toml",
        "instrument": scenes_folder() / "instruments" / "psm_retractor.toml",
        "level": None,
    },
    "SurgSim/BimanualRetract-v0": {
        "shaping": 0.0,
        "scene": scenes_folder() / "organs" / "lobe.toml",
        "instrument": "psm_pair",
        "level": None,
    },
    OWN: {"level": None, "shaping": 0.0},
}


def names(function: Any) -> set[str]:
    """Names of a function's arguments."""
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    return {name for name, given in inspect.signature(function).parameters.items() if given.kind in kinds} - {"self"}


def arguments(env_id: str, *more: Any) -> dict[str, Any]:
    """A value of each argument that an id takes; a KeyError names one without."""
    taken = {field.name for field in fields(RenderOptions)} | setting_names(TASKS[env_id])
    for function in (SurgicalEnv.__init__, *more):
        taken |= names(function)
    return {name: {**VALUES, **OTHERS.get(env_id, {})}[name] for name in sorted(taken)}


@pytest.mark.parametrize("env_id", IDS)
def test_a_spec_holds_every_argument_as_json(env_id):
    given = arguments(env_id)
    env = gym.make(env_id, **given)
    spec = EnvSpec.from_json(env.spec.to_json())
    assert spec == env.spec and spec.kwargs.keys() == given.keys()
    assert spec.kwargs["scene"] == str(given["scene"]) and spec.kwargs["width"] == 64
    again = gym.make(spec)
    for record, other in zip(rollout(env, seed=3, steps=3), rollout(again, seed=3, steps=3), strict=True):
        assert record[0].tobytes() == other[0].tobytes() and record[1:] == other[1:]
    assert env.unwrapped.save_state() == again.unwrapped.save_state()


class Side(Enum):
    LEFT = "left"


@dataclass
class ScenePath:
    """A path of another library's class."""

    path: Path = SMALL["scene"]

    def __fspath__(self) -> str:
        return str(self.path)


class Sided(TASKS[OWN]):  # type: ignore[misc]
    """A task with arguments of its own."""

    def __init__(self, scenario: Any, *, side: Any = None, kind: Any = None) -> None:
        super().__init__(scenario)
        self.given = side, kind


def test_a_task_takes_its_own_arguments_as_they_are(monkeypatch):
    monkeypatch.setitem(gym.registry, "Test/Sided-v0", None)
    register_task("Test/Sided-v0", Sided)
    env = gym.make("Test/Sided-v0", scene=ScenePath(), side=Side.LEFT, kind=ScenePath)
    assert env.unwrapped.task.given == (Side.LEFT, ScenePath)
    env = gym.make("Test/Sided-v0", scene=ScenePath(), side="left")
    assert EnvSpec.from_json(env.spec.to_json()).kwargs == {"scene": str(SMALL["scene"]), "side": "left"}


@pytest.mark.parametrize("env_id", LANES)
def test_the_spec_of_lanes_does_too(env_id):
    envs = gym.make_vec(env_id, vectorization_mode="vector_entry_point", **arguments(env_id, LaneVectorEnv.__init__))
    spec = EnvSpec.from_json(envs.spec.to_json())
    assert spec == envs.spec
    again = gym.make_vec(spec)
    assert again.num_envs == 2 and again.metadata == envs.metadata
    still = np.zeros(envs.action_space.shape, dtype=np.float32)
    for other in (envs, again):
        other.reset(seed=3)
    np.testing.assert_array_equal(envs.step(still)[0], again.step(still)[0])


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_the_spec_of_environments_in_gymnasiums_vectors_does_too(mode):
    scene = scenes_folder() / "organs" / "lobe.toml"
    envs = gym.make_vec("SurgSim/BimanualRetract-v0", num_envs=2, vectorization_mode=mode, scene=scene)
    again = gym.make_vec(EnvSpec.from_json(envs.spec.to_json()))
    np.testing.assert_array_equal(envs.reset(seed=1)[0], again.reset(seed=1)[0])
    envs.close()
    again.close()


# ---- without an import -----------------------------------------------------------------------------------------------


def test_an_id_with_its_module_and_a_spec_need_no_import():
    """In a process of its own, in which nothing has imported the package."""
    code = """
import sys, gymnasium as gym
from gymnasium.envs.registration import EnvSpec
assert "surgsim_env" not in sys.modules
text = sys.argv[1]
env = gym.make(EnvSpec.from_json(text)) if text.startswith("{") else gym.make(text, scene="phantom_small")
print(env.reset(seed=1)[0].tobytes().hex())
envs = gym.make_vec("surgsim_env:SurgSim/Palpate-v0", num_envs=2, scene="phantom_small")
print(type(envs).__name__)
"""
    env = gym.make("SurgSim/Palpate-v0", scene="phantom_small")
    expected = [env.reset(seed=1)[0].tobytes().hex(), "PalpateVectorEnv"]
    for text in ("surgsim_env:SurgSim/Palpate-v0", env.spec.to_json()):
        done = subprocess.run([sys.executable, "-c", code, text], capture_output=True, text=True, timeout=600)
        assert done.stdout.split() == expected, done.stderr
