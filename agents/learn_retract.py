"""Learn SurgSim/Retract-v0 from a scripted expert with DAgger: the policy plays, the expert labels.

    python -m agents.learn_retract --rounds 6 --out runs/retract_dagger.json
    python -m agents.learn_retract --pictures --rounds 22 --out runs/retract_pixels.json
    python -m agents.learn_retract --pictures --rounds 8 --initial retract_pixels.json --out runs/other_tissue.json

With `--pictures` the policy sees the endoscope's picture of 84 x 84 pixels and the force sensor (obs_mode="rgb_force")
alone: neither the places of tip, lobe and target nor the jaw's opening. Its expert has the full state, but uses the
target only once visible, so that the policy can imitate it. Each state is kept under two looks of the split "train".
Hard pulls are rare, and tear tissue: they are imagined. Forces of states with a pull are scaled up, and the expert,
which gives way to them, labels these too.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import lone_run
from surgsim_apps.scoring.expert_retract import GRIP, HOLDS, PULL, SLICES, RetractExpert, TolerantExpert
from surgsim_apps.training.fit import fit
from surgsim_apps.training.policy_files import (
    PolicyDescription,
    load_policy,
    observation_declaration,
    policy_path,
    save_policy,
)
from surgsim_apps.training.policy_network import NetworkLayout, PolicyNetwork
from surgsim_env.rendering import draw_look, find_look_ranges

ID = "SurgSim/Retract-v0"
PICTURES: dict[str, Any] = {"obs_mode": "rgb_force", "looks": "train"}
# Training seeds; scores use seeds from 1,000,000.
FIRST_SEED = 2_000_000
# Place along the lobe of the grasp by the expert of pictures: the middle of the edge [m].
GRASP_ALONG = 0.04
# Noise on played actions, of full scale 1, so that a policy learns to recover (DART, Laskey et al. 2017).
DISTURBANCE = 0.06
# The expert's share of steps in the first rounds.
EXPERT_SHARES = (1.0, 0.3)
# Auxiliary targets: channels predicted from features of pictures by a temporary layer beside the policy, so that the
# features hold them. All of them together count as much as TAUGHT_WEIGHT entries of the action.
TAUGHT = ("tip_position", "opening", "holds", "edge_points", "visible")
TAUGHT_WEIGHT = 0.5
# Share of states with a pull above PULL_LEAST [N] to be kept a second time, with an imagined pull [N]. States of an
# empty jaw that pushes are rare: all of them are kept, with UNHELD_PULLS imagined pulls each. Of the others
# SLIPPED_SHARE are imagined without a grip, as if the edge had just slipped out.
IMAGINED_SHARE, PULL_LEAST, IMAGINED_PULL, UNHELD_PULLS, SLIPPED_SHARE = 0.2, 0.05, (0.4, 1.3), 4, 0.3


class TaughtNetwork(torch.nn.Module):
    """A policy's network and a layer for predicting TAUGHT from its features."""

    def __init__(self, network: PolicyNetwork, taught_count: int) -> None:
        super().__init__()
        self.network = network
        self.taught = torch.nn.Linear(network.features.features_dim, taught_count)  # type: ignore[arg-type]

    def forward(self, observations: Any) -> torch.Tensor:
        """Mean actions and predictions (n, n_action + n_taught)."""
        features = self.network.features(self.network.read(observations))
        return torch.cat([self.network.layers(features), self.taught(features)], dim=1)


@dataclass
class Samples:
    """Labelled states: lists of arrays (n, ...).

    Fields:
        seen: observations; with pictures dictionaries
        labels: the expert's actions, and beside pictures the scaled channels of TAUGHT
    """

    seen: list[Any] = field(default_factory=list)
    labels: list[NDArray[np.float32]] = field(default_factory=list)

    def joined(self) -> tuple[Any, NDArray[np.float32]]:
        """All observations, and their labels."""
        if isinstance(self.seen[0], dict):
            parts = {name: np.concatenate([part[name] for part in self.seen]) for name in self.seen[0]}
            return parts, np.concatenate(self.labels)
        return np.concatenate(self.seen), np.concatenate(self.labels)


class Player:
    """A player of environments; it labels its states."""

    def __init__(self, envs: gym.vector.VectorEnv, *, pictures: bool, seed: int) -> None:
        self.envs, self.pictures = envs, pictures
        self.singles: list[Any] = [env.unwrapped for env in envs.unwrapped.envs]  # type: ignore[attr-defined]
        self.rng = np.random.default_rng(seed)
        self.ranges = find_look_ranges(PICTURES["looks"])
        self.expert = TolerantExpert(grasp_along=GRASP_ALONG) if pictures else RetractExpert()
        parts = [self.singles[0].observation_slices[name] for name in TAUGHT]
        self.taught = np.concatenate([np.arange(part.start, part.stop) for part in parts])
        self.turning = self.singles[0].layout.action_slices["turning"]
        # All readings but the grip's grow with the pull.
        self.pulled = np.array([entry != SLICES["grip_force"].start for entry in self.singles[0].layout.force_entries])
        self.seen, _ = envs.reset(seed=FIRST_SEED + 10_000 * seed)

    def play(self, network: PolicyNetwork, samples: Samples, steps: int, expert_share: float) -> list[bool]:
        """Play control steps of all environments; returns the success of each ended episode."""
        won: list[bool] = []
        for _ in range(steps):
            wanted = np.array([self.expert.act(single.task_observation) for single in self.singles])
            self.keep(samples, wanted)
            by_expert = self.rng.random((len(wanted), 1)) < expert_share
            actions = np.where(by_expert, wanted, network.actions(self.seen, ()) if expert_share < 1.0 else wanted)
            noise = self.rng.normal(scale=DISTURBANCE, size=actions.shape)
            if self.pictures:
                # Their expert does not turn the wrist back.
                noise[:, self.turning] = 0.0
            actions = np.clip(actions + noise, -1.0, 1.0).astype(np.float32)
            self.seen, _, terminated, truncated, info = self.envs.step(actions)
            won += [bool(info["final_info"]["success"][index]) for index in np.flatnonzero(terminated | truncated)]
        return won

    def keep(self, samples: Samples, wanted: NDArray[np.float32]) -> None:
        """Add the present states with the expert's actions; pictures under another look too, and imagined pulls."""
        if not self.pictures:
            samples.seen.append(self.seen.copy())
            samples.labels.append(wanted)
            return
        taught = np.array([single.as_observed(single.task_observation)[self.taught] for single in self.singles])
        relit = np.stack([single.picture(draw_look(self.ranges, self.rng)) for single in self.singles])
        for picture in (self.seen["picture"].copy(), relit):
            samples.seen.append({"picture": picture, "force": self.seen["force"].copy()})
            samples.labels.append(np.concatenate([wanted, taught], axis=1))
        chosen, forces, actions = self.imagined()
        if len(chosen):
            samples.seen.append({"picture": self.seen["picture"][chosen].copy(), "force": forces})
            samples.labels.append(np.concatenate([actions, taught[chosen]], axis=1))

    def imagined(self) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
        """Some of the present states with a harder pull: their numbers (k,), readings and the expert's actions."""
        pulls, holds = np.array([single.task_observation[[PULL, HOLDS]] for single in self.singles]).T
        held = self.rng.random(len(pulls)) < IMAGINED_SHARE
        count = np.where(holds > 0.5, held, UNHELD_PULLS)
        chosen = np.repeat(np.arange(len(pulls)), np.where(pulls > PULL_LEAST, count, 0))
        forces, actions = self.seen["force"][chosen].copy(), []
        for row, index in enumerate(chosen):
            observation = self.singles[index].task_observation.copy()
            factor = self.rng.uniform(*IMAGINED_PULL) / observation[PULL]
            observation[PULL] *= factor
            forces[row, self.pulled] *= factor
            if observation[HOLDS] > 0.5 and self.rng.random() < SLIPPED_SHARE:
                observation[[HOLDS, GRIP]] = 0.0
                forces[row, ~self.pulled] = 0.0
            actions.append(self.expert.act(observation))
        return chosen, forces, np.array(actions, dtype=np.float32)


def learn(
    network: PolicyNetwork, samples: Samples, *, updates: int, rates: tuple[float, float], seed: int, normalises: bool
) -> float:
    """Fit a network to all samples, which set the mean and scale of a state's entries; returns the mean loss."""
    seen, labels = samples.joined()
    if not isinstance(seen, dict):
        if normalises:
            network.normalise_by(seen)
        return fit(network, seen, labels, updates=updates, rates=rates, seed=seed)
    taught = labels[:, network.action_size :]
    labels[:, network.action_size :] = (taught - taught.mean(axis=0)) / (taught.std(axis=0) + 1e-3)
    weight = np.ones(labels.shape[1])
    weight[network.action_size :] = TAUGHT_WEIGHT / taught.shape[1]
    whole = TaughtNetwork(network, taught.shape[1])
    return fit(whole, seen, labels, updates=updates, rates=rates, batch=128, weight=weight, seed=seed)


def main() -> None:
    """Run DAgger; print a line and write the policy after each round."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=policy_path, required=True, help="the policy's file, NAME.json")
    parser.add_argument("--initial", type=policy_path, help="a policy of the same observations to go on from")
    parser.add_argument("--pictures", action="store_true", help="from pictures and force, not from the state")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--steps", type=int, default=170, help="control steps of each environment in a round")
    parser.add_argument("--envs", type=int, default=16)
    parser.add_argument("--updates", type=int, default=2000, help="minibatches of a fit, twice as many of the last")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with lone_run(options.out):
        run(options)


def run(options: argparse.Namespace) -> None:
    """Run DAgger by the options of the command line."""
    torch.set_num_threads(1)
    torch.manual_seed(options.seed)
    settings = PICTURES if options.pictures else {}
    lanes = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "SameStep", "dtype": "float32"}
    envs = gym.make_vec(ID, num_envs=options.envs, **lanes, **settings)
    shares = EXPERT_SHARES
    if options.pictures:
        network = PolicyNetwork(NetworkLayout("relu", "PictureAndForce"), (920, 128, 64, 5))
    else:
        network = PolicyNetwork(NetworkLayout("tanh"), (56, 128, 128, 5), normalised=True)
    if options.initial:
        initial, shares = load_policy(options.initial).decider, EXPERT_SHARES[1:]
        if not isinstance(initial, PolicyNetwork) or initial.layout != network.layout:
            raise ValueError(f"--initial {options.initial}: not a policy of the observations to learn from")
        network = initial
    player, samples, began = Player(envs, pictures=options.pictures, seed=options.seed), Samples(), time.time()
    for index in range(options.rounds):
        won = player.play(network, samples, options.steps, (*shares, 0.0)[min(index, len(shares))])
        last = index == options.rounds - 1
        updates, rates = (2 * options.updates, (1e-3, 3e-5)) if last else (options.updates, (1e-3, 3e-4))
        loss = learn(
            network, samples, updates=updates, rates=rates, seed=options.seed + index, normalises=not options.initial
        )
        count = sum(len(labels) for labels in samples.labels)
        success = float(np.mean(won)) if won else None
        line = {"round": index, "samples": count, "episodes": len(won), "success": success, "loss": loss}
        print(json.dumps({**line, "seconds": round(time.time() - began)}), flush=True)
        description = PolicyDescription(
            env_id=ID,
            # Scores are of looks that are held out.
            env_kwargs={**settings, "looks": "test"} if options.pictures else {},
            observation=observation_declaration(player.singles[0]),
            trained_steps=count,
            seed=options.seed,
        )
        save_policy(network, description, options.out)
    envs.close()


if __name__ == "__main__":
    sys.exit(exit_status(main))
