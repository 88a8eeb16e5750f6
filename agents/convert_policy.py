"""Make policy files without pickles from zips of stable-baselines3.

    python -m agents.convert_policy runs/old/policy.zip --trust-pickle

Reading a zip runs any code that its author put there: convert only zips that you trust. NAME.safetensors and NAME.json
are written beside NAME.zip, which stays; NAME.json must be there already, as training wrote it. Both policies must
give the same actions, to the bit, for random observations.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from agents.command_line import one_line_errors
from surgsim_env.training.site_agent import SITE_COUNT, SLICES

with one_line_errors(__name__, "agents"):
    from surgsim_env.training.networks import describe_networks
    from surgsim_env.training.policy_files import (
        TrainedPolicy,
        load_model,
        load_policy,
        read_description,
        refuse_pickle,
        save_policy,
    )

STEPS, COUNT = 40, 16


def convert(path: Path, *, trust_pickle: bool = False) -> Path:
    """Write NAME.safetensors and NAME.json for NAME.zip; returns the path of the first.

    Raises:
        ValueError: the zip cannot be read or is not trusted, its networks have no names in a policy's file, or the
            converted policy acts differently.
    """
    if not trust_pickle:
        refuse_pickle(path)
    description = read_description(path.with_suffix(".json"))
    model = load_model(path, description)
    described = replace(description, network=describe_networks(model))
    target = path.with_suffix(".safetensors")
    with TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}-") as folder:
        unchecked = Path(folder) / target.name
        save_policy(model.policy, described, unchecked)
        _check_actions(TrainedPolicy(model.policy, description), load_policy(unchecked), path)
        for suffix in (".safetensors", ".json"):
            unchecked.with_suffix(suffix).replace(path.with_suffix(suffix))
    return target


def _check_actions(before: TrainedPolicy, after: TrainedPolicy, path: Path) -> None:
    """Raise ValueError where two policies act differently on random observations."""
    description = before.description
    rng = np.random.default_rng(0)
    # In the range of the normalisation, so that few entries are clipped.
    middle, spread = 0.0, 1.0
    if description.observation_mean is not None and description.observation_variance is not None:
        middle, spread = np.array(description.observation_mean), np.sqrt(description.observation_variance)
    for policy in (before, after):
        policy.reset(COUNT)
    for step in range(STEPS):
        observations = (middle + spread * rng.normal(size=(COUNT, *before.observation_shape))).astype(np.float32)
        if description.belief:
            observations = _plausible(observations, rng)
        begins = np.full(COUNT, step == 0) | (rng.random(COUNT) < 0.1)
        old, new = before.act(observations, begins), after.act(observations, begins)
        if old.tobytes() != new.tobytes():
            raise ValueError(
                f"policy {path} is not converted: as a file without pickles it acts differently, {new[0]} instead of "
                f"{old[0]}"
            )


def _plausible(observations: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Observations of SurgSim/PalpateSites-v0 with a few pressed sites on a face that fills the map."""
    made = observations.copy()
    made[:, SLICES["pressed_map"]] = rng.random((len(made), SITE_COUNT)) < 0.01
    facts = {"face_map": 1.0, "map_cell": 0.5, "chart_share": 1.0}
    facts |= {"contrast_noise": 0.05, "excess_least": 0.1, "lesion_radius": 1.0}
    for name, value in facts.items():
        made[:, SLICES[name]] = value
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("zips", type=Path, nargs="+", help="NAME.zip, with NAME.json beside it")
    parser.add_argument("--trust-pickle", action="store_true", help="read them, which runs any code of their author")
    options = parser.parse_args(arguments)
    for path in options.zips:
        target = convert(path, trust_pickle=options.trust_pickle)
        print(f"{target}: {STEPS * COUNT} actions equal to the bit")


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
