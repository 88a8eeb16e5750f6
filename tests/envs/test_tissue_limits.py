"""Limits on what tissue bears, in `info` and as the end of an episode."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from msdm_core.material import Stiffening
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.save import as_toml

DOWN = np.array([0.0, 0.0, -1.0], dtype=np.float32)


def made(tmp_path, **limits):
    scene = make_scene("phantom_small")
    path = tmp_path / "limited.toml"
    path.write_text(as_toml(replace(scene, limits=replace(scene.limits, **limits))))
    return gym.make("SurgSim/Palpate-v0", scene=str(path))


def pressed(env, steps=60):
    """Press down until the episode ends, and one info per control step."""
    env.reset(seed=0)
    infos = []
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    action[:3] = DOWN
    for _ in range(steps):
        _, reward, terminated, truncated, info = env.step(action)
        infos.append((reward, info))
        if terminated or truncated:
            break
    return infos


def test_an_infinite_limit_measures_only(tmp_path):
    infos = pressed(made(tmp_path, strain=np.inf))
    assert infos[-1][1]["hard_limit"] and not infos[-1][1]["damaged"]
    strains = [info["tissue_strain"] for _, info in infos]
    pressures = [info["tissue_pressure"] for _, info in infos]
    assert strains[0] < 0.01 < 0.1 < max(strains) and max(pressures) > 1000.0


def test_a_strain_beyond_the_law_is_extrapolated(tmp_path):
    """The flag follows the scene's bound, and is never set where the material has none."""
    scene = make_scene("phantom_small")
    law = Stiffening(0.1, 0.3, 2.0, strain_supported=0.12)
    path = tmp_path / "supported.toml"
    limits, material = replace(scene.limits, strain=np.inf), replace(scene.material, stiffening=law)
    path.write_text(as_toml(replace(scene, limits=limits, material=material)))
    infos = [info for _, info in pressed(gym.make("SurgSim/Palpate-v0", scene=str(path)))]
    flags = [info["tissue_extrapolated"] for info in infos]
    # Tissue is softest to shear: its equivalent strain is within a fifth of the principal strain.
    assert all(flag for flag, info in zip(flags, infos) if info["tissue_strain"] > 1.2 * 0.12)
    assert not any(flag for flag, info in zip(flags, infos) if info["tissue_strain"] < 0.12 / 1.2)
    assert {*flags} == {False, True}
    assert not any(info["tissue_extrapolated"] for _, info in pressed(made(tmp_path, strain=np.inf)))


@pytest.mark.parametrize(
    ("limit", "entry"), [({"strain": 0.15}, "tissue_strain"), ({"pressure": 1500.0}, "tissue_pressure")]
)
def test_too_much_ends_the_episode_as_a_safety_stop(tmp_path, limit, entry):
    infos = pressed(made(tmp_path, **limit))
    (most,) = limit.values()
    assert [info["damaged"] for _, info in infos] == [False] * (len(infos) - 1) + [True]
    assert infos[-1][1][entry] > most >= max(info[entry] for _, info in infos[:-1])
    assert not infos[-1][1]["hard_limit"] and not infos[-1][1]["success"]
    assert infos[-1][0] < -1.0
