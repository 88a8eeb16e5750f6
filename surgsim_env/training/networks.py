"""Networks of policies as data: classes by the names of fixed tables, their arguments, and spaces.

A description of networks is what a policy's JSON file holds, so that nothing has to be unpickled to build them.
"""

import inspect
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from surgsim_env.scene.load import nearest
from surgsim_env.training.extractors import MemorySummary, PlaceAndForce, TouchSummary
from surgsim_env.training.face_features import FaceSummary
from surgsim_env.training.picture_features import PictureAndForce
from surgsim_env.training.site_policy import SitePolicy

# Classes that a configuration and a policy's file name, beside the policies of stable-baselines3's algorithms.
EXTRACTORS = {
    "FaceSummary": FaceSummary,
    "MemorySummary": MemorySummary,
    "PictureAndForce": PictureAndForce,
    "PlaceAndForce": PlaceAndForce,
    "TouchSummary": TouchSummary,
}
ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU, "elu": torch.nn.ELU}
POLICIES = {"SitePolicy": SitePolicy}
# Arguments whose values are classes, and those that acting does not need.
CLASSES: dict[str, dict[str, Any]] = {"activation_fn": ACTIVATIONS, "features_extractor_class": EXTRACTORS}
NOT_DESCRIBED = {"observation_space", "action_space", "lr_schedule", "optimizer_class", "optimizer_kwargs", "device"}
# A description is refused beyond these, so that a damaged or hostile one takes neither memory nor time.
MOST_WEIGHTS = 50_000_000
MOST_LAYERS = 64
MOST_ENTRIES = 100_000
MOST_PARTS = 16
# Products of larger weights overflow, and actions are no numbers.
LARGEST_WEIGHT = 1e6
NUMBERS = ("float32", "float64", "int64", "int32", "int8", "uint8")


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """The class of an algorithm of stable-baselines3 or sb3-contrib.

    Raises:
        ValueError: an unknown name (suggests the nearest).
    """
    classes = [(one, getattr(package, one)) for package in (stable_baselines3, sb3_contrib) for one in package.__all__]
    known = {one: kind for one, kind in classes if isinstance(kind, type) and issubclass(kind, BaseAlgorithm)}
    if name not in known:
        raise ValueError(f"algorithm {name!r} is unknown{nearest(name, sorted(known))} (known: {', '.join(known)})")
    return known[name]


def policy_classes(algorithm: str) -> dict[str, type[BasePolicy]]:
    """The policy classes of an algorithm by name: stable-baselines3's and our own."""
    return {**algorithm_class(algorithm).policy_aliases, **POLICIES}


def with_classes(arguments: dict[str, Any], where: str) -> dict[str, Any]:
    """Arguments of a policy with activation functions and features extractors named in place of their classes.

    Raises:
        ValueError: an unknown name (lists the known).
    """
    made = dict(arguments)
    for entry, known in CLASSES.items():
        if entry in made:
            if not isinstance(made[entry], str) or made[entry] not in known:
                raise ValueError(f"{where}.{entry} is {shortened(made[entry])}; known are {', '.join(known)}")
            made[entry] = known[made[entry]]
    return made


def shortened(value: Any, length: int = 60) -> str:
    """A value as it is written in Python, cut to `length` characters."""
    text = repr(value)
    return text if len(text) <= length else f"{text[:length]}..."


# ---- spaces ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SpaceDescription:
    """A Gymnasium space.

    Fields:
        kind: "Box", "Discrete" or "Dict", whose parts stand elsewhere (`NetworkDescription.observation_parts`)
        dtype: of its elements; empty for Dict
        shape: of its elements; empty for Discrete and Dict
        low, high: bounds: one number, or a list of all entries row by row; null where there is no bound
    """

    kind: str
    dtype: str
    shape: tuple[int, ...]
    low: Any
    high: Any

    @classmethod
    def of(cls, space: spaces.Space) -> "SpaceDescription":
        """Describe a space.

        Raises:
            ValueError: another space than a Box, a Discrete or a Dict.
        """
        if isinstance(space, spaces.Dict):
            return cls("Dict", "", (), None, None)
        if isinstance(space, spaces.Box):
            bounds = (_written(space.low), _written(space.high))
            return cls("Box", str(space.dtype), space.shape, *bounds)
        if isinstance(space, spaces.Discrete):
            low = int(space.start)
            return cls("Discrete", str(space.dtype), (), low, low + int(space.n) - 1)
        raise ValueError(
            f"a policy's file holds a Box, a Discrete or a Dict of these, not the space {shortened(space)}"
        )

    def space(self, where: str) -> spaces.Space:
        """The space.

        Raises:
            ValueError: an entry that is wrong (names it after `where`).
        """
        if self.kind not in ("Box", "Discrete"):
            raise ValueError(f"{where}.kind is {shortened(self.kind)}; the rule is 'Box' or 'Discrete'")
        if self.dtype not in NUMBERS:
            raise ValueError(f"{where}.dtype is {shortened(self.dtype)}; known are {', '.join(NUMBERS)}")
        if any(length < 1 for length in self.shape) or math.prod(self.shape) > MOST_ENTRIES or len(self.shape) > 4:
            raise ValueError(
                f"{where}.shape is {shortened(self.shape)}; the rule is positive lengths, at most {MOST_ENTRIES} "
                "entries together"
            )
        if self.kind == "Box":
            low = self._bound("low", -np.inf, where)
            high = self._bound("high", np.inf, where)
            if (low > high).any():
                raise ValueError(f"{where}.low is {low[low > high][0]} where {where}.high is {high[low > high][0]}")
            return spaces.Box(low, high, self.shape, dtype=np.dtype(self.dtype).type)  # type: ignore[arg-type]
        for name, value in (("low", self.low), ("high", self.high)):
            if isinstance(value, bool) or not isinstance(value, int) or abs(value) > MOST_ENTRIES:
                raise ValueError(
                    f"{where}.{name} is {shortened(value)}; the rule is a whole number up to {MOST_ENTRIES}"
                )
        if self.shape or not self.dtype.startswith("int") or self.low > self.high:
            raise ValueError(
                f"{where} is a Discrete of {self.dtype} from {self.low} to {self.high} with shape {self.shape}; the "
                "rule is whole numbers in ascending order and no shape"
            )
        kind: Any = np.dtype(self.dtype).type
        return spaces.Discrete(self.high - self.low + 1, start=self.low, dtype=kind)

    def _bound(self, name: str, missing: float, where: str) -> NDArray:
        given = getattr(self, name)
        values = given if isinstance(given, list) else [given] * math.prod(self.shape)
        if len(values) != math.prod(self.shape):
            raise ValueError(f"{where}.{name} has {len(values)} entries; the shape {self.shape} needs one for each")
        for index, value in enumerate(values):
            if isinstance(value, bool) or not (value is None or isinstance(value, int | float)) or value != value:
                raise ValueError(f"{where}.{name}[{index}] is {shortened(value)}; the rule is a number, or null")
        kind = np.dtype(self.dtype)
        if kind.kind != "f":
            limits = np.iinfo(kind)
            missing = float(limits.min if missing < 0 else limits.max)
        numbers = np.array([missing if value is None else float(value) for value in values], dtype=np.float64)
        if kind.kind != "f" and ((numbers < np.iinfo(kind).min) | (numbers > np.iinfo(kind).max)).any():
            raise ValueError(f"{where}.{name} holds a number that {self.dtype} does not")
        with np.errstate(over="ignore"):
            return numbers.astype(kind).reshape(self.shape)


def _written(bound: NDArray) -> Any:
    """A bound as one number if all are equal, else as a list; null where there is none."""
    whole = bound.dtype.kind != "f"
    values = [(int(value) if whole else float(value)) if np.isfinite(value) else None for value in bound.ravel()]
    return values[0] if values and all(value == values[0] for value in values) else values


# ---- networks -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NetworkDescription:
    """A policy's networks, without their weights.

    Fields:
        policy: a name of `policy_classes`, such as "MlpPolicy"
        arguments: of that class, without spaces, learning rate and optimiser: net_arch, activation_fn, ...
        observation_space: of what the networks read, after preprocessing
        action_space: of what they return
        observation_parts: of an observation_space of kind "Dict", by name
    """

    policy: str
    observation_space: SpaceDescription
    action_space: SpaceDescription
    arguments: dict[str, Any] = field(default_factory=dict)
    observation_parts: dict[str, SpaceDescription] = field(default_factory=dict)

    def read_space(self, where: str) -> spaces.Space:
        """The space of what the networks read.

        Raises:
            ValueError: an entry that is wrong, or parts that do not go with the kind of space (names it after `where`).
        """
        whole = self.observation_space
        if (whole.kind == "Dict") != bool(self.observation_parts) or len(self.observation_parts) > MOST_PARTS:
            raise ValueError(
                f"{where}.observation_parts has {len(self.observation_parts)} entries with observation_space.kind "
                f"{shortened(whole.kind)}; the rule is 1 to {MOST_PARTS} for 'Dict', and none for another kind"
            )
        if whole.kind != "Dict":
            return whole.space(f"{where}.observation_space")
        parts = self.observation_parts.items()
        return spaces.Dict({name: one.space(f"{where}.observation_parts.{name}") for name, one in parts})


def describe_networks(model: BaseAlgorithm) -> NetworkDescription:
    """The description of a model's networks.

    Raises:
        ValueError: a policy, an activation function, a features extractor or another argument without a name.
    """
    known = policy_classes(type(model).__name__)
    names = [name for name, kind in known.items() if type(model.policy) is kind]
    if not names:
        raise ValueError(
            f"the policy {type(model.policy).__name__} has no name in a policy's file; known are {', '.join(known)}: "
            "add it to POLICIES in surgsim_env/training/networks.py"
        )
    arguments: dict[str, Any] = {"use_sde": True} if getattr(model, "use_sde", False) else {}
    for entry, value in model.policy_kwargs.items():
        if entry in NOT_DESCRIBED:
            continue
        if entry in CLASSES:
            named = [name for name, kind in CLASSES[entry].items() if kind is value]
            if not named:
                raise ValueError(
                    f"policy_kwargs.{entry} is {shortened(value)}, which has no name in a policy's file; known are "
                    f"{', '.join(CLASSES[entry])}: add it to surgsim_env/training/networks.py"
                )
            value = named[0]
        arguments[entry] = value
    _check_plain(arguments, "policy_kwargs")
    spaces_of = (SpaceDescription.of(space) for space in (model.observation_space, model.action_space))
    read = model.observation_space.spaces if isinstance(model.observation_space, spaces.Dict) else {}
    parts = {name: SpaceDescription.of(space) for name, space in read.items()}
    return NetworkDescription(names[0], *spaces_of, arguments=arguments, observation_parts=parts)


def build_networks(algorithm: str, network: NetworkDescription, where: str) -> BasePolicy:
    """The networks of a description, with weights as they are initialised; torch's random state is kept.

    Raises:
        ValueError: an entry that is unknown, wrong, or too large (names it after `where`).
    """
    known = policy_classes(algorithm)
    if network.policy not in known:
        raise ValueError(
            f"{where}.policy is {shortened(network.policy)}{nearest(network.policy, sorted(known))}; known for "
            f"{algorithm} are {', '.join(known)}"
        )
    kind = known[network.policy]
    parameters = _parameters(kind)
    for entry in network.arguments:
        if entry not in parameters or entry in NOT_DESCRIBED:
            raise ValueError(
                f"{where}.arguments.{shortened(entry)} is unknown to {network.policy} of {algorithm}"
                f"{nearest(str(entry), parameters)}"
            )
    _check_plain(network.arguments, f"{where}.arguments")
    arguments: dict[str, Any] = {
        "observation_space": network.read_space(where),
        "action_space": network.action_space.space(f"{where}.action_space"),
        **with_classes(network.arguments, f"{where}.arguments"),
    }
    _check_size(network, where)
    if "lr_schedule" in parameters:
        arguments["lr_schedule"] = lambda remaining: 0.0
    if "ortho_init" in parameters:
        # The weights are replaced, and orthogonal ones take time.
        arguments["ortho_init"] = False
    try:
        with torch.random.fork_rng(devices=[]):
            return kind(**arguments)
    except Exception as error:  # whatever networks that do not fit together raise
        said = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{where} describes networks that cannot be built: {said}") from None


def _parameters(kind: type[BasePolicy]) -> list[str]:
    """Names of the arguments of a policy's class; a class that hands them on has those of its parent."""
    names: list[str] = []
    for one in kind.__mro__:
        if "__init__" not in vars(one):
            continue
        signature = inspect.signature(one.__init__).parameters.values()
        names += [each.name for each in signature if each.name not in ("self", *names)]
        if not any(each.kind is each.VAR_KEYWORD for each in signature):
            break
    return names


def _check_plain(value: Any, where: str) -> None:
    """Refuse what JSON cannot hold, and lists that are too long."""
    if isinstance(value, dict):
        for key, entry in value.items():
            _check_plain(entry, f"{where}.{key}")
    elif isinstance(value, list | tuple):
        if len(value) > MOST_LAYERS:
            raise ValueError(f"{where} has {len(value)} entries; the rule is at most {MOST_LAYERS}")
        for index, entry in enumerate(value):
            _check_plain(entry, f"{where}[{index}]")
    elif not (value is None or isinstance(value, str | bool | int | float)):
        raise ValueError(f"{where} is {shortened(value)}; the rule is a number, a text, true, false or null")


def _check_size(network: NetworkDescription, where: str) -> None:
    """Refuse widths and counts that are not positive whole numbers, and more than MOST_WEIGHTS weights."""
    arguments = {"net_arch": [], **network.arguments}
    layers = arguments["net_arch"].values() if isinstance(arguments["net_arch"], dict) else [arguments["net_arch"]]
    for one in layers:
        if one is not None and not isinstance(one, list | tuple):
            raise ValueError(f"{where}.arguments.net_arch holds {shortened(one)}; the rule is a list of widths")
    counts = {name: value for name, value in arguments.items() if name.startswith("n_")}
    widths = [("net_arch", width) for one in layers for width in one or ()]
    widths += [(name, value) for name, value in arguments.items() if name == "lstm_hidden_size"]
    for name, value, most in (*((*one, MOST_ENTRIES) for one in widths), *((*one, 256) for one in counts.items())):
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
            raise ValueError(f"{where}.arguments.{name} holds {shortened(value)}; the rule is 1 to {most}")
    # As many as there are without a features extractor, twice for the critic, or more.
    read = network.observation_parts.values() or [network.observation_space]
    width = sum(math.prod(one.shape) for one in read)
    hidden = arguments.get("lstm_hidden_size", 0)
    weights, width = 4 * hidden * (width + hidden), hidden or width
    for one in layers:
        into = width
        for each in one or ():
            weights, into = weights + into * each, each
    weights *= 2 * math.prod(counts.values())
    if weights > MOST_WEIGHTS:
        raise ValueError(f"{where} describes some {weights} weights; the rule is at most {MOST_WEIGHTS}")


def load_weights(networks: BasePolicy, weights: dict[str, torch.Tensor], where: str) -> None:
    """Give networks their weights, which must have the names, shapes and types of all of them.

    Raises:
        ValueError: a tensor that is missing, unknown, of another shape or type, not finite, or an index that differs
            from that of the architecture (names it after `where`). The networks are unchanged then.
    """
    expected = networks.state_dict()
    for name in sorted(weights):
        if name not in expected:
            raise ValueError(f"{where}: tensor {shortened(name)} is unknown; the description has no such layer")
    for name, wanted in expected.items():
        if name not in weights:
            raise ValueError(f"{where}: tensor {name} is missing; the description has {len(expected)} tensors")
        given = weights[name]
        for what, found, right in (
            ("shape", tuple(given.shape), tuple(wanted.shape)),
            ("type", given.dtype, wanted.dtype),
        ):
            if found != right:
                raise ValueError(f"{where}: tensor {name} has {what} {shortened(found)}; the description needs {right}")
        if given.is_floating_point() and not bool(torch.isfinite(given).all()):
            at = tuple(torch.nonzero(~torch.isfinite(given))[0].tolist())
            raise ValueError(f"{where}: tensor {name} holds {given[at].item()} at {at}; every number must be finite")
        if given.is_floating_point() and given.numel() and float(given.abs().max()) > LARGEST_WEIGHT:
            at = tuple(torch.nonzero(given.abs() > LARGEST_WEIGHT)[0].tolist())
            raise ValueError(
                f"{where}: tensor {name} holds {given[at].item():g} at {at}; the rule is at most {LARGEST_WEIGHT:g}"
            )
        if not given.is_floating_point() and given.ndim and not torch.equal(given, wanted):
            at = tuple(torch.nonzero(given != wanted)[0].tolist())
            raise ValueError(
                f"{where}: tensor {name} holds {given[at].item()} at {at}; the description's is {wanted[at].item()}"
            )
    networks.load_state_dict(weights)
