"""agents/train_rllib.py learns on a local Ray with two workers, and its agent plays."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.distributed
pytest.importorskip("ray.rllib", reason="needs the `distributed` extra (`make test-distributed`)")

REPOSITORY = Path(__file__).resolve().parents[2]


def test_two_workers_learn_and_the_agent_plays(tmp_path: Path):
    # Nobody answers there, and nobody is to be asked: a local Ray is started.
    paths = {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1", "RAY_ADDRESS": "192.0.2.1:6379"}
    settings = {"cwd": tmp_path, "env": {**os.environ, **paths}, "capture_output": True, "text": True, "timeout": 900}
    learn = ["-m", "agents.train_rllib", "--iterations", "1", "--batch", "320"]
    done = subprocess.run([sys.executable, *learn], **settings)
    assert done.returncode == 0 and "iteration 0: return" in done.stdout, done.stdout + done.stderr
    place = ["--env", "SurgSim/Palpate-v0", "--level", "standard", "--seeds", "3", "--results", "scores"]
    score = ["-m", "surgsim_apps.cli.main", "evaluate", "--agent", "agents.train_rllib:Trained", *place]
    arguments = ["--env-arguments", '{"memory": true, "max_episode_steps": 5}']
    done = subprocess.run([sys.executable, *score, *arguments], **settings)
    assert done.returncode == 0 and len(list((tmp_path / "scores").glob("*.json"))) == 1, done.stdout + done.stderr
