"""Scripted episodes in the report: what was run is what is said, figures are the episodes', seeds repeat to the bit."""

import json
import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

from surgsim_env.arm_study import episodes, study
from surgsim_env.arm_study.episodes import (
    MEASURES,
    clause,
    has_pads,
    median_of,
    plain_episodes,
    run_episodes,
    what_was_run,
)
from surgsim_env.arm_study.study import write_report
from surgsim_env.cli.arms import Arms
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.palpation.job import plain_json
from surgsim_env.scene.model import Port
from surgsim_env.scripting import oracle_script, run_script
from tests.arm_study.made import made_episodes, made_evaluation
from tests.arm_study.test_arm_report import Page


def arms(left, right):
    return load_arm(left, Port()), load_arm(right, Port(), tip_radius=0.008)


def quiet(what, share):
    pass


def page_of(run, folder, organ="liver"):
    evaluation = replace(made_evaluation(pictures=False), scene=organ)
    write_report(evaluation, folder / "report.html", pictures=(), maps=(), command="surgsim arms", episodes=run)
    return Page((folder / "report.html").read_text(encoding="utf-8"))


@pytest.mark.slow
@pytest.mark.usefixtures("few_maps")
def test_a_real_episode_in_the_report_and_its_json(tmp_path, monkeypatch):
    """One episode through the command; its figures against a run of the same script by hand."""
    monkeypatch.setattr(study, "evaluate", lambda *_, **__: replace(made_evaluation(pictures=False), scene="x"))
    given = {"points": 10, "episodes": 1, "seed": 1, "out": tmp_path / "out"}
    assert Arms("psm_grasper", "psm_palpator", scene="phantom", **given).run(Console(quiet=True)) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    (one,) = summary["episodes"]
    assert one["seed"] == 1 and one["success"] is True and one["failure"] == ""

    env = gym.make("SurgSim/BimanualRetract-v0")
    env.reset(seed=1)
    distances, forces = [], []
    wrapped = Watched(env, distances, forces)
    trace = run_script(wrapped, oracle_script(wrapped))
    assert one["success_time"] == one["duration"] == pytest.approx(trace.duration, abs=1e-9)
    wanted = {"grip_peak": "grip_force_peak", "grip_mean": "grip_force_mean", "pull_peak": "pull_force_peak"}
    for name, entry in {**wanted, "touch_force": "touch_force", "slips": "slips"}.items():
        assert one[name] == pytest.approx(trace.info[entry], abs=1e-11), name
    assert 0.3 <= one["touch_force"] <= 1.0 and one["pull_peak"] >= one["grip_mean"] > 0.1
    # The observation is in single precision.
    assert one["arm_distance"] == pytest.approx(min(distances), rel=1e-6)
    assert one["collision_peak"] == max(forces)

    page = Page((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    row = page.row("1")
    shown = [f"{one['success_time']:.2f}", *(f"{one[name]:.2f}" for name in (*wanted, "touch_force"))]
    shown += [f"{1e3 * one['arm_distance']:.1f}", f"{one['collision_peak']:.2f}", f"{one['slips']:.0f}"]
    assert row == ["1", "yes", *shown]
    assert page.row("medians") == ["medians", "1 of 1", *shown]
    text = " ".join("".join(page.text).split())
    assert "psm_retractor takes the place of psm_grasper on the left" in text
    assert "This is the scene lobe, not x, and its own two ports, at (-10, 200, 60) mm and (90, 200, 60) mm" in text
    assert summary["verdict"] in text and "in 1 of 1 episodes" in summary["verdict"]
    assert "--episodes 1" in text


class Watched(gym.Wrapper):
    """Looks at the arms after each step."""

    def __init__(self, env, distances, forces):
        super().__init__(env)
        self.distances, self.forces = distances, forces

    def step(self, action):
        done = super().step(action)
        pair = self.unwrapped.simulation.instrument
        self.distances.append(pair.distance)
        self.forces.append(pair.collision_force)
        return done


def test_which_arms_can_do_the_task():
    assert has_pads(load_arm("psm_retractor", Port()))
    for name in ("psm_grasper", "psm_palpator", "six_axis"):
        assert not has_pads(load_arm(name, Port())), name


@pytest.mark.parametrize(
    ("given", "ran", "sides"),
    [
        (("psm_retractor", "six_axis"), "psm_retractor+six_axis", []),
        (("psm_grasper", "six_axis"), "psm_retractor+six_axis", ["left"]),
        (("six_axis", "psm_grasper"), "psm_retractor+psm_palpator", ["left", "right"]),
    ],
)
def test_arms_that_cannot_do_it_have_stand_ins_and_are_named(monkeypatch, given, ran, sides):
    made = []

    def refuse(env_id, *, scene, instrument, scaled):
        made.append(instrument)
        raise ValueError("the right arm\ndoes not reach")

    monkeypatch.setattr(episodes.gym, "make", refuse)
    found = run_episodes(given, arms(*given), range(2), quiet)
    assert made == [ran] and f"{found.left}+{found.right}" == ran
    assert [(one.side, one.given) for one in found.stand_ins] == [
        (side, name) for side, name in zip(("left", "right"), given, strict=True) if side in sides
    ]
    assert found.left_out == "the right arm does not reach" and found.runs == ()
    said = what_was_run(found, "liver")
    assert said[0] == "No episodes were run: the right arm does not reach." and len(said) == 1 + len(sides)
    assert clause(found) == ""
    assert plain_episodes(found)["episodes"] == []


def test_an_episode_that_cannot_begin_is_told():
    class Refusing:
        def reset(self, seed):
            raise ValueError("the arm cannot put its tip there")

    one = episodes.run_episode(Refusing(), 7)
    assert not one.success and one.reason == "it could not begin: the arm cannot put its tip there"
    assert math.isnan(one.duration) and math.isnan(one.success_time)


def test_the_table_and_the_summary_of_failures(tmp_path):
    run = made_episodes(failing=True)
    page = page_of(run, tmp_path)
    assert page.row("3")[1:] == ["yes", "11.20", "0.37", "0.26", "0.46", "0.56", "11.2", "0.00", "0", ""]
    why = "step 4 of 9, 'lift', tore the tissue (1.203 N)"
    assert page.row("4")[1:] == ["no", "–", "0.41", "0.20", "1.20", "0.00", "≥50.0", "0.10", "2", why]
    assert page.row("5")[1:] == ["no", *["–"] * 8, "it could not begin: <no way>"]
    assert page.row("medians")[1:5] == ["1 of 3", "11.20", "0.39", "0.23"]
    table = plain_json(plain_episodes(run))
    assert [one["success_time"] for one in table["episodes"]] == [11.2, None, None]
    assert table["episodes_of"]["successes"] == 1 and table["episodes_of"]["stand_ins"][0]["given"] == "psm_grasper"
    json.dumps(table, allow_nan=False)


def test_without_episodes_there_is_no_section(tmp_path):
    assert "Scripted episodes" not in page_of(None, tmp_path).text
    assert "Scripted episodes" in page_of(made_episodes(), tmp_path).text
    assert plain_episodes(None) == {"episodes": [], "episodes_of": None}


def test_medians_are_of_what_was_measured():
    run = made_episodes(failing=True)
    time, grip = MEASURES[0], MEASURES[1]
    assert median_of(run.runs, time) == 11.2 and median_of(run.runs, grip) == pytest.approx(0.39)
    assert np.isnan(median_of(run.runs[2:], grip))
