"""surgsim evaluate, end to end on few presses: result files, leaderboard, films."""

import hashlib
import importlib
import itertools
import json
import math
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from agents import leaderboard
from surgsim_apps.scoring import evaluate
from surgsim_apps.scoring.evaluate import policies_folder
from surgsim_apps.scoring.figures import ScoreEstimate
from surgsim_apps.scoring.options import ScoringOptions
from surgsim_apps.scoring.results import (
    SITES,
    Result,
    load_result,
    load_results,
    read_seeds,
    seeds_text,
    shipped_results,
)
from surgsim_apps.scoring.submission import module_digest, submission_seeds
from surgsim_env.scene.digest import PHYSICS_VERSION
from surgsim_env.scene.load import scenes_folder
from tests.agents.commands import surgsim

pytestmark = pytest.mark.agents


def result(method: str, presses: float = 5.0, **changes: object) -> Result:
    figures = dict.fromkeys(
        [name for _, name, _, _ in leaderboard.PRESSES],
        ScoreEstimate(0.5, 0.25, math.inf),
    )
    figures |= {
        "presses_to_median": ScoreEstimate(presses, presses, presses),
        "error_of_presses_mm": ScoreEstimate(presses, 0.5 * presses, 2.0 * presses),
        "recall": ScoreEstimate(None, None, None),
    }
    settings = {
        "method": method,
        "env_id": SITES,
        "env_kwargs": {"scene": "phantom", "level": "hard"},
        "seeds": (1_000_000, 1_000_001),
        "budget": 25,
        "figures": figures,
        "command": f"surgsim evaluate --agent {method}",
        "wall_time": 1.5,
        "date": "2026-11-22",
        "physics_version": PHYSICS_VERSION,
        "errors_mm": [[20.0, 1.0], [0.0, 0.0]],
        "lesion_counts": [1, 0],
        "episodes": {"error_of_presses_mm": [presses, presses], "centroid_error_mm": [1.0, None]},
        "members": ["test 3", "test 0"],
        "sees_truth": method == "truth",
    }
    return Result(**{**settings, **changes})  # type: ignore[arg-type]


def test_results_come_back_as_they_were(tmp_path: Path) -> None:
    made = result("gp_ucb")
    assert made.save(tmp_path).name == "PalpateSites_phantom_hard_gp_ucb.json"
    assert load_results(tmp_path) == [made]


def board(folder: Path) -> list[list[str]]:
    """Cells of the table rows that `agents.leaderboard` writes for a folder's results."""
    leaderboard.write_leaderboard(folder, folder / "board.md")
    lines = (folder / "board.md").read_text().splitlines()
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("| ")]


def test_the_leaderboard_has_the_least_area_first_and_the_best_raster_alone(tmp_path: Path) -> None:
    for method, area in (("gp_ucb", 4.0), ("raster_3", 6.0), ("raster_4", 9.0), ("middle", math.inf), ("sobol", 4.0)):
        result(method, area).save(tmp_path)
    result("gp_ucb", 8.0, env_kwargs={"scene": "liver_family", "split": "test"}).save(tmp_path)
    # Organs before blocks.
    rows = board(tmp_path)
    (at,) = [index for index, row in enumerate(rows) if row[0] == "PalpateSites on `phantom` (hard)"]
    assert [cell.partition(":")[0] for cell in rows[at][1:3]] == ["gp_ucb", "sobol"]
    organ, *block = [row[:3] for row in rows[at + 1 :] if row[0] not in ("method", "---")]
    assert organ == ["gp_ucb", "8.00 (4.00 to 16.00)", "8"]
    assert [row[0] for row in block] == ["gp_ucb", "sobol", "raster 3 x 3", "middle"]
    assert block[2][1:] == ["6.00 (3.00 to 12.00)", "6"] and block[3][1:] == ["never (never to never)", "never"]


def test_the_leaderboard_names_pairs_that_are_not_separated(tmp_path: Path) -> None:
    """Of three methods on 40 organs two differ by chance, the third by 5 mm."""
    organ = {"env_kwargs": {"scene": "liver_family", "split": "test"}, "seeds": tuple(range(40))}
    areas, rng = np.full(40, 6.0), np.random.default_rng(0)
    for method, area in (("gp_ei", areas + rng.normal(size=40)), ("gp_ucb", areas), ("sobol", areas + 5.0)):
        episodes = {"error_of_presses_mm": area.tolist()}
        result(method, area.mean(), episodes=episodes, members=list(map(str, range(40))), **organ).save(tmp_path)
    near = result("oracle_near", 4.0, sees_truth=True, **organ)
    near.save(tmp_path)
    board(tmp_path)
    text = (tmp_path / "board.md").read_text()
    (alike,) = re.findall(r"Not separated.*: (.*)", text)
    assert {"gp_ei", "gp_ucb"} == set(re.findall(r"\w+_\w+", alike))
    assert re.search(r"Head room.*: [12]\.\d\d mm of area between \w+ and oracle_near", text)


def test_the_leaderboard_marks_results_of_an_older_physics(tmp_path: Path) -> None:
    result("gp_ucb").save(tmp_path)
    result("sobol", physics_version=PHYSICS_VERSION - 1).save(tmp_path)
    notes = {row[0]: row[-1] for row in board(tmp_path)}
    assert notes["sobol"] == f"physics {PHYSICS_VERSION - 1}" and notes["gp_ucb"] == ""


def test_results_name_their_physics_and_policies_that_are_there() -> None:
    for made in load_results(shipped_results()):
        assert 1 <= made.physics_version <= PHYSICS_VERSION
        if "--policy" in made.command:
            policy = policies_folder().parents[1] / made.command.split("--policy ")[1].split()[0]
            assert policy.with_suffix(".json").is_file(), made.command


def test_a_baseline_is_played_and_scored(tmp_path: Path) -> None:
    surgsim(
        "evaluate", "--agent", "gp_ucb", "--episodes", "2", "--budget", "3", "--envs", "2", "--results", str(tmp_path)
    )
    (made,) = load_results(tmp_path)
    assert (made.method, made.budget, made.seeds) == ("gp_ucb", 3, (1_000_000, 1_000_001))
    assert np.array(made.errors_mm).shape == (2, 3) and len(made.lesion_counts) == 2
    assert 0.1 < made.figures["force_mean"].value < 0.6
    assert 1e3 < made.figures["pressure_peak"].value < 2e4 and 0.1 < made.figures["strain_peak"].value < 1.0
    head, _, row = board(tmp_path)[-3:]
    shown = dict(zip(head, row, strict=True))
    assert shown["peak force [N]"] == f"{made.figures['force_peak'].value:.2f}"
    assert shown["peak tissue pressure [kPa]"] == f"{made.figures['pressure_peak'].value / 1e3:.1f}"
    for name, values in made.episodes.items():
        assert len(values) == 2 and np.mean(values) == pytest.approx(made.figures[name].value, rel=1e-4), name
    assert made.figures["fault_share"].value == made.figures["hard_limit_share"].value == 0.0
    assert made.figures["seconds"].value > 3 * 0.25
    assert made.command.endswith("--agent gp_ucb --episodes 2 --budget 3")
    assert made.episodes["success"] == [row[-1] <= 5.0 for row in made.errors_mm] and not made.sees_truth
    assert made.physics_version == PHYSICS_VERSION


def test_who_sees_the_truth_scores_all_of_it_on_the_environment(tmp_path: Path) -> None:
    for name in ("truth", "middle"):
        surgsim("evaluate", "--agent", name, "--episodes", "4", "--envs", "4", "--results", str(tmp_path))
    figures = {made.method: made.figures for made in load_results(tmp_path)}
    for name in ("recall", "precision", "count_right", "outline_iou", "auroc"):
        assert figures["truth"][name].value == 1.0, name
    assert figures["truth"]["error_mm"].value == 0.0
    assert figures["truth"]["presses_to_median"].value == 1.0
    assert figures["middle"]["auroc"].value == 0.5 and figures["middle"]["outline_iou"].value == 0.0
    assert figures["middle"]["error_mm"].value > 5.0
    marks = {made.method: (made.sees_truth, made.own_estimate) for made in load_results(tmp_path)}
    assert marks == {"truth": (True, True), "middle": (False, True)}
    assert {row[0]: row[-1] for row in board(tmp_path)}["truth"] == "**sees truth**, **own estimate**"


def test_oracles_play_a_patient_who_moves(tmp_path: Path) -> None:
    """Tracked or not, a result of its own each, at a place that names the motion."""
    common = ["--scene", "phantom_small", "--motion", "calm", "--results", str(tmp_path)]
    surgsim("evaluate", "--agent", "oracle_palpate", "--episodes", "1", *common)
    surgsim(
        "evaluate",
        "--agent",
        "oracle_near",
        "--episodes",
        "2",
        "--budget",
        "7",
        "--envs",
        "2",
        "--no-tracking",
        *common,
    )
    sites, task = sorted(load_results(tmp_path), key=lambda made: made.method)
    sites, task = (sites, task) if sites.env_id == SITES else (task, sites)
    assert task.place == "Palpate_phantom_small_standard_calm" and task.method == "oracle_palpate"
    assert task.figures["success"].value == 1.0 and task.figures["hard_limit_share"].value == 0.0
    assert sites.method == "oracle_near_untracked" and sites.env_kwargs["track_motion"] is False
    assert sites.command.endswith("--scene phantom_small --motion calm --no-tracking --episodes 2 --budget 7")
    assert sites.sees_truth and task.sees_truth and task.episodes["success"] == [1.0]
    assert 0.0 <= sites.figures["success"].value <= 1.0
    board(tmp_path)
    assert (tmp_path / "board.md").read_text().count("(standard, motion calm)") == 2


def test_wrong_options_are_refused() -> None:
    for arguments, message in (
        ([], "give one of --agent, --policy, --all, --compare; given: none"),
        (["--agent", "gp_ucb", "--all"], "given: --agent and --all"),
        (["--agent", "gp_ucb", "--split", "tset"], "split 'tset' is unknown"),
        (["--agent", "my:Own", "--env-arguments", "[1]"], "--env-arguments is '[1]'"),
        (["--agent", "gp_ucb", "--episodes", "101"], "--episodes is 101"),
        (["--agent", "gp_ucb", "--seeds", "5:9", "--episodes", "6"], "--episodes is 6"),
        (["--agent", "gp_ucb", "--seeds", "9:5"], "seeds are '9:5'"),
        (["--agent", "gp_ucb", "--seeds", "1,x"], "seeds are '1,x'"),
        (["--agent", "gp_ucb", "--envs", "0"], "--envs is 0"),
        (["--agent", "gp_ucb", "--submit"], "--submit is for --policy and --agent MODULE:CLASS"),
        (["--agent", "my:Own", "--submit", "--seeds", "5"], "--seeds is '5'"),
        (
            ["--agent", "gp_ucb", "--env", "SurgSim/Palpate-v0"],
            "--env and --env-arguments are for --agent MODULE:CLASS",
        ),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            surgsim("evaluate", *arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--agent", "gp_ubc"], "agent 'gp_ubc' is unknown"),
        (["--agent", "nowhere_at_all:Agent"], "there is no module 'nowhere_at_all' on Python's path"),
        (["--agent", "surgsim_apps.scoring.site_search:Nobody"], "has no class 'Nobody'"),
        (["--agent", "surgsim_apps.scoring.evaluate:Player"], "missing"),
        (["--agent", "surgsim_apps.scoring.site_search:SiteFacts"], "missing"),
        (["--agent", "expert_retract", "--level", "hard"], "level 'hard' has nothing to hide"),
        (["--agent", "expert_retract", "--scene", "phantom"], r"scene 'phantom' has no \[retract\] table"),
        (["--agent", "expert_retract", "--budget", "3"], "--budget is the number of presses"),
        (["--agent", "expert_retract", "--no-tracking"], "--no-tracking is for the presses"),
        (["--compare", "gp_ucb.json", "nobody.json"], "gp_ucb.json: No such file"),
    ],
)
def test_what_cannot_be_played_is_refused(arguments: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        surgsim("evaluate", *arguments, *(["--episodes", "1"] if "--agent" in arguments else []))


def test_seeds_are_read_as_they_are_written() -> None:
    for text, seeds in (("5:8", (5, 6, 7, 8)), ("5", (5,)), ("5,8", (5, 8)), ("8,5,6", (8, 5, 6))):
        assert read_seeds(text) == seeds and seeds_text(seeds) == text
    assert read_seeds("7:7") == (7,) and seeds_text((5, 6)) == "5:6"
    for wrong in ("", "a", "5:", "5:8:9", "-3:2", "5,,6", "8:5", "5:8,9"):
        with pytest.raises(ValueError, match="the rule is FIRST:LAST"):
            read_seeds(wrong)


def test_results_of_other_seeds_are_not_written_by_themselves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor those of some evaluation seeds, or of an agent from elsewhere."""
    monkeypatch.setattr(evaluate, "shipped_results", lambda: tmp_path / "ours")
    common = ["--scene", "phantom_small", "--budget", "1", "--envs", "1"]
    for arguments in (
        ["--agent", "random", "--seeds", "3"],
        ["--agent", "random", "--episodes", "1"],
        ["--agent", "surgsim_apps.scoring.site_search:RandomSites", "--episodes", "1"],
    ):
        surgsim("evaluate", *arguments, *common)
        assert "not written (--results FOLDER does)" in capsys.readouterr().out
    assert not (tmp_path / "ours").exists()
    monkeypatch.setattr("surgsim_apps.scoring.options.EVALUATION_SEEDS", range(1_000_000, 1_000_001))
    own_scene = shutil.copy(scenes_folder() / "organs" / "phantom_small.toml", tmp_path)
    for arguments in (
        ["--scene", "phantom_small", "--budget", "1"],
        ["--scene", "phantom_small", "--dtype", "float64"],
        ["--scene", own_scene],
    ):
        surgsim("evaluate", "--agent", "middle", "--envs", "1", *arguments)
        assert "not written" in capsys.readouterr().out
    surgsim("evaluate", "--agent", "middle", "--envs", "1", "--scene", "phantom_small")
    (made,) = load_results(tmp_path / "ours")
    assert made.place == "PalpateSites_phantom_small_standard"
    surgsim("evaluate", "--agent", "random", "--seeds", "3,9", "--results", str(tmp_path / "mine"), *common)
    (made,) = load_results(tmp_path / "mine")
    assert made.seeds == (3, 9) and "--seeds 3,9" in made.command


def test_a_family_is_scored_on_its_test_split(tmp_path: Path) -> None:
    """Wherever its name comes from, unless a split is named."""
    pytest.importorskip("torch", reason="needs the `agents` extra")
    described = SimpleNamespace(env_id=SITES, env_kwargs={"scene": "liver_family", "split": "train"})
    policy = SimpleNamespace(description=described, reset=lambda count: None)
    mine = "surgsim_apps.scoring.site_search:RandomSites"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("surgsim_apps.training.policy_files.load_policy", lambda path, **more: policy)

        def split(method: str, **given: Any) -> str | None:
            made = ScoringOptions(**given)
            player = (
                evaluate.policy_player(Path("p"), made) if method == "policy" else evaluate.find_player(method, made)
            )
            return player.kwargs.get("split")

        assert split("gp_ucb", scene="liver_family") == "test"
        assert split("policy") == "test" and split("policy", split="train") == "train"
        assert split("policy", scene="phantom") is None
        named = json.dumps({"scene": "liver_family"})
        assert split(mine, env_arguments=named) == "test"
        assert split(mine, env_arguments=json.dumps({"scene": "liver_family", "split": "validation"})) == "validation"
        with pytest.raises(ValueError, match=r"scene is given by --scene and in --env-arguments: leave one out"):
            split(mine, scene="phantom", env_arguments=named)


def test_all_methods_are_those_that_the_place_suits(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch", reason="needs the `agents` extra")
    played: list[str] = []
    monkeypatch.setattr(evaluate, "evaluate", lambda player, options, console: played.append(player.name))
    surgsim("evaluate", "--all", "--scene", "phantom_wide", "--episodes", "1")
    assert {"raster_3", "raster_6", "sites_evolved", "palpate_organs", "gp_ucb"} <= set(played)
    assert not {"raster_2", "raster_7", "retract_dagger"} & set(played)


AGENT = """
import numpy as np

class Middle:
    def reset(self, rng, facts):
        self.facts = facts
    def act(self, observation):
        return np.zeros(2, dtype=np.float32)
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A stranger's file in the working folder, from which modules are imported."""
    (tmp_path / "strangers_agent.py").write_text(AGENT, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    yield tmp_path / "strangers_agent.py"
    sys.modules.pop("strangers_agent", None)


def test_a_strangers_result_is_submitted(module: Path) -> None:
    name = ["--agent", "strangers_agent:Middle", "--scene", "phantom_small", "--seeds", "3:4", "--budget", "2"]
    surgsim("evaluate", *name, "--results", "mine")
    (file,) = Path("mine").iterdir()
    made = load_result(file)
    assert made.method == "strangers_agent.Middle" and made.place == "PalpateSites_phantom_small_standard"
    assert str(module.parent) not in file.read_text()
    Path("broken.json").write_text("{}", encoding="utf-8")
    with pytest.raises(ValueError, match=r"broken.json is no result of surgsim evaluate"):
        surgsim("evaluate", "--compare", str(file), "broken.json")


def test_seeds_of_a_submission_follow_from_its_file(module: Path) -> None:
    name = ["--agent", "strangers_agent:Middle", "--scene", "phantom_small", "--episodes", "2", "--budget", "1"]

    def submitted() -> Result:
        surgsim("evaluate", *name, "--submit", "--results", "mine")
        return load_result(Path("mine/PalpateSites_phantom_small_standard_strangers_agent.Middle_submission.json"))

    first = submitted()
    assert first.agent_digest == hashlib.sha256(module.read_bytes()).hexdigest() and "--submit" in first.command
    stream = submission_seeds(first.agent_digest, SITES, "phantom_small", "standard")
    assert list(first.seeds) == list(itertools.islice(stream, 2)) and submitted().seeds == first.seeds
    module.write_text(AGENT + "# Another.\n", encoding="utf-8")
    assert not {*submitted().seeds} & {*first.seeds}
    surgsim("evaluate", *name, "--results", "mine")
    assert len(list(Path("mine").iterdir())) == 2
    # A class of another file, which the digest of this one would not cover.
    module.write_text("from surgsim_apps.scoring.site_search import RandomSites", encoding="utf-8")
    sys.modules.pop("strangers_agent")
    with pytest.raises(ValueError, match=r"module surgsim_apps\.scoring\.site_search"):
        surgsim("evaluate", "--agent", "strangers_agent:RandomSites", "--submit")


def test_the_digest_of_a_package_is_of_all_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights among them, by name and content, as `sha256sum` lists them."""
    files = {"__init__.py": b"", "weights/a.bin": b"\x00"}
    for name, content in files.items():
        path = tmp_path / "strangers_package" / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("strangers_package")
    lines = "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in files.items())
    assert module_digest("strangers_package") == hashlib.sha256(lines.encode()).hexdigest()
    sys.modules.pop("strangers_package")


def test_two_methods_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    errors = [[20.0, 1.0], [9.0, 9.0]]
    for method, rows in (("one", errors), ("ppo", [[1.0, 1.0], [1.0, 1.0]])):
        episodes = {"success": [float(row[-1] <= 5.0) for row in rows], "error_mm": [row[-1] for row in rows]}
        episodes["error_of_presses_mm"] = [sum(row) / 2.0 for row in rows]
        result(method, errors_mm=rows, episodes=episodes, lesion_counts=[1, 1], budget=2).save(tmp_path)
    files = [str(tmp_path / f"PalpateSites_phantom_hard_{name}.json") for name in ("one", "ppo")]
    surgsim("evaluate", "--compare", *files)
    printed = capsys.readouterr().out
    assert "success: one 50, ppo 100 %; difference -50" in printed
    assert "error over all presses: one 9.75, ppo 1.00 mm; difference +8.75" in printed


@pytest.mark.parametrize(
    ("policy", "options", "message"),
    [
        ("retract_dagger", ["--level", "hard"], "level 'hard' has nothing to hide"),
        ("retract_dagger", ["--scene", "phantom"], r"scene 'phantom' has no \[retract\] table"),
    ],
)
def test_a_policy_does_not_play_what_it_was_not_made_for(policy: str, options: list[str], message: str) -> None:
    """Among them scenes whose observations have the same shape, which it would answer wrong without a word."""
    pytest.importorskip("torch", reason="needs the `agents` extra")
    path = policies_folder() / f"{policy}.json"
    with pytest.raises(ValueError, match=message):
        surgsim("evaluate", "--policy", str(path), "--seeds", "3", *options)


def test_level_and_motion_beside_a_policy_are_honoured(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs the `agents` extra")
    path = policies_folder() / "sites_evolved.json"
    common = ["--policy", str(path), "--seeds", "3", "--results", str(tmp_path)]
    surgsim("evaluate", *common, "--level", "easy", "--motion", "calm", "--scene", "phantom")
    (made,) = load_results(tmp_path)
    assert (made.scene, made.env_kwargs["level"], made.motion) == ("phantom", "easy", "calm")
    place = "--scene phantom --level easy --motion calm --seeds 3"
    assert made.command == f"surgsim evaluate --policy agents/policies/sites_evolved.json {place}"
