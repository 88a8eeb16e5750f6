"""Clone a policy from a Minari data set of flat observations (`agents/record_demonstrations.py` writes such sets).

python -m agents.behaviour_cloning surgsim/retract/oracle-v0 --out runs/clone.json
surgsim evaluate --policy runs/clone.json --seeds 500000:500009
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import minari
import numpy as np

from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import lone_run
from surgsim_apps.training.fit import fit
from surgsim_apps.training.policy_files import PolicyDescription, observation_declaration, policy_path, save_policy
from surgsim_apps.training.policy_network import NetworkLayout, PolicyNetwork


def main(arguments: Sequence[str] | None = None) -> None:
    """Clone and save; print the error of the fit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", help="its name, such as surgsim/retract/oracle-v0")
    parser.add_argument("--out", type=policy_path, default=Path("runs/clone.json"), help="the policy, NAME.json")
    parser.add_argument("--updates", type=int, default=5000, help="minibatches of the fit")
    options = parser.parse_args(arguments)
    with lone_run(options.out):
        clone(options)


def clone(options: argparse.Namespace) -> None:
    """Clone and save by the options of the command line."""
    dataset = minari.load_dataset(options.dataset)
    if len(dataset.observation_space.shape or ()) != 1:
        raise ValueError(f'the observations are {dataset.observation_space}: record with obs_mode="state"')
    episodes = list(dataset.iterate_episodes())
    seen = np.concatenate([np.asarray(episode.observations)[:-1] for episode in episodes])
    actions = np.concatenate([np.asarray(episode.actions) for episode in episodes])
    network = PolicyNetwork(NetworkLayout(), (seen.shape[1], 128, 128, actions.shape[1]), normalised=True)
    network.normalise_by(seen)
    loss = fit(network, seen, actions, updates=options.updates)
    env = dataset.recover_environment()
    assert env.spec is not None
    description = PolicyDescription(
        env.spec.id, dict(env.spec.kwargs), observation_declaration(env), trained_steps=len(seen)
    )
    save_policy(network, description, options.out)
    print(
        f"{options.dataset}: {len(episodes)} episodes, {len(seen)} steps; mean squared error {loss:.4f}; {options.out}"
    )


if __name__ == "__main__":
    sys.exit(exit_status(main))
