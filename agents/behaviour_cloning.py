"""Clone a policy from a Minari dataset and measure how often the clone succeeds.

    python -m agents.behaviour_cloning surgsim/retract/oracle-v0 --out runs/clone.safetensors

The dataset names its environment (`agents/record_demonstrations.py` writes such datasets). The result is a PPO or
RecurrentPPO of stable-baselines3 with its normalisation; reinforcement learning starts from it with
`warm_start: runs/clone.safetensors` in a configuration of `surgsim_env/training/run.py`.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from gymnasium.vector import SyncVectorEnv

from agents.command_line import one_line_errors
from surgsim_env.scoring.episodes import play_tasks

with one_line_errors(__name__, "agents", "demonstrations"):
    import minari
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    from surgsim_env.training.imitation import CloningCurve, CloningOptions, clone, normalise_by, pad
    from surgsim_env.training.networks import algorithm_class
    from surgsim_env.training.policy_files import TrainedPolicy, describe, policy_path, save_policy

# Episodes are scored on seeds from here on; demonstrations come from lower ones.
FIRST_SEED = 500_000


def clone_dataset(
    dataset: minari.MinariDataset, *, recurrent: bool = False, width: int = 128, options: CloningOptions | None = None
) -> tuple[TrainedPolicy, CloningCurve]:
    """Fit a new policy to a dataset; returns the policy and the losses of each epoch.

    Args:
        dataset: of flat observations and actions.
        recurrent: a policy with an LSTM, fitted to whole episodes.
        width: of the two layers (of the LSTM).
        options: of the fit.

    Raises:
        ValueError: observations of another kind, such as pictures or dictionaries (says which).
    """
    if len(dataset.observation_space.shape or ()) != 1:
        raise ValueError(
            f"the observations are {dataset.observation_space}; a policy is cloned from flat ones: record the "
            'environment with obs_mode="state"'
        )
    episodes = list(dataset.iterate_episodes())
    observations = [np.asarray(episode.observations)[:-1] for episode in episodes]
    actions = [np.asarray(episode.actions) for episode in episodes]
    normalisation = VecNormalize(DummyVecEnv([dataset.recover_environment]), norm_reward=False)
    normalise_by(normalisation, np.concatenate(observations))
    kind, policy, network = "PPO", "MlpPolicy", {"net_arch": [width, width]}
    if recurrent:
        kind, policy, network = "RecurrentPPO", "MlpLstmPolicy", {"lstm_hidden_size": width, "net_arch": []}
    model = algorithm_class(kind)(policy, normalisation, policy_kwargs=network, seed=0, device="cpu")
    seen, taken, weight = np.concatenate(observations), np.concatenate(actions), 1.0
    if recurrent:
        (seen, weight), (taken, _) = pad(observations), pad(actions)
    curve = clone(model, seen, taken, sample_weight=weight, normalisation=normalisation, options=options)
    spec = dataset.spec.env_spec
    assert spec is not None
    description = describe(
        model, normalisation, dataset.recover_environment(), env_id=spec.id, env_kwargs=dict(spec.kwargs)
    )
    return TrainedPolicy(model.policy, description), curve


def main(arguments: Sequence[str] | None = None) -> None:
    """Clone, save, play, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", help="its name, such as surgsim/retract/oracle-v0")
    parser.add_argument(
        "--out", type=policy_path, default=Path("runs/clone.safetensors"), help="the policy's file, NAME.safetensors"
    )
    parser.add_argument("--epochs", type=int, default=CloningOptions.epochs)
    parser.add_argument("--recurrent", action="store_true", help="a policy with an LSTM")
    parser.add_argument("--width", type=int, default=128, help="of the layers")
    parser.add_argument("--episodes", type=int, default=10, help="number of episodes that the clone plays")
    parser.add_argument("--seed", type=int, default=0, help="of the fit")
    given = parser.parse_args(arguments)
    dataset = minari.load_dataset(given.dataset)
    options = CloningOptions(
        epochs=given.epochs, seed=given.seed, batch_size=16 if given.recurrent else CloningOptions.batch_size
    )
    policy, curve = clone_dataset(dataset, recurrent=given.recurrent, width=given.width, options=options)
    save_policy(policy.networks, policy.description, given.out)
    held = curve.validation[curve.best]
    print(
        f"{given.dataset}: {dataset.total_episodes} episodes, {dataset.total_steps} steps; "
        f"mean squared error {held:.4f} on held-out ones, after {len(curve.validation)} epochs; {given.out}"
    )
    envs = SyncVectorEnv([dataset.recover_environment], autoreset_mode="Disabled")
    for record in (records := play_tasks(policy.act, envs, range(FIRST_SEED, FIRST_SEED + given.episodes))):
        print(f"success {record.last['success']}, return {record.total:.2f}, {record.steps} steps")
    won, returns = [record.last["success"] for record in records], [record.total for record in records]
    print(f"success {np.mean(won):.0%} of {len(won)} episodes, mean return {np.mean(returns):.2f}")


if __name__ == "__main__":
    with one_line_errors(__name__, "agents", "demonstrations"):
        main()
