"""Learn from random weights with PPO of stable-baselines3, without an expert: palpation by touch, or retraction.

    python -m agents.learn_from_scratch palpate --seed 0    # 7 minutes of processor time
    python -m agents.learn_from_scratch retract --seed 2    # two hours
    surgsim evaluate --policy runs/palpate-seed0/policy.json

Palpation plays a surrogate with a force formula (`surgsim_apps.training.palpate_surrogate`), retraction 16 lobes side
by side. The run's folder holds checkpoints (pickles: resume only runs of your own), for each start `progress.csv` and
`evaluations.npz` of the periodic evaluations, and at the end the policy. The same command resumes a stopped run.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import lone_run, output_folder
from surgsim_apps.training.curriculum import RepeatedAction, Stage, StagedRewards
from surgsim_apps.training.palpate_surrogate import PalpateSurrogate
from surgsim_apps.training.policy_files import PolicyDescription, observation_declaration, save_policy
from surgsim_apps.training.policy_network import NetworkLayout, actor_of
from surgsim_apps.training.touch_features import TouchSummary
from surgsim_env import VectorEnvForStableBaselines

ENVS, REPEAT = 16, 5
# Of each periodic evaluation.
EPISODES = 48
# Seeds of training and of its evaluations; scores use seeds from 1,000,000.
TRAINING_SEED, EVALUATION_SEED = 2_000_000, 500_000
COMMON: dict[str, Any] = {"n_steps": 64, "batch_size": 128, "n_epochs": 10, "gae_lambda": 0.95, "clip_range": 0.2}


@dataclass(frozen=True)
class Recipe:
    """A training run.

    Args:
        env_id, env_kwargs: the environment; a decision lasts REPEAT control steps.
        surrogate: True for forces from a formula.
        layout, hidden: of the policy's network.
        spread: first standard deviation of each entry of the action.
        stages: the curriculum.
        decisions: of all environments together.
        settings: of PPO.
        action: first mean of each entry of the action; near 0 if None.
    """

    env_id: str
    env_kwargs: dict[str, Any]
    surrogate: bool
    layout: NetworkLayout
    hidden: tuple[int, ...]
    spread: tuple[float, ...]
    stages: tuple[Stage, ...]
    decisions: int
    settings: dict[str, Any]
    action: tuple[float, ...] | None = None


RECIPES = {
    "palpate": Recipe(
        env_id="SurgSim/Palpate-v0",
        env_kwargs={"scene": "phantom_small", "memory": True},
        surrogate=True,
        layout=NetworkLayout("tanh", "TouchSummary"),
        hidden=(64, 64),
        spread=(0.45, 0.45, 0.35, 0.6),
        action=(0.0, 0.0, 0.0, -0.3),
        stages=(
            Stage(0, failure=0.0, novelty=0.08, near=0.01),
            Stage(15_000, failure=0.2, novelty=0.08, near=0.007),
            Stage(25_000, failure=0.3, novelty=0.08, near=0.0055),
            Stage(35_000, failure=0.5, novelty=0.1),
            Stage(55_000, novelty=0.1),
        ),
        decisions=400_000,
        settings={**COMMON, "gamma": 0.998, "learning_rate": LinearSchedule(6e-4, 0.0, 1.0)},
    ),
    "retract": Recipe(
        env_id="SurgSim/Retract-v0",
        env_kwargs={},
        surrogate=False,
        layout=NetworkLayout("tanh"),
        hidden=(128, 128),
        spread=(0.5, 0.5, 0.5, 0.2, 0.8),
        stages=(Stage(failure=0.0),),
        decisions=30_720,
        settings={**COMMON, "gamma": 0.99, "learning_rate": 3e-4},
    ),
}


class Checkpoints(BaseCallback):
    """Writes a checkpoint after some steps and at the end; each appears whole."""

    def __init__(self, folder: Path, steps: int) -> None:
        super().__init__()
        self.folder, self.steps = folder, steps

    def _on_step(self) -> bool:
        if self.n_calls % self.steps == 0:
            self._on_training_end()
        return True

    def _on_training_end(self) -> None:
        scales = self.model.get_vec_normalize_env()
        assert scales is not None
        with output_folder(self.folder) as files:
            self.model.save(files / f"checkpoint_{self.num_timesteps}_steps.zip")
            scales.save(str(files / f"checkpoint_vecnormalize_{self.num_timesteps}_steps.pkl"))


class CurriculumCallback(BaseCallback):
    """Begins each stage of a recipe between two rollouts."""

    def __init__(self, recipe: Recipe, envs: StagedRewards) -> None:
        super().__init__()
        self.recipe, self.envs = recipe, envs

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.envs.stage = [stage for stage in self.recipe.stages if stage.begin <= self.num_timesteps][-1]


def make_envs(recipe: Recipe, stage: Stage) -> StagedRewards:
    """The environments with the rewards of a stage."""
    if recipe.surrogate:
        envs: Any = PalpateSurrogate(ENVS)
    else:
        lanes = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "SameStep", "dtype": "float32"}
        envs = gym.make_vec(recipe.env_id, num_envs=ENVS, **lanes, **recipe.env_kwargs)
    return StagedRewards(VecMonitor(RepeatedAction(VectorEnvForStableBaselines(envs), REPEAT)), stage)


def begin(recipe: Recipe, envs: VecEnv, seed: int) -> PPO:
    """A new model with the recipe's first actions."""
    network: dict[str, Any] = {"net_arch": list(recipe.hidden), "activation_fn": torch.nn.Tanh}
    if recipe.layout.features == "TouchSummary":
        network["features_extractor_class"] = lambda space: TouchSummary()
    model = PPO("MlpPolicy", envs, policy_kwargs=network, seed=seed, device="cpu", **recipe.settings)
    with torch.no_grad():
        model.policy.log_std.copy_(torch.tensor(recipe.spread).log())
        if recipe.action is not None:
            model.policy.action_net.bias.copy_(torch.tensor(recipe.action))
    return model


def train(recipe: Recipe, folder: Path, seed: int, *, decisions: int | None = None, every: int = 40_000) -> PPO:
    """Train, or resume a run from its last checkpoint, and write the policy.

    Args:
        recipe: of the run.
        folder: of the run.
        seed: of environments, network and exploration.
        decisions: of the whole run, in place of the recipe's.
        every: decisions between evaluations; checkpoints are at least ten in a run.

    Raises:
        ValueError: a folder with a run of another seed.
    """
    torch.set_num_threads(1)
    total = decisions or recipe.decisions
    staged = make_envs(recipe, recipe.stages[0])
    scales = {int(path.stem.split("_")[2]): path for path in folder.glob("checkpoint_vecnormalize_*_steps.pkl")}
    saved = {steps: path for steps in scales if (path := folder / f"checkpoint_{steps}_steps.zip").is_file()}
    if saved:
        envs = VecNormalize.load(str(scales[max(saved)]), staged)
        model = PPO.load(saved[max(saved)], env=envs, device="cpu")
        if model.seed != seed:
            raise ValueError(f"{folder} holds a run with seed {model.seed}, not {seed}: choose another --out")
    else:
        envs = VecNormalize(staged, norm_obs=False, gamma=recipe.settings["gamma"])
        model = begin(recipe, envs, seed)
    envs.seed(TRAINING_SEED + 100_000 * seed + model.num_timesteps)
    logs = str(folder / f"from_{model.num_timesteps}")
    model.set_logger(configure(logs, ["csv"]))
    evaluated = VecNormalize(make_envs(recipe, Stage()), training=False, norm_obs=False, norm_reward=False)
    evaluated.seed(EVALUATION_SEED)
    callbacks = [
        CurriculumCallback(recipe, staged),
        Checkpoints(folder, max(1, min(every, total // 10) // ENVS)),
        # The search is the policy's random walk: its mean action does not search.
        EvalCallback(*(evaluated, None, None, EPISODES, every // ENVS), log_path=logs, deterministic=False, verbose=0),
    ]
    left = total - model.num_timesteps
    model.learn(left, callbacks, reset_num_timesteps=model.num_timesteps == 0)  # type: ignore[arg-type]
    description = PolicyDescription(
        env_id=recipe.env_id,
        env_kwargs=recipe.env_kwargs,
        observation=observation_declaration(staged.get_attr("unwrapped", indices=[0])[0]),
        action_repeat=REPEAT,
        trained_steps=model.num_timesteps,
        seed=seed,
    )
    save_policy(actor_of(model.policy, recipe.layout, drawn=True), description, folder / "policy.json")
    return model


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", choices=RECIPES)
    parser.add_argument("--out", type=Path, help="the run's folder; runs/RECIPE-seedSEED otherwise")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--decisions", type=int, help="in place of the recipe's")
    parser.add_argument("--every", type=int, default=40_000, help="decisions between evaluations")
    options = parser.parse_args()
    folder = options.out or Path("runs") / f"{options.recipe}-seed{options.seed}"
    with lone_run(folder / "policy.json"):
        model = train(RECIPES[options.recipe], folder, options.seed, decisions=options.decisions, every=options.every)
    print(f"{model.num_timesteps} decisions; policy in {folder}/policy.json")


if __name__ == "__main__":
    sys.exit(exit_status(main))
