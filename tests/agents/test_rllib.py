"""agents/train_rllib.py learns on a local Ray with two workers, and goes on from its checkpoint."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.distributed
pytest.importorskip("ray.rllib", reason="needs the `distributed` extra (`make test-distributed`)")

REPOSITORY = Path(__file__).resolve().parents[2]
SMALL = {
    "name": "small",
    "algorithm": "PPO",
    "env_id": "SurgSim/Palpate-v0",
    "env_kwargs": {"scene": "phantom", "max_episode_steps": 40},
    "total_steps": 320,
    "checkpoint_every": 1,
    "sections": {
        "env_runners": {"num_env_runners": 2, "num_envs_per_env_runner": 1, "rollout_fragment_length": 80},
        "training": {"train_batch_size_per_learner": 160, "minibatch_size": 80, "num_epochs": 2},
        "rl_module": {"model_config": {"fcnet_hiddens": [32]}},
    },
}


def run(folder, table, *more):
    config = folder / "run.json"
    config.write_text(json.dumps(table))
    done = subprocess.run(
        [sys.executable, "-m", "agents.train_rllib", str(config), "--out", str(folder / "out"), *more],
        cwd=REPOSITORY,
        # Nobody answers there, and nobody is to be asked: a local Ray is started.
        env={**os.environ, "OMP_NUM_THREADS": "1", "RAY_ADDRESS": "192.0.2.1:6379"},
        capture_output=True,
        text=True,
        timeout=900,
    )
    return done.returncode, done.stdout + done.stderr


def test_two_workers_learn_and_go_on(tmp_path):
    code, said = run(tmp_path, SMALL, "--most-steps", "100")
    assert code == 0 and "160 steps" in said.splitlines(), said
    code, said = run(tmp_path, SMALL)
    assert code == 0 and "320 steps" in said.splitlines(), said
    with (tmp_path / "out" / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["steps"]) for row in rows] == [160.0, 320.0], "it went on where it was"
    assert float(rows[-1]["episode_steps"]) <= 40.0 and float(rows[-1]["return"]) < 12.0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"steps": 3}, "'steps' is unknown; known are name, algorithm, env_id"),
        ({"sections": {"runners": {}}}, "section 'runners' is not a method of RLlib's AlgorithmConfig"),
    ],
)
def test_what_the_file_says_is_checked(tmp_path, change, said):
    from agents.train_rllib import RllibRun

    path = tmp_path / "run.json"
    path.write_text(json.dumps({**SMALL, **change}))
    with pytest.raises(ValueError, match=said):
        RllibRun.read(path)


def test_the_shipped_file_is_read():
    from agents.train_rllib import RllibRun, configured

    run = RllibRun.read(REPOSITORY / "agents" / "configs" / "rllib_palpate.json")
    config = configured(run)
    assert config.num_env_runners == 2 and config.gym_env_vectorize_mode == "vector_entry_point"
