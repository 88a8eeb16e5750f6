"""Learn SurgSim/Retract-v0 from pictures of 84 x 84 pixels and the force sensor, by DAgger under random looks.

    python -m agents.learn_retract_pixels --out runs/retract_pixels.safetensors

The policy sees the endoscope's picture and the readings of the force sensor (obs_mode="rgb_force") and nothing else:
not where the tip, the lobe or the target are, nor how far the jaw is open. The expert that labels its states knows them
all, but acts on the target's place only once the target is in sight, so that a policy can know what it knows. Each
state is kept under several looks of the split "train". Hard pulls are rare, and tear tissue: they are imagined. Forces
of states in which something is pulled are scaled up, and the expert, which gives way to them, labels these too. The
result is a policy of stable-baselines3's PPO.
"""

import argparse
import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)
from agents.command_line import one_line_errors
from surgsim_env.rendering.looks import draw_look, find_look_ranges
from surgsim_env.scoring.expert_retract import GRIP, HOLDS, PULL, SLICES, TolerantExpert

with one_line_errors(__name__, "agents"):
    import torch
    from stable_baselines3 import PPO

    from surgsim_env.envs.stable_baselines import VectorEnvForStableBaselines
    from surgsim_env.training.picture_features import PictureAndForce
    from surgsim_env.training.policy_files import describe, load_policy, policy_path, save_policy

ID = "SurgSim/Retract-v0"
SETTINGS: dict[str, Any] = {"obs_mode": "rgb_force", "looks": "train"}
# Training seeds; scores use seeds from 1,000,000, periodic evaluations from 500,000.
FIRST_SEED = 2_000_000
# Along the lobe, where the expert grasps it: the middle of the edge [m].
GRASP_ALONG = 0.04
NETWORK = {
    "net_arch": {"pi": [128, 64], "vf": [8]},
    "activation_fn": torch.nn.ReLU,
    "features_extractor_class": PictureAndForce,
}
# Channels that a layer beside the policy, which is not kept, predicts from its features: they teach what to look at.
TAUGHT = ("tip_position", "opening", "holds", "edge_points", "visible")
TAUGHT_WEIGHT = 0.1
# Share of states with a pull above PULL_LEAST [N] that are kept a second time, with an imagined pull [N]. States in
# which the jaw pushes without holding anything are rare: all of them are kept, with UNHELD_PULLS imagined pulls each.
# Of the others SLIPPED_SHARE are imagined without a grip, as if the edge had just slipped out.
IMAGINED_SHARE, PULL_LEAST, IMAGINED_PULL, UNHELD_PULLS, SLIPPED_SHARE = 0.2, 0.05, (0.4, 1.3), 4, 0.3
# Of the first rounds, the share of steps that the expert plays.
EXPERT_SHARES = (1.0, 0.5, 0.2)


@dataclass
class Samples:
    """States that were visited, one after the other.

    Fields:
        pictures: uint8 (n, 84, 84, 3)
        forces: scaled readings (n, n_force)
        actions: the expert's (n, n_action)
        taught: scaled channels of TAUGHT (n, n_taught)
    """

    pictures: NDArray[np.uint8]
    forces: NDArray[np.float32]
    actions: NDArray[np.float32]
    taught: NDArray[np.float32]

    def joined(self, other: "Samples") -> "Samples":
        """These and others."""
        return Samples(*(np.concatenate([mine, theirs]) for mine, theirs in zip(self.arrays(), other.arrays())))

    def arrays(self) -> tuple[NDArray, ...]:
        """All fields."""
        return self.pictures, self.forces, self.actions, self.taught


class Player:
    """Plays the environments and keeps what it sees."""

    def __init__(self, envs: gym.vector.VectorEnv, look_count: int, seed: int) -> None:
        self._envs = envs
        self._singles: list[Any] = [env.unwrapped for env in envs.unwrapped.envs]  # type: ignore[attr-defined]
        self._look_count = look_count
        self._rng = np.random.default_rng(seed)
        self._ranges = find_look_ranges(SETTINGS["looks"])
        self._expert = TolerantExpert(grasp_along=GRASP_ALONG)
        parts = [self._singles[0].observation_slices[name] for name in TAUGHT]
        self._taught = np.concatenate([np.arange(part.start, part.stop) for part in parts])
        self._turning = self._singles[0].task.action_slices["turning"]
        # All readings but the grip's grow with the pull.
        grip = SLICES["grip_force"].start
        self._pulled = np.array([entry != grip for entry in self._singles[0].task.force_entries])
        self.taught_count = len(self._taught)
        self._seen, _ = envs.reset(seed=FIRST_SEED + 10_000 * seed)

    def play(self, model: PPO, steps: int, expert_share: float, disturbance: float) -> tuple[Samples, list[bool]]:
        """Play so many control steps of all environments; also whether each episode that ended succeeded."""
        kept: list[tuple[NDArray, ...]] = []
        won: list[bool] = []
        for _ in range(steps):
            wanted = np.array([self._expert.act(one.task_observation) for one in self._singles])
            taught = np.array([one.as_observed(one.task_observation)[self._taught] for one in self._singles])
            views = [self._seen["picture"]] + [self._other_look() for _ in range(self._look_count - 1)]
            kept += [(view.copy(), self._seen["force"].copy(), wanted, taught) for view in views]
            kept.append(self._imagined(taught))
            taken = wanted
            if expert_share < 1.0:
                by_expert = self._rng.random(len(wanted)) < expert_share
                taken = np.where(by_expert[:, None], wanted, model.predict(self._seen, deterministic=True)[0])
            noise = self._rng.normal(scale=disturbance, size=taken.shape)
            # The teacher does not turn the wrist back.
            noise[:, self._turning] = 0.0
            taken = np.clip(taken + noise, -1.0, 1.0)
            self._seen, _, terminated, truncated, info = self._envs.step(taken.astype(np.float32))
            over = np.flatnonzero(terminated | truncated)
            won += [bool(info["final_info"]["success"][index]) for index in over]
        return Samples(*(np.concatenate(part) for part in zip(*kept))), won

    def _imagined(self, taught: NDArray[np.float32]) -> tuple[NDArray, ...]:
        """Some of the present states with a harder pull, as a row of `Samples` each; maybe none."""
        pulls, holds = np.array([one.task_observation[[PULL, HOLDS]] for one in self._singles]).T
        held = (holds > 0.5) & (self._rng.random(len(pulls)) < IMAGINED_SHARE)
        count = np.where(holds > 0.5, held, UNHELD_PULLS)
        chosen = np.repeat(np.arange(len(pulls)), np.where(pulls > PULL_LEAST, count, 0))
        forces = self._seen["force"][chosen].copy()
        wanted = np.zeros((len(chosen), self._envs.single_action_space.shape[0]), np.float32)  # type: ignore[index]
        for row, index in enumerate(chosen):
            observation = self._singles[index].task_observation.copy()
            factor = self._rng.uniform(*IMAGINED_PULL) / observation[PULL]
            observation[PULL] *= factor
            forces[row, self._pulled] *= factor
            if observation[HOLDS] > 0.5 and self._rng.random() < SLIPPED_SHARE:
                observation[[HOLDS, GRIP]] = 0.0
                forces[row, ~self._pulled] = 0.0
            wanted[row] = self._expert.act(observation)
        return self._seen["picture"][chosen].copy(), forces, wanted, taught[chosen]

    def _other_look(self) -> NDArray[np.uint8]:
        return np.stack([one.picture(draw_look(self._ranges, self._rng)) for one in self._singles])


class Fit:
    """Least squares of the policy's mean action, and of what the taught layer predicts, with Adam."""

    def __init__(self, model: PPO, taught_count: int, seed: int) -> None:
        self._policy: Any = model.policy
        self._taught = torch.nn.Linear(self._policy.features_extractor.features_dim, taught_count)
        self._parameters = [*self._policy.parameters(), *self._taught.parameters()]
        self._adam = torch.optim.Adam(self._parameters, lr=1e-3)
        self._rng = np.random.default_rng(seed)

    def run(self, samples: Samples, updates: int, rates: tuple[float, float], batch: int = 128) -> float:
        """So many minibatches, with a learning rate that falls from one to another; the mean loss of the last tenth."""
        policy, losses = self._policy, []
        policy.set_training_mode(True)
        scale = torch.as_tensor(samples.taught.std(axis=0) + 1e-3)
        middle = torch.as_tensor(samples.taught.mean(axis=0))
        for rows, done in self._minibatches(len(samples.actions), updates, batch):
            share = 0.5 * (1.0 + math.cos(math.pi * done))
            self._adam.param_groups[0]["lr"] = rates[1] + (rates[0] - rates[1]) * share
            pictures = torch.as_tensor(samples.pictures[rows]).permute(0, 3, 1, 2)
            seen = {"picture": pictures, "force": torch.as_tensor(samples.forces[rows])}
            features = policy.extract_features(seen)
            mean = policy.action_net(policy.mlp_extractor.forward_actor(features))
            missed = (mean - torch.as_tensor(samples.actions[rows])).square().mean()
            told = (torch.as_tensor(samples.taught[rows]) - middle) / scale
            loss = missed + TAUGHT_WEIGHT * (self._taught(features) - told).square().mean()
            self._adam.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self._parameters, 1.0)
            self._adam.step()
            losses.append(missed.item())
        policy.set_training_mode(False)
        return float(np.mean(losses[-max(1, updates // 10) :]))

    def _minibatches(self, count: int, updates: int, batch: int) -> Iterator[tuple[NDArray[np.int64], float]]:
        order = np.zeros(0, dtype=np.int64)
        for update in range(updates):
            if len(order) < batch:
                order = self._rng.permutation(count)
            yield order[:batch], update / updates
            order = order[batch:]


def kept_rounds(folder: Path | None) -> list[Path]:
    """The files of rounds in a folder, the first round first."""
    return [] if folder is None else sorted(folder.glob("round_*.npz"))


def kept_samples(folder: Path | None) -> Samples | None:
    """The states of all rounds in a folder; None without one."""
    tables = [np.load(path) for path in kept_rounds(folder)]
    if not tables:
        return None
    return Samples(*(np.concatenate([table[name] for table in tables]) for name in tables[0].files))


def learn(arguments: argparse.Namespace) -> None:
    """Run DAgger; save the policy and print a line of figures after each round."""
    torch.set_num_threads(1)
    lanes = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "SameStep", "dtype": arguments.dtype}
    envs = gym.make_vec(ID, num_envs=arguments.envs, threads=arguments.threads, **lanes, **SETTINGS)
    model = PPO(
        "MultiInputPolicy",
        VectorEnvForStableBaselines(envs),
        policy_kwargs=NETWORK,
        n_steps=2,
        batch_size=2 * arguments.envs,
        seed=arguments.seed,
        device="cpu",
    )
    if arguments.start is not None:
        model.policy.load_state_dict(load_policy(arguments.start).networks.state_dict())
    samples, began = kept_samples(arguments.keep), time.time()
    first = 0 if samples is None else len(kept_rounds(arguments.keep))
    # Rounds that were read begin other episodes than those that were played then.
    player = Player(envs, arguments.looks, arguments.seed + first)
    fit = Fit(model, player.taught_count, arguments.seed + first)
    if samples is not None:
        loss = fit.run(samples, arguments.updates * first, (1e-3, 3e-4))
        print(json.dumps({"rounds_read": first, "samples": len(samples.actions), "loss": loss}), flush=True)
    for index in range(first, arguments.rounds):
        share = EXPERT_SHARES[index] if index < len(EXPERT_SHARES) else 0.0
        more, won = player.play(model, arguments.steps, share, arguments.disturbance)
        if arguments.keep is not None:
            arguments.keep.mkdir(parents=True, exist_ok=True)
            np.savez(arguments.keep / f"round_{index:03}.npz", *more.arrays())
        samples = more if samples is None else samples.joined(more)
        last = index == arguments.rounds - 1
        updates = arguments.last_updates if last else arguments.updates
        loss = fit.run(samples, updates, (1e-3, 3e-5) if last else (1e-3, 3e-4))
        line = {
            "round": index,
            "expert_share": share,
            "samples": len(samples.actions),
            "episodes": len(won),
            "success": float(np.mean(won)) if won else None,
            "loss": loss,
            "seconds": round(time.time() - began),
        }
        print(json.dumps(line), flush=True)
        description = describe(
            model,
            None,
            envs.unwrapped.envs[0],  # type: ignore[attr-defined]
            env_id=ID,
            # Scores are of looks that are held out.
            env_kwargs={**SETTINGS, "looks": "test"},
            trained_steps=len(samples.actions),
            seed=arguments.seed,
        )
        save_policy(model.policy, description, arguments.out)
    envs.close()


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=policy_path, required=True, help="the policy's file, NAME.safetensors")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=100, help="control steps of each environment in a round")
    parser.add_argument("--envs", type=int, default=16)
    parser.add_argument("--looks", type=int, default=2, help="looks under which each state is kept")
    parser.add_argument("--updates", type=int, default=250, help="minibatches of each fit")
    parser.add_argument("--last-updates", type=int, default=2500, help="minibatches of the last fit")
    parser.add_argument("--disturbance", type=float, default=0.06, help="noise on actions while it plays, full scale 1")
    parser.add_argument("--dtype", choices=("float64", "float32"), default="float32")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for the states of each round; those in it are read first")
    parser.add_argument("--start", type=policy_path, help="begin with the weights of this policy")
    learn(parser.parse_args())


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
