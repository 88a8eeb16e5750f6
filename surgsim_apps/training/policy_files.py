"""Policies as files: a description NAME.json, and beside it the network's weights NAME.safetensors.

A policy for SurgSim/PalpateSites-v0 may be an acquisition function instead, with its 13 numbers in NAME.json. Reading
the files runs no code of theirs.
"""

import argparse
import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import safetensors
import safetensors.torch
import torch
from numpy.typing import NDArray

from msdm_core.mesh_files import checked_content
from surgsim_apps.training.acquisition import Acquisition
from surgsim_apps.training.policy_network import NetworkLayout, PolicyNetwork
from surgsim_env.envs import TASKS
from surgsim_env.scene import fill
from surgsim_env.tasks import Task

# Seed of sampled actions, with the environment's index, without random numbers of an episode.
SAMPLING_SEED = 0


@dataclass(frozen=True)
class PolicyDescription:
    """Content of NAME.json.

    Fields:
        env_id, env_kwargs: environment of the policy
        observation: its channels (`observation_declaration`); None for environments without a declaration
        action_repeat: control steps of a decision
        network: of NAME.safetensors; None for an acquisition function
        acquisition: its numbers; None for a network
        trained_steps, seed: of its training
    """

    env_id: str
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    observation: dict[str, Any] | None = None
    action_repeat: int = 1
    network: NetworkLayout | None = None
    acquisition: tuple[float, ...] | None = None
    trained_steps: int = 0
    seed: int = 0

    @property
    def plays_every_scene(self) -> bool:
        """True if its observation is independent of a scene's size: touch maps, or the frame of the face."""
        return self.acquisition is not None or self.env_kwargs.get("frame") == "face"

    @property
    def home_scene(self) -> str:
        """Name of its training scene."""
        task = TASKS.get(self.env_id.rpartition(":")[2])
        return Path(self.env_kwargs.get("scene") or (task.setup.scene if task else "")).stem


def observation_declaration(env: Any) -> dict[str, list[Any]] | None:
    """Size and scale of an environment's observed channels, by name; None for one without a task of ours.

    Beside a picture these are the channels of force alone.
    """
    inner = getattr(env, "unwrapped", env)
    task = getattr(inner, "task", None)
    if not isinstance(task, Task):
        return None
    space = inner.observation_space
    observed = inner.layout.observed
    read, pictures = {channel.name for channel, _ in observed}, {}
    if space.shape is None or len(space.shape) > 1:
        parts = space.spaces if isinstance(space, gym.spaces.Dict) else {"picture": space}
        read = {channel.name for channel in task.channels if channel.felt and "force" in parts}
        pictures = {"picture": [list(parts["picture"].shape or ()), "uint8"]}
    return pictures | {
        channel.name: [size, channel.scale_shown if getattr(inner, "scaled", True) else "SI"]
        for channel, size in observed
        if channel.name in read
    }


class TrainedPolicy:
    """A policy with its action repeat; `act` is called each control step.

    policy = load_policy(Path("agents/policies/NAME.json"))
    policy.reset(env_count)
    actions = policy.act(observations, begins)

    It is an `EpisodeActor` of `surgsim_apps.scoring.episodes`: after `begin`, sampled actions follow from the episode's
    own random numbers alone.
    """

    def __init__(self, decider: PolicyNetwork | Acquisition, description: PolicyDescription) -> None:
        self.decider = decider
        self.description = description
        self.reset(1)

    def check_environment(self, env: gym.Env, name: str = "the policy") -> None:
        """Check an environment for the policy; messages call it `name`.

        Raises:
            ValueError: an environment with other channels or scales, or another scene than that of the training, unless
                the policy plays every scene.
        """
        reads, offered, own = self.description.observation or {}, observation_declaration(env), self.description
        if offered is None:
            # Nothing is known of a foreign environment.
            return
        if wrong := [channel for channel in {**reads, **offered} if reads.get(channel) != offered.get(channel)]:
            wanted, observed = ({channel: part.get(channel) for channel in wrong} for part in (reads, offered))
            raise ValueError(
                f"{name} reads {wanted} where the observation of {own.env_id} with {own.env_kwargs} has {observed}: "
                "make the environment as the policy's file says"
            )
        scene = env.unwrapped.scene.name  # type: ignore[attr-defined]
        if not own.plays_every_scene and scene != own.home_scene:
            raise ValueError(
                f"{name} was trained on the scene {own.home_scene!r}, whose size and place its observations have, and "
                f"cannot play {scene!r}: leave out the scene, or train a policy on that one"
            )

    def reset(self, count: int) -> None:
        """Begin episodes in `count` environments."""
        self._random = [_generator(np.random.default_rng((SAMPLING_SEED, index))) for index in range(count)]
        self._since = np.zeros(count, dtype=np.int64)
        self._actions: NDArray[np.float32] | None = None

    def begin(self, index: int, env: Any, rng: np.random.Generator) -> None:
        """Begin an episode in environment `index`, with sampled actions from `rng`."""
        self._random[index] = _generator(rng)

    def end(self, index: int) -> None:
        """Nothing to do: the next observation of this environment begins an episode."""

    def __call__(self, observations: Any, begins: NDArray[np.bool_]) -> NDArray[np.float32]:
        """As `act`."""
        return self.act(observations, begins)

    def act(self, observations: Any, begins: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Actions (n, n_action) for raw observations (n, n_observation), or a dictionary of arrays (n, ...).

        An episode begins in environments of the mask `begins` (n,); without it at the first call after `reset` alone.
        """
        self._since[self._since == 0 if begins is None else begins] = 0
        deciding = self._since % self.description.action_repeat == 0
        self._since += 1
        if deciding.any() or self._actions is None:
            decided = self.decider.actions(observations, self._random)
            kept = decided if self._actions is None else self._actions
            self._actions = np.where(deciding[:, None], decided, kept)
        return self._actions.copy()


def _generator(rng: np.random.Generator) -> torch.Generator:
    return torch.Generator().manual_seed(int(rng.integers(2**63)))


# ---- files ----------------------------------------------------------------------------------------------------------


def policy_path(text: str) -> Path:
    """The path of a new policy, as `type` of an option of a command line."""
    if Path(text).suffix != ".json":
        raise argparse.ArgumentTypeError(f"policy {text}: the rule is NAME.json; NAME.safetensors is written beside it")
    return Path(text)


def save_policy(decider: PolicyNetwork | Acquisition, description: PolicyDescription, path: Path) -> TrainedPolicy:
    """Write NAME.json and, for a network, NAME.safetensors beside it; returns the policy."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(decider, Acquisition):
        written = replace(description, acquisition=decider.values, network=None)
    else:
        written = replace(description, acquisition=None, network=decider.layout)
        weights = {name: weight.contiguous() for name, weight in decider.state_dict().items()}
        path.with_suffix(".safetensors").write_bytes(safetensors.torch.save(weights))
    path.with_suffix(".json").write_text(json.dumps(asdict(written), indent=1) + "\n", encoding="utf-8")
    return TrainedPolicy(decider, written)


def load_policy(path: Path) -> TrainedPolicy:
    """The policy of NAME.json or NAME.safetensors, the path of either.

    Raises:
        ValueError: a missing, damaged or mismatched file (names the file and the reason).
    """
    description = read_description(path)
    if description.network is None:
        return TrainedPolicy(Acquisition(description.acquisition or ()), description)
    file = checked_content(path.with_suffix(".safetensors"))
    try:
        return TrainedPolicy(_filled(description.network, safetensors.torch.load(file.read_bytes())), description)
    except (OSError, safetensors.SafetensorError, KeyError, IndexError, RuntimeError) as error:
        raise ValueError(f"policy {file}: {' '.join(str(error).split())[:300]}") from None


def read_description(path: Path) -> PolicyDescription:
    """The description in NAME.json, the path of a policy's either file.

    Raises:
        ValueError: no such file, no JSON, or an unknown, missing or wrong entry.
    """
    document = checked_content(path.with_suffix(".json"))
    try:
        table = json.loads(document.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"policy {document} cannot be read: {error}") from None
    return fill(PolicyDescription, table, f"policy {document}")


def _filled(layout: NetworkLayout, weights: dict[str, torch.Tensor]) -> PolicyNetwork:
    """A network with these weights, and their sizes of layers."""
    numbers = sorted(int(name.split(".")[1]) for name in weights if name.startswith("layers.") and "weight" in name)
    layers = [weights[f"layers.{number}.weight"] for number in numbers]
    sizes = [layers[0].shape[1], *(layer.shape[0] for layer in layers)]
    network = PolicyNetwork(layout, sizes, normalised="mean" in weights, drawn="log_spread" in weights)
    network.load_state_dict(weights)
    return network
