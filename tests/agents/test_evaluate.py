"""python -m agents.evaluate, end to end on few presses: result files, leaderboard, films."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sklearn", reason="needs the `agents` extra")
from agents import evaluate
from agents.scoring import leaderboard
from agents.scoring.leaderboard import Result, load_results
from surgsim_env.palpation.scores import ScoreEstimate

pytestmark = pytest.mark.agents


def result(method: str, presses: float = 5.0, **changes: object) -> Result:
    figures = dict.fromkeys(
        [name for _, name, _, _ in (*leaderboard.PLACES, *leaderboard.MAPS)], ScoreEstimate(0.5, 0.25, math.inf)
    )
    figures |= {"hard_limit_share": ScoreEstimate(0.0, 0.0, 0.0), "fault_share": ScoreEstimate(0.01, 0.0, 0.02)}
    figures |= {
        "presses_to_median": ScoreEstimate(presses, presses, presses),
        "recall": ScoreEstimate(None, None, None),
    }
    settings = {
        "method": method,
        "env_id": leaderboard.SITES,
        "env_kwargs": {"scene": "phantom", "level": "hard"},
        "seeds": (1_000_000, 1_000_001),
        "budget": 25,
        "figures": figures,
        "command": f"python -m agents.evaluate --agent {method}",
        "wall_time": 1.5,
        "date": "2026-11-22",
        "errors_mm": [[20.0, 1.0]],
        "lesion_counts": [1, 0],
    }
    return Result(**{**settings, **changes})  # type: ignore[arg-type]


def test_results_come_back_as_they_were(tmp_path: Path) -> None:
    made = result("gp_ucb")
    assert made.save(tmp_path).name == "PalpateSites_phantom_hard_gp_ucb.json"
    assert load_results(tmp_path) == [made]


def test_the_leaderboard_has_a_table_a_place_and_the_best_raster_alone(tmp_path: Path) -> None:
    for method, presses in (("gp_ucb", 4.0), ("raster_3", 6.0), ("raster_4", 9.0), ("middle", math.inf)):
        result(method, presses).save(tmp_path)
    reach = {"scene": "phantom", "level": "hard", "lesions": 8, "below": 2}
    (tmp_path / "reach_PalpateSites_phantom_hard.json").write_text(json.dumps(reach))
    leaderboard.write_leaderboard(tmp_path, tmp_path / "board.md")
    text = (tmp_path / "board.md").read_text()
    assert text.count("## `SurgSim/PalpateSites-v0` phantom (hard)") == 1
    assert "2 of 8 lesions (25%)" in text
    rows = [line.split("|")[1:3] for line in text.splitlines() if line.startswith("| ")]
    named = [(name.strip(), presses.strip()) for name, presses in rows]
    assert ("raster 3 x 3", "6") in named and ("middle", "never") in named
    assert not any(name == "raster 4 x 4" for name, _ in named)
    # Fewest presses first.
    order = [name for name, _ in named]
    assert order.index("gp_ucb") < order.index("raster 3 x 3") < order.index("middle")
    # Every file's command is there, that of the raster which is not shown too.
    assert "--agent raster_4`" in text


def test_results_name_policies_that_are_there() -> None:
    for made in load_results():
        if "--policy" in made.command:
            policy = evaluate.POLICIES.parent.parent / made.command.split("--policy ")[1].split()[0]
            assert policy.is_file() and policy.with_suffix(".json").is_file(), made.command


def test_a_baseline_is_played_and_scored(tmp_path: Path) -> None:
    evaluate.main(["--agent", "gp_ucb", "--episodes", "2", "--budget", "3", "--envs", "2", "--results", str(tmp_path)])
    (made,) = load_results(tmp_path)
    assert (made.method, made.budget, made.seeds) == ("gp_ucb", 3, (1_000_000, 1_000_001))
    assert np.array(made.errors_mm).shape == (2, 3) and len(made.lesion_counts) == 2
    assert 0.1 < made.figures["force_mean"].value < 0.6
    assert made.figures["fault_share"].value == made.figures["hard_limit_share"].value == 0.0
    assert made.figures["seconds"].value > 3 * 0.25
    assert made.command.endswith("--scene phantom --level standard --episodes 2 --budget 3")


def test_who_sees_the_truth_scores_all_of_it_on_the_environment(tmp_path: Path) -> None:
    for name in ("truth", "middle"):
        evaluate.main(["--agent", name, "--episodes", "4", "--envs", "4", "--results", str(tmp_path)])
    figures = {made.method: made.figures for made in load_results(tmp_path)}
    for name in ("recall", "precision", "count_right", "outline_iou", "auroc", "average_precision"):
        assert figures["truth"][name].value == 1.0, name
    assert figures["truth"]["error_mm"].value == 0.0
    assert figures["truth"]["presses_to_median"].value == 1.0
    assert figures["middle"]["auroc"].value == 0.5 and figures["middle"]["outline_iou"].value == 0.0
    assert figures["middle"]["error_mm"].value > 5.0


def test_oracles_play_a_patient_who_moves(tmp_path: Path) -> None:
    """Tracked or not, a result of its own each, at a place that names the motion."""
    common = ["--scene", "phantom_small", "--motion", "calm", "--results", str(tmp_path)]
    evaluate.main(["--agent", "oracle_palpate", "--episodes", "1", *common])
    evaluate.main(["--agent", "oracle", "--episodes", "2", "--budget", "7", "--envs", "2", "--no-tracking", *common])
    sites, task = sorted(load_results(tmp_path), key=lambda made: made.method)
    sites, task = (sites, task) if sites.env_id == leaderboard.SITES else (task, sites)
    assert task.place == "Palpate_phantom_small_standard_calm" and task.method == "oracle_palpate"
    assert task.figures["success"].value == 1.0 and task.figures["hard_limit_share"].value == 0.0
    assert sites.method == "oracle_untracked" and sites.env_kwargs["track_motion"] is False
    assert sites.command.endswith("--budget 7 --motion calm --no-tracking")
    assert 0.0 <= sites.figures["success"].value <= 1.0
    leaderboard.write_leaderboard(tmp_path, tmp_path / "board.md")
    assert "(standard, motion calm)" in (tmp_path / "board.md").read_text()


def test_wrong_options_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        (["--agent", "gp_ucb", "--episodes", "101"], "there are 1 to 100 evaluation seeds"),
        (["--agent", "gp_ucb", "--video", "out.mp4"], "--video films a policy"),
    ):
        with pytest.raises(SystemExit):
            evaluate.main(arguments)
        assert message in capsys.readouterr().err


class MiddleOfAll:
    """A policy that presses the middle, in place of a trained one."""

    class description:
        env_id = leaderboard.SITES

    def reset(self, count: int) -> None:
        """Nothing to forget."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        return np.zeros((len(observations), 2), dtype=np.float32)


def test_a_policy_is_filmed(tmp_path: Path) -> None:
    """Organ and probe on the left, forces and belief on the right; four pictures a press, the last for a second."""
    pytest.importorskip("moviepy", reason="needs the `video` extra")
    from surgsim_env.rendering import gl

    try:
        gl.context()
    except gl.NoGLError as error:
        pytest.skip(f"no pictures on this machine: {error}")
    from moviepy import VideoFileClip

    from agents.scoring.policy_video import PICTURE_SIZE, PRESS_PICTURES, RATE, film

    film(MiddleOfAll(), {"scene": "phantom", "budget": 2}, [5], tmp_path / "out.mp4")
    clip = VideoFileClip(str(tmp_path / "out.mp4"))
    assert clip.size == [2 * PICTURE_SIZE, PICTURE_SIZE]
    assert clip.duration == pytest.approx((2 * PRESS_PICTURES + RATE) / RATE, abs=0.11)
    first, last = clip.get_frame(0.0), clip.get_frame(clip.duration - 0.1)
    left, right = slice(0, PICTURE_SIZE), slice(PICTURE_SIZE, None)
    assert first[:, left].std() > 10.0, "an organ is seen"
    assert np.abs(first[:, right].astype(float) - last[:, right]).max() > 100.0, "the second press was drawn"
    clip.close()
