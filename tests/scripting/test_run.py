"""A run goes on from a saved state: the same trace to the bit; every steered tip has an oracle."""

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.scripting import Control, Hold, Lift, PressUntil, oracle_script, run_script

ARRAYS = (
    *("haptic_time", "wrench", "tip_position", "tip_orientation"),
    *("control_time", "observation", "action", "reward"),
)


def assert_same(first, other, names=(*ARRAYS, "depth")):
    for name in names:
        assert getattr(first, name).tobytes() == getattr(other, name).tobytes(), name
    assert first.infos == other.infos


def press():
    return [PressUntil(0.2, 0.015, sensed=True), Hold(0.1), Lift(0.008)]


@pytest.mark.parametrize("instrument", ["probe", "psm_palpator"])
def test_a_run_goes_on_from_a_saved_state_to_the_bit(instrument):
    env, other = (gym.make("SurgSim/Palpate-v0", instrument=instrument) for _ in range(2))
    whole = run_script(env, press(), seed=7)
    run_script(env, press()[:1], seed=7)
    saved = env.unwrapped.save_state()
    for target in (env, other):
        target.reset(seed=1)
        target.unwrapped.load_state(saved)
        rest = run_script(target, press()[1:])
        part = whole.between("Hold", "Lift")
        assert rest.start == part.start and rest.steps == part.steps
        # Depth counts from where the contact began in the run: all else is the same.
        assert_same(rest, part, ARRAYS)


def test_what_a_wrapper_makes_of_observations_is_what_a_controller_sees():
    seen = []

    def controller(observation):
        seen.append(observation)
        return np.zeros(4)

    env = gym.wrappers.TransformObservation(
        gym.make("SurgSim/Palpate-v0"), lambda observation: observation[6:9], gym.spaces.Box(-2.0, 2.0, (3,))
    )
    trace = run_script(env, [Control(controller, timeout=0.1)], seed=3)
    assert trace.observation.shape == (2, 3) and [part.shape for part in seen] == [(3,), (3,)]
    # Steps of ours go on reading the environment's own.
    trace = run_script(env, [PressUntil(0.1, 0.008, sensed=True), Control(controller, timeout=0.05)])
    assert trace.peak_force > 0.05


def test_every_environment_whose_tip_is_steered_has_an_oracle():
    # A step of PalpateSites-v0 is a whole press: there is no way of the tip to script.
    for env_id in ("SurgSim/Palpate-v0", "SurgSim/Retract-v0", "SurgSim/BimanualRetract-v0"):
        env = gym.make(env_id)
        env.reset(seed=0)
        assert oracle_script(env)


CASES = [("phantom", "probe"), ("phantom", "psm_palpator"), ("liver", "probe"), ("liver", "psm_palpator")]


def oracle_run(scene, instrument, seeds):
    env = gym.make("SurgSim/Palpate-v0", scene=scene, instrument=instrument)
    for seed in seeds:
        env.reset(seed=seed)
        yield env.unwrapped, run_script(env, oracle_script(env))


@pytest.mark.parametrize(
    ("scene", "instrument"), [*CASES[:2], *(pytest.param(*case, marks=pytest.mark.slow) for case in CASES[2:])]
)
def test_the_oracle_finds_the_lesion_gently(scene, instrument):
    ((env, trace),) = oracle_run(scene, instrument, [1])
    limits = env.scene.limits
    assert trace.info["success"] and trace.info["error_mm"] < 5.0 and not trace.info["sim_fault"]
    assert trace.reward[-1] > 9.9
    # Nothing is touched on the way, and the press stays gentle.
    assert trace.between("rise", "come down").peak_force == 0.0
    assert 0.38 * limits.soft_force < trace.peak_force < 0.45 * limits.soft_force
    assert trace.duration < 15.0


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "instrument"), CASES)
def test_the_oracle_finds_nearly_every_lesion(scene, instrument):
    infos = [trace.info for _, trace in oracle_run(scene, instrument, range(20))]
    assert sum(info["success"] for info in infos) >= 19
    assert not any(info["sim_fault"] for info in infos)
