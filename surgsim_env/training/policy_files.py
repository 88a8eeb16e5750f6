"""Policies as files: NAME.safetensors holds the weights, NAME.json the networks, environment and preprocessing.

Reading them runs no code of theirs: networks are built from names of fixed tables
(`surgsim_env.training.networks`), weights are checked before they are used. A zip of stable-baselines3 is a set of
pickles, which run any code that their author put there: it is read only where `trust_pickle` says so, and
`python -m agents.convert_policy` makes files without pickles from it.
"""

import argparse
import hashlib
import json
import warnings
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
import safetensors
import safetensors.torch
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecNormalize

from surgsim_env.envs.ids import TASKS
from surgsim_env.scene.load import fill
from surgsim_env.tasks.task import Task
from surgsim_env.training.environments import blinded
from surgsim_env.training.networks import (
    NetworkDescription,
    algorithm_class,
    build_networks,
    describe_networks,
    load_weights,
    shortened,
)
from surgsim_env.training.site_agent import OBSERVATION_SIZE
from surgsim_env.training.site_policy import CHOICE_SPACE, FEATURE_SPACE, PLACE_SPACE, belief_features, site_actions

# Defaults of VecNormalize: epsilon of variances and clip of observations.
VARIANCE_SLACK = 1e-8
CUT = 10.0
# Most control steps of a decision; the longest episode has fewer.
REPEAT_MOST = 10_000
# Seed of sampled actions, with the environment's index, where no episode gives them random numbers.
SAMPLING_SEED = 0
# Of a normalisation.
LARGEST = 1e30
# Sizes beyond which a file is not read [bytes].
MOST_WEIGHT_BYTES, MOST_TEXT_BYTES = 400_000_000, 20_000_000


@dataclass(frozen=True)
class PolicyDescription:
    """Content of NAME.json.

    Fields:
        algorithm: class of stable-baselines3 or sb3-contrib that trained it
        env_id, env_kwargs: environment of the policy
        action_repeat: control steps per decision
        sampled: actions are drawn from the policy's distribution; otherwise its mean or mode acts
        force_entries: entries of the observation that are set to 0; empty for a policy with force
        observation: declaration of what it reads (`observation_declaration`); None for environments without one
        belief: whether it reads belief maps and its action is a site's number
        observation_mean, observation_variance: of the normalisation; None without one
        trained_steps, seed, score: of its training
        network: its networks; None only beside a zip of an earlier version
        sha256: of NAME.safetensors; None only beside a zip
    """

    algorithm: str
    env_id: str
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    action_repeat: int = 1
    sampled: bool = False
    force_entries: list[int] = field(default_factory=list)
    observation: dict[str, Any] | None = None
    belief: bool = False
    observation_mean: list[float] | None = None
    observation_variance: list[float] | None = None
    trained_steps: int = 0
    seed: int = 0
    score: float | None = None
    network: NetworkDescription | None = None
    sha256: str | None = None

    @property
    def plays_every_scene(self) -> bool:
        """Whether its observation does not depend on a scene's size: belief maps and the frame of the face do not."""
        return self.belief or self.env_kwargs.get("frame") == "face"


def observation_declaration(env: Any) -> dict[str, list[Any]] | None:
    """Size and scale of each channel that an environment observes, by name; None for one without a task of ours.

    Beside a picture these are the channels of force alone.
    """
    inner = getattr(env, "unwrapped", env)
    task = getattr(inner, "task", None)
    if not isinstance(task, Task):
        return None
    space = inner.observation_space
    read, pictures = set(task.declared), {}
    if space.shape is None or len(space.shape) > 1:
        parts = space.spaces if isinstance(space, gym.spaces.Dict) else {"picture": space}
        read = {one.name for one in task.channels if one.felt and "force" in parts}
        pictures = {"picture": [list(parts["picture"].shape or ()), "uint8"]}
    channels = {name: one for name, one in task.declared.items() if name in read}
    return pictures | {
        name: [size, scale if getattr(inner, "scaled", True) else "SI"] for name, (size, scale) in channels.items()
    }


def describe(
    model: BaseAlgorithm, normalisation: VecNormalize | None, env: Any = None, **fields: Any
) -> PolicyDescription:
    """The description of a model with its normalisation and the observation of `env`; `fields` are the other entries.

    Raises:
        ValueError: networks that a policy's file has no names for.
    """
    fields["observation"] = None if env is None else observation_declaration(env)
    if normalisation is not None and normalisation.norm_obs:
        statistics: Any = normalisation.obs_rms
        fields |= {"observation_mean": statistics.mean.tolist(), "observation_variance": statistics.var.tolist()}
    return PolicyDescription(algorithm=type(model).__name__, network=describe_networks(model), **fields)


class TrainedPolicy:
    """A policy with its preprocessing and action repeat; `act` is called each control step.

    policy = load_policy(Path("agents/policies/NAME.safetensors"))
    policy.reset(env_count)
    actions = policy.act(observations, begins)

    It is an `EpisodeActor` of `surgsim_env.scoring.episodes`: where `begin` is called, sampled actions follow from the
    episode's own random numbers, whatever is played beside it.
    """

    def __init__(self, networks: BasePolicy, description: PolicyDescription) -> None:
        self.networks = networks
        self.description = description
        self.reset(1)

    @property
    def observation_shape(self) -> tuple[int, ...] | dict[str, tuple[int, ...]]:
        """Shape of the raw observation; of a dictionary that of each part, by name."""
        return (OBSERVATION_SIZE,) if self.description.belief else raw_shape(self.networks.observation_space)

    @property
    def action_space(self) -> gym.spaces.Box:
        """The environment's: of the networks, or places where the networks choose a site."""
        space: Any = self.networks.action_space
        return PLACE_SPACE if self.description.belief else space

    def check_environment(self, env: gym.Env, name: str = "the policy") -> None:
        """Check that this is an environment for the policy, which messages call `name`.

        Raises:
            ValueError: it observes other channels, or in other scales, has actions of another shape, or is another
                scene than that of its training, which only a policy on belief maps or in the frame of the face can
                play.
        """
        reads, given = self.description.observation, observation_declaration(env)
        if given is not None and reads != given:
            wrong = [one for one in {**(reads or {}), **given} if (reads or {}).get(one) != given.get(one)]
            raise ValueError(
                f"{name} reads {shortened({one: (reads or {}).get(one) for one in wrong})} where the observation of "
                f"{self.description.env_id} with {shortened(self.description.env_kwargs)} has "
                f"{shortened({one: given.get(one) for one in wrong})}: make the environment as the policy's file says"
            )
        for what, space, shape in (
            ("observations", env.observation_space, self.observation_shape),
            ("actions", env.action_space, self.action_space.shape),
        ):
            if (given_shape := raw_shape(space)) != shape:
                raise ValueError(
                    f"{name} has {what} of shape {shape}, {self.description.env_id} with "
                    f"{shortened(self.description.env_kwargs)} those of {given_shape}: env_id or env_kwargs are wrong"
                )
        if self.description.plays_every_scene or given is None:
            # Of an environment that is not ours nothing is known.
            return
        home, scene = home_scene(self.description.env_id, self.description.env_kwargs), env.unwrapped.scene.name  # type: ignore[attr-defined]
        if scene != home:
            raise ValueError(
                f"{name} was trained on the scene {home!r}, whose size and place its observations have, and cannot "
                f"play {scene!r}: leave out the scene, or train a policy on that one"
            )

    def reset(self, count: int) -> None:
        """Begin episodes in `count` environments."""
        self._state: Any = None
        self._random = [_random_state(np.random.default_rng((SAMPLING_SEED, index))) for index in range(count)]
        self._since = np.zeros(count, dtype=np.int64)
        self._actions = np.zeros((count, *self.action_space.shape), dtype=self.action_space.dtype)

    def begin(self, index: int, env: Any, rng: np.random.Generator) -> None:
        """Begin an episode in environment `index`, whose sampled actions are drawn by `rng`."""
        self._random[index] = _random_state(rng)

    def end(self, index: int) -> None:
        """Nothing to do: the next observation of this environment begins an episode."""

    def __call__(self, observations: Any, begins: NDArray[np.bool_]) -> NDArray:
        """As `act`."""
        return self.act(observations, begins)

    def act(self, observations: Any, begins: NDArray[np.bool_] | None = None) -> NDArray:
        """Actions (n, n_action) for raw observations (n, n_observation), or a dictionary of arrays (n, ...).

        They are deterministic, or drawn by random numbers that each environment has for itself: those of the episode
        where `begin` was called, else of the environment's index.

        An episode begins where `begins` (n,) is true; without it at the first call after `reset` alone.
        """
        begins = self._since == 0 if begins is None else begins
        self._since[begins] = 0
        deciding = self._since % self.description.action_repeat == 0
        self._since += 1
        if deciding.any():
            seen = self.seen(observations)
            actions, state = self._predicted(seen, begins)
            if self.description.belief:
                actions = site_actions(observations, actions)
            self._actions[deciding] = actions[deciding]
            if self._state is not None and state is not None and not deciding.all():
                # The recurrent state (layers, n, size) is new where a decision was made.
                pairs = zip(self._state, state, strict=True)
                state = tuple(np.where(deciding[None, :, None], new, old) for old, new in pairs)
            self._state = state
        return self._actions.copy()

    def _predicted(self, seen: Any, begins: NDArray[np.bool_] | None) -> tuple[NDArray, Any]:
        if not self.description.sampled:
            return self.networks.predict(seen, state=self._state, episode_start=begins, deterministic=True)  # type: ignore[return-value]
        made = [self._sampled(seen, begins, index) for index in range(len(self._random))]
        states = [state for _, state in made if state is not None]
        joined = tuple(np.concatenate(parts, axis=1) for parts in zip(*states, strict=True)) if states else None
        return np.concatenate([actions for actions, _ in made]), joined

    def _sampled(self, seen: Any, begins: NDArray[np.bool_] | None, index: int) -> tuple[NDArray, Any]:
        """Action (1, n_action) and recurrent state of one environment."""
        one = [index]
        alone = {name: part[one] for name, part in seen.items()} if isinstance(seen, dict) else seen[one]
        state = None if self._state is None else tuple(part[:, one] for part in self._state)
        begin = None if begins is None else begins[one]
        # Torch's random state, which a training run goes on with, is kept.
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(self._random[index])
            made = self.networks.predict(alone, state=state, episode_start=begin, deterministic=False)
            self._random[index] = torch.get_rng_state()
        return made  # type: ignore[return-value]

    def seen(self, observations: Any) -> Any:
        """Observations as the network reads them: force removed, then belief maps, then normalised."""
        one = self.description
        values = blinded(observations, one.force_entries) if one.force_entries else observations
        if one.belief:
            values = belief_features(values)
        if one.observation_mean is None or one.observation_variance is None:
            return values
        scale = np.sqrt(np.asarray(one.observation_variance) + VARIANCE_SLACK)
        return np.clip((values - np.asarray(one.observation_mean)) / scale, -CUT, CUT).astype(np.float32)


def _random_state(rng: np.random.Generator) -> torch.Tensor:
    """The state of torch's random numbers for a number that `rng` draws."""
    return torch.Generator().manual_seed(int(rng.integers(2**63))).get_state()


def raw_shape(space: gym.Space) -> tuple[int, ...] | dict[str, tuple[int, ...]]:
    """Shape of what an environment observes; pictures, whose colours networks read first, have them last."""
    if isinstance(space, gym.spaces.Dict):
        return {name: raw_shape(part) for name, part in space.spaces.items()}  # type: ignore[misc]
    shape = space.shape or ()
    if is_image_space(space) and is_image_space_channels_first(space):  # type: ignore[arg-type]
        return (*shape[1:], *shape[:1])
    return shape


def home_scene(env_id: str, env_kwargs: dict[str, Any]) -> str:
    """Name of the scene that a policy was trained on."""
    task = TASKS.get(env_id.rpartition(":")[2])
    return Path(env_kwargs.get("scene") or (task.default_scene if task else "")).stem


# ---- files ----------------------------------------------------------------------------------------------------------


def policy_path(text: str) -> Path:
    """The path of a policy that is to be written, as `type` of an option of a command line."""
    try:
        _check_suffix(Path(text))
    except ValueError as error:
        # Of a ValueError argparse would not show the text.
        raise argparse.ArgumentTypeError(str(error)) from None
    return Path(text)


def _check_suffix(path: Path) -> None:
    if path.suffix != ".safetensors":
        raise ValueError(f"policy {path}: the rule is NAME.safetensors; NAME.json is written beside it")


def save_policy(networks: BasePolicy, description: PolicyDescription, path: Path) -> None:
    """Write NAME.safetensors and, beside it, NAME.json.

    Raises:
        ValueError: another suffix, or a description without networks.
    """
    _check_suffix(path)
    if description.network is None:
        raise ValueError(f"policy {path}: its description has no networks (`describe` adds them)")
    # Extractors that actor and critic share would be refused; each name gets its own copy.
    content = safetensors.torch.save({name: one.detach().clone() for name, one in networks.state_dict().items()})
    written = replace(description, sha256=hashlib.sha256(content).hexdigest())
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    path.with_suffix(".json").write_text(json.dumps(asdict(written), indent=1) + "\n", encoding="utf-8")


def load_policy(path: Path, *, trust_pickle: bool = False) -> TrainedPolicy:
    """The policy of NAME.safetensors, or of a zip of stable-baselines3, which NAME.json describes.

    Args:
        path: of either.
        trust_pickle: read the zip, which runs any code that its author put there; with a warning.

    Raises:
        ValueError: a file is missing, damaged, or does not fit the other (names file, entry, value and rule); a zip
            without `trust_pickle`.
    """
    readers = {".safetensors": _read_weights, ".zip": _read_zip}
    if path.suffix not in readers:
        raise ValueError(f"policy {path}: the rule is NAME.safetensors, or a NAME.zip of stable-baselines3")
    for file in (path, path.with_suffix(".json")):
        if not file.is_file():
            other = path.with_suffix(".safetensors")
            hint = f"; {other.name} is" if file == path and other.is_file() else ""
            raise ValueError(f"policy {path}: there is no file {file.name} there{hint}")
    if path.suffix == ".zip" and not trust_pickle:
        refuse_pickle(path)
    description = read_description(path.with_suffix(".json"))
    networks = readers[path.suffix](path, description)
    _check_preprocessing(description, networks, path.with_suffix(".json"))
    policy = TrainedPolicy(networks, description)
    _try(policy, path)
    return policy


def refuse_pickle(path: Path) -> NoReturn:
    """Say that a zip is not read without `--trust-pickle`, as a ValueError."""
    raise ValueError(
        f"policy {path} is a zip of pickles, which runs any code that its author put there: give NAME.safetensors, or "
        "--trust-pickle if you trust the author"
    )


def read_description(file: Path) -> PolicyDescription:
    """The description in NAME.json.

    Raises:
        ValueError: a file that is no JSON table, or an entry that is unknown, missing or wrong.
    """
    try:
        table = json.loads(_read(file, MOST_TEXT_BYTES).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"policy {file} is not valid JSON: {' '.join(str(error).split())}") from None
    if not isinstance(table, dict):
        raise ValueError(f"policy {file} must hold a table of entries, not {shortened(table)}")
    try:
        description = fill(PolicyDescription, table, f"policy {file}")
    except ValueError as error:
        said = " ".join(str(error).split())
        raise ValueError(said if len(said) <= 400 else f"{said[:400]}...") from None
    if not 1 <= description.action_repeat <= REPEAT_MOST:
        raise ValueError(f"policy {file}: action_repeat is {description.action_repeat}; it must be 1 to {REPEAT_MOST}")
    return description


def _read(file: Path, most: int) -> bytes:
    size = file.stat().st_size
    if size > most:
        raise ValueError(f"policy {file} has {size} bytes; the rule is at most {most}")
    return file.read_bytes()


def _read_weights(path: Path, description: PolicyDescription) -> BasePolicy:
    document = path.with_suffix(".json")
    for entry in ("network", "sha256"):
        if getattr(description, entry) is None:
            raise ValueError(
                f"policy {document}: entry {entry!r} is missing; `python -m agents.convert_policy` writes it"
            )
    assert description.network is not None
    content = _read(path, MOST_WEIGHT_BYTES)
    digest = hashlib.sha256(content).hexdigest()
    if digest != description.sha256:
        raise ValueError(
            f"policy {path}: its SHA-256 is {digest}, {document.name} has {shortened(description.sha256, 66)}: the "
            "two are not of one policy, or one is damaged"
        )
    networks = build_networks(description.algorithm, description.network, f"policy {document}: network")
    try:
        weights = safetensors.torch.load(content)
    except (safetensors.SafetensorError, ValueError, KeyError, RuntimeError) as error:
        # It shows a wrong value in full, however long it is.
        said = " ".join(str(error).split())[:200]
        raise ValueError(f"policy {path} is not a file of safetensors: {said}") from None
    load_weights(networks, weights, f"policy {path}")
    return networks


def _read_zip(path: Path, description: PolicyDescription) -> BasePolicy:
    return load_model(path, description).policy


def load_model(path: Path, description: PolicyDescription) -> BaseAlgorithm:
    """The model of a trusted zip of stable-baselines3, with a warning.

    Raises:
        ValueError: it cannot be read.
    """
    warnings.warn(f"policy {path} is read with pickle, which runs any code that its author put there", stacklevel=4)
    kind = algorithm_class(description.algorithm)
    try:
        return kind.load(path, device="cpu")
    except Exception as error:  # a damaged pickle may raise anything
        said = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"policy {path} cannot be read as a {description.algorithm}: {said}") from None


def _check_preprocessing(description: PolicyDescription, networks: BasePolicy, document: Path) -> None:
    """Refuse a normalisation, a belief or entries of force that do not fit the networks' spaces."""
    shape, actions = networks.observation_space.shape or (), networks.action_space
    where = f"policy {document}"
    raw = shape[0] if len(shape) == 1 else 0
    if description.belief:
        if shape != FEATURE_SPACE.shape or getattr(actions, "n", 0) != CHOICE_SPACE.n:
            raise ValueError(
                f"{where}: belief is true, for which networks read {FEATURE_SPACE.shape} numbers and choose among "
                f"{CHOICE_SPACE.n} sites; these read {shape} and choose from {actions}"
            )
        raw = OBSERVATION_SIZE
    for index, entry in enumerate(description.force_entries):
        if not 0 <= entry < raw:
            raise ValueError(f"{where}: force_entries[{index}] is {entry}; the observation has entries 0 to {raw - 1}")
    pair = {name: getattr(description, name) for name in ("observation_mean", "observation_variance")}
    if list(pair.values()).count(None) == 1:
        raise ValueError(f"{where}: observation_mean and observation_variance go together; one is missing")
    for name, values in pair.items():
        if values is None:
            continue
        if shape != (len(values),):
            raise ValueError(f"{where}: {name} has {len(values)} entries; the networks read {shape}")
        for index, value in enumerate(values):
            if not abs(value) <= LARGEST or (name == "observation_variance" and value < 0.0):
                raise ValueError(
                    f"{where}: {name}[{index}] is {value}; the rule is a number up to {LARGEST}, at least 0 for a "
                    "variance"
                )


def _try(policy: TrainedPolicy, path: Path) -> None:
    """Refuse networks that fail on the first observation, or answer it with what is no action."""
    space = policy.networks.observation_space
    try:
        actions, _ = policy.networks.predict(_zeros(space), deterministic=True)
    except Exception as error:  # networks that do not fit their spaces may raise anything
        said = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"policy {path} cannot act: {said}") from None
    if not np.isfinite(actions).all():
        raise ValueError(f"policy {path} answers an observation of zeros with {actions[0]}; actions must be finite")


def _zeros(space: gym.Space) -> Any:
    """One observation of a space, all of it 0."""
    if isinstance(space, gym.spaces.Dict):
        return {name: _zeros(part) for name, part in space.spaces.items()}
    return np.zeros((1, *(space.shape or ())), dtype=space.dtype)
