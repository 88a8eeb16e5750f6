"""The soak finds what it watches for, and a run of it repeats."""

import platform

import numpy as np
import pytest

from benchmarks import soak
from surgsim_env.envs.surgical_env import SurgicalEnv
from surgsim_env.scene.load import make_scene

RUN = soak.Run(0, 0, "SurgSim/Palpate-v0", {"scene": "phantom_small"}, 1, "alone", "adversarial")


@pytest.fixture
def few_steps(monkeypatch):
    monkeypatch.setattr(soak, "STEPS", 4)


@pytest.fixture(scope="module")
def watch():
    envs = RUN.make()
    envs.reset(seed=[0])
    return soak.Watch(RUN, envs, soak.Outcome())


@pytest.fixture
def findings(watch):
    watch.outcome.findings.clear()
    return watch.outcome.findings


def test_a_run_is_clean_and_repeats(few_steps):
    first, second = soak.play(RUN), soak.play(RUN)
    assert first == second and not first.findings
    timing = make_scene("phantom_small").timing
    assert first.steps == 4 and first.substeps == 4 * timing.haptic_steps_per_control * timing.substep_count


def test_every_drawn_run_is_one_that_can_be_made():
    drawn = [soak.Run.drawn(3, number) for number in range(200)]
    assert {run.env_id for run in drawn} == set(soak.CASES)
    assert {(run.width, run.dtype) for run in drawn} == set(soak.WIDTHS)
    assert {run.dtype for run in drawn if run.env_id == "SurgSim/BimanualRetract-v0"} == {"alone"}
    quick = [soak.Run.drawn(3, number, quick=True) for number in range(200)]
    assert {run.settings["scene"] for run in quick if "scene" in run.settings} == {soak.QUICK_SCENE}


def test_a_tet_inside_out_without_a_fault_is_found(watch, findings):
    nodes = watch.singles[0].simulation.organ_state.node_position
    at_rest = nodes.copy()
    watch.check_tets(0, watch.singles[0], "")
    assert not findings
    tet = watch.singles[0].simulation.anatomy.mesh.tets[7]
    nodes[tet[0]] += 2.0 * (nodes[tet[1:]].mean(axis=0) - nodes[tet[0]])
    watch.check_tets(0, watch.singles[0], "contact lost")
    assert "volume ratio -" in findings[0]
    findings.clear()
    watch.check_tets(0, watch.singles[0], "tet inverted")
    assert not findings
    nodes[:] = at_rest


def test_an_end_without_a_name_is_found(watch, findings):
    env, none = watch.singles[0], {"success": False, "hard_limit": False}
    assert watch.end_of(env, {"sim_fault": "tet 7 turned inside out: ...", **none}, False) == "tet inverted"
    assert watch.end_of(env, {"sim_fault": "", **none, "hard_limit": True}, False) == "hard_limit"
    assert watch.end_of(env, {"sim_fault": "", **none}, True) == "time"
    assert not findings
    watch.end_of(env, {"sim_fault": "", **none}, False)
    watch.end_of(env, {"sim_fault": "something new", **none}, False)
    assert len(findings) == 2 and "something new" in findings[1]


def test_numbers_that_are_out_of_bounds_are_found(watch, findings):
    observation = np.stack([watch.singles[0].observation])
    watch.check(observation, np.zeros(1))
    assert not findings
    observation[0, 3] = np.nan
    watch.check(observation, np.array([np.inf]))
    assert len(findings) == 2 and "observation[[3]]" in findings[0] and "not finite" in findings[1]


def test_a_reset_that_is_not_clean_is_found(few_steps, monkeypatch):
    saved = SurgicalEnv.save_state
    count = iter(range(10))
    monkeypatch.setattr(SurgicalEnv, "save_state", lambda env: saved(env) + bytes(next(count)))
    assert "does not give the first state" in soak.play(RUN).findings[0]


def test_kinds_of_environments_repeat_with_other_actions():
    first, again = ([soak.Run.drawn(3, number) for number in range(start, start + 40)] for start in (0, soak.KINDS))
    kinds = [[(run.env_id, run.settings, run.width, run.dtype) for run in runs] for runs in (first, again)]
    assert kinds[0] == kinds[1] and [run.actor for run in first] != [run.actor for run in again]


def test_memory_is_compared_once_kinds_repeat():
    """Runs of one kind with each other: kinds hold different amounts."""
    count, kinds = 3 * soak.KINDS, soak.KINDS
    memory = [1e9 * (number % kinds) + 1e6 * max(number - kinds, 0) for number in range(count)]
    assert soak.growth(memory) == pytest.approx(1e6 * kinds)
    assert soak.growth([1e6] * (2 * kinds + 4)) is None


def freed(blocks):
    """Blocks of 64 kB are made and freed, but for the last, which keeps malloc from giving them back by itself."""
    made = [np.ones(8192) for _ in range(blocks)]
    return made[-1]


needs_glibc = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="malloc_trim is of glibc")


@needs_glibc
def test_memory_held_is_without_what_malloc_keeps():
    before, resident = soak.memory_held(), soak.memory_resident()
    last = freed(1600)
    kept = soak.memory_resident() - resident
    assert kept > 80e6 and soak.memory_held() - before < 5e6
    held = np.ones(5_000_000)
    assert soak.memory_held() - before == pytest.approx(held.nbytes + last.nbytes, abs=5e6)
