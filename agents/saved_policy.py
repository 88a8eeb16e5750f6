"""A trained policy on disk: NAME.zip as stable-baselines3 saves it, and NAME_normalisation.pkl beside it.

Both are pickles: loading one runs what it says. Load only those that you trust.
"""

import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import sb3_contrib
import stable_baselines3
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "PPO": stable_baselines3.PPO,
    "SAC": stable_baselines3.SAC,
    "RecurrentPPO": sb3_contrib.RecurrentPPO,
}


@dataclass
class SavedPolicy:
    """A model, and what its observations go through first (nothing where `normalisation` is None)."""

    model: BaseAlgorithm
    normalisation: VecNormalize | None
    memory: Any = None

    def act(
        self, observations: NDArray[np.floating], begun: NDArray[np.bool_], *, deterministic: bool = True
    ) -> NDArray[np.float32]:
        """Actions (n_env, n_action) for observations (n_env, n_observation), as the environments give them.

        Args:
            observations: of all environments.
            begun: shape (n_env,), whose episode begins with this observation: a recurrent policy forgets there.
            deterministic: the mean action, rather than one drawn around it.
        """
        seen = observations if self.normalisation is None else self.normalisation.normalize_obs(observations)
        actions, self.memory = self.model.predict(
            seen, state=self.memory, episode_start=begun, deterministic=deterministic
        )
        return actions


def normalisation_path(path: str | Path) -> Path:
    """Where the normalisation of a policy's file lies."""
    path = Path(path)
    return path.with_name(f"{path.stem}_normalisation.pkl")


def save_policy(model: BaseAlgorithm, normalisation: VecNormalize | None, path: str | Path) -> None:
    """Write NAME.zip, and NAME_normalisation.pkl where there is one."""
    path = Path(path).with_suffix(".zip")
    path.parent.mkdir(parents=True, exist_ok=True)
    model.save(path)
    normalisation_path(path).unlink(missing_ok=True)
    if normalisation is not None:
        normalisation.save(str(normalisation_path(path)))


def load_policy(path: str | Path, algorithm: str | None = None) -> SavedPolicy:
    """Read NAME.zip and what lies beside it; both are pickles: load only those that you trust.

    Args:
        path: of NAME.zip.
        algorithm: "PPO", "SAC" or "RecurrentPPO"; found out by what the file holds where it is left out.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: an algorithm that is not known (names those that are).
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no policy at {path}; policies that come with the project lie in agents/policies")
    name = algorithm or _algorithm_of(path)
    if name not in ALGORITHMS:
        raise ValueError(f"algorithm {name!r} is unknown; known are {', '.join(ALGORITHMS)}")
    beside = normalisation_path(path)
    normalisation = pickle.loads(beside.read_bytes()) if beside.is_file() else None
    if normalisation is not None:
        normalisation.training = False
    return SavedPolicy(ALGORITHMS[name].load(path, device="cpu"), normalisation)


def _algorithm_of(path: Path) -> str:
    """By the policy's class, and by the attributes that only SAC has."""
    from stable_baselines3.common.save_util import load_from_zip_file

    data, _, _ = load_from_zip_file(path, device="cpu")
    assert data is not None
    if "Recurrent" in data["policy_class"].__name__:
        return "RecurrentPPO"
    return "SAC" if "ent_coef" in data and "tau" in data else "PPO"
