"""Scripts that grasp: jaw steps, and the oracle of a retraction."""

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401  (registers the environments)
from surgsim_apps.cli.main import main
from surgsim_env.scripting import (
    AwaitEnd,
    CloseJaw,
    Hold,
    MayEnd,
    MoveTo,
    OfArm,
    OpenJaw,
    PressUntil,
    ScriptError,
    oracle_script,
    run_script,
)

# On the lobe's free edge, its middle between the open pads.
EDGE = (0.040, 0.0475, 0.006)


@pytest.fixture(scope="module")
def env():
    return gym.make("SurgSim/Retract-v0")


def grasped(env, seed=0, *, after=()):
    """The trace of a grasp of the edge, and of what is done after it."""
    return run_script(
        env, [MoveTo((0.040, 0.068, 0.006)), MoveTo(EDGE, 0.015), CloseJaw(0.3), Hold(0.5), *after], seed=seed
    )


@pytest.mark.slow
def test_jaw_closes_to_its_force_and_opens_to_nothing(env):
    trace = grasped(env, after=[OpenJaw(0.018), MoveTo((0.040, 0.068, 0.006)), Hold(0.2)])
    jaw, normals = env.unwrapped.simulation.instrument.jaw, trace.between("Hold")
    grip = np.abs(normals.wrench[-100:, jaw.tools, 2]).mean(axis=0)
    assert (grip > 0.3).all()
    assert trace.between("CloseJaw").info["grip_force"] >= 0.3
    assert trace.between("OpenJaw").observation[-1][12] > 0.018
    assert trace.between("Hold 2").peak_force == 0.0


def test_a_jaw_that_closes_on_nothing_fails(env):
    with pytest.raises(ScriptError, match=r"CloseJaw.*ran out of its 1 s"):
        run_script(env, [CloseJaw(0.2, timeout=1.0)], seed=0)


@pytest.mark.slow
def test_only_a_step_that_may_end_in_success_does(env):
    """The oracle without its MayEnd: success in the middle of the script is an error, named as one."""
    env.reset(seed=1)
    script = oracle_script(env)
    assert [type(step) for step in script[-3:]] == [MayEnd, MayEnd, AwaitEnd]
    bare = [step.step.step if isinstance(step, MayEnd) else step for step in script]
    with pytest.raises(ScriptError, match="was cut short") as caught:
        run_script(env, bare)
    assert caught.value.trace.info["success"]
    env.reset(seed=1)
    assert run_script(env, oracle_script(env)).info["success"]


@pytest.mark.parametrize(
    ("env_id", "instrument"),
    [
        ("Retract", "grasper"),
        pytest.param("Retract", "psm_retractor", marks=pytest.mark.slow),
        pytest.param("BimanualRetract", "psm_pair", marks=pytest.mark.slow),
    ],
)
def test_oracle_retracts(env_id, instrument):
    check_oracle(env_id, instrument, range(1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "instrument", "seeds"),
    [("Retract", "grasper", 100), ("Retract", "psm_retractor", 30), ("BimanualRetract", "psm_pair", 100)],
)
def test_oracle_retracts_on_many_seeds(env_id, instrument, seeds):
    check_oracle(env_id, instrument, range(seeds))


def check_oracle(env_id, instrument, seeds):
    """At least 95 % of the seeds succeed, none comes to a fault; the target was hidden when they began."""
    env = gym.make(f"SurgSim/{env_id}-v0", instrument=instrument)
    failed = []
    for seed in seeds:
        env.reset(seed=seed)
        assert env.unwrapped.task.visible_share <= 0.1
        try:
            trace = run_script(env, oracle_script(env))
        except ScriptError as error:
            trace = error.trace
        assert not trace.info["sim_fault"], f"seed {seed}: {trace.info['sim_fault']}"
        if not trace.info["success"]:
            failed.append(f"seed {seed}: {trace.failure}")
    assert len(failed) <= 0.05 * len(seeds), "\n".join(failed)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["Retract", "BimanualRetract"])
def test_random_actions_do_not_retract(env_id):
    """At most 5 % of the seeds."""
    env = gym.make(f"SurgSim/{env_id}-v0")
    env.action_space.seed(0)
    successes = 0
    for seed in range(20):
        env.reset(seed=seed)
        ended = False
        while not ended:
            *_, terminated, truncated, info = env.step(env.action_space.sample())
            ended = terminated or truncated
        successes += info["success"]
    assert successes <= 1


@pytest.mark.slow
def test_pulling_at_the_speed_limit_does_not_ring(env):
    """A grasped edge pulled by 8 mm at 20 mm/s: the pull changes by 2 % a haptic step at most; then it relaxes.

    A tension that rises for T relaxes as 1 + sum g_i (tau_i / T) (1 - exp(-T / tau_i)) exp(-t / tau_i) after the rise;
    the weight in the pull does not.
    """
    trace = grasped(env, after=[MoveTo((0.040, 0.0525, 0.012), 0.02, name="pull"), Hold(1.0, name="rest")])
    jaw = env.unwrapped.simulation.instrument.jaw
    pull = np.linalg.norm(trace.between("pull", "rest").wrench[:, jaw.tools, :3].sum(axis=1), axis=1)
    assert pull.max() > 0.15
    assert np.abs(np.diff(pull)).max() < 0.02 * pull.max()
    last, time = pull[-500:], np.arange(500.0)
    assert np.abs(last - np.polyval(np.polyfit(time, last, 2), time)).max() < 0.005 * last.mean()
    arms = env.unwrapped.scene.material.relaxation
    times, rise = np.array(arms.times), 0.4
    share = np.array(arms.relative_moduli) * times / rise * (1.0 - np.exp(-rise / times))
    tensions = [1.0 + share @ np.exp(-after / times) for after in (0.0, 0.75)]
    assert 1.05 < pull.max() / last.mean() < tensions[0] / tensions[1]


@pytest.mark.slow
def test_pressing_at_the_speed_limit_neither_tunnels_nor_rings(env):
    """The open jaw's lower pad laid on the lobe and pressed down at 20 mm/s, to 1.2 N: the force rises and rests."""
    script = [
        MoveTo((0.040, 0.068, 0.030)),
        MoveTo((0.040, 0.030, 0.030)),
        PressUntil(1.2, max_depth=0.012, speed=0.02, direction=(0.0, 0.0, -1.0), name="press"),
        Hold(0.6, name="rest"),
    ]
    trace = run_script(env, script, seed=0)
    press = trace.between("press").force_size
    assert press.max() > 1.1
    # Rising: it never falls by more than 2 % of the largest from one haptic step to the next.
    assert np.diff(press).min() > -0.02 * press.max()
    last = trace.between("rest").force_size[-300:]
    assert np.ptp(last) < 0.02 * last.mean()
    assert not trace.info["sim_fault"]


def test_steps_of_one_arm_leave_the_other_where_it_is():
    """Its tip goes 20 mm up; the other one stays to 10 um."""
    env = gym.make("SurgSim/BimanualRetract-v0")
    env.reset(seed=0)
    arms = env.unwrapped.simulation.instrument.arms
    places = {side: arm.tip_position for side, arm in arms.items()}
    goal = tuple((places["right"] + [0.0, 0.0, 0.02]).tolist())
    run_script(env, [OfArm(MoveTo(goal), "right"), OfArm(Hold(0.2), "left")])
    assert arms["right"].tip_position == pytest.approx(goal, abs=1e-3)
    assert arms["left"].tip_position == pytest.approx(places["left"], abs=1e-5)


@pytest.mark.slow
def test_command_retracts_and_writes(tmp_path, capsys):
    assert main(["retract", "--seed", "1", "--out", str(tmp_path)]) == 0
    assert "retracted in" in capsys.readouterr().out
    written = {path.name for path in tmp_path.iterdir()}
    assert {"trace.csv", "trace_control.csv", "forces.png", "summary.json"} <= written
