"""No short cut pays: neither a fault, nor an abort, nor an early declare, nor standing still beats an honest search.

By the tables of weights alone, for whatever an episode holds; `test_degenerate_*.py` play degenerate strategies.
"""

import dataclasses
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.tasks.bimanual_retract import BimanualRetractTask
from surgsim_env.tasks.declaration import PERIODS, reward_weights
from surgsim_env.tasks.palpate import EPISODE_STEPS, PalpateTask
from surgsim_env.tasks.palpate_sites import BUDGET, BUDGET_WIDE, PalpateSitesTask
from surgsim_env.tasks.retract import RetractTask
from surgsim_env.tasks.task import Scenario

# The declared terms by what they are paid for, and the number of control steps. Those per step lie in [0, 1]; where
# `shared`, they and `forgone` are shares of the budget. Changes are of a number in [0, 1] and telescope.
TABLES = {
    f"{task.__name__} {steps}": {
        "weights": reward_weights(task),
        "steps": steps,
        "shared": task is PalpateSitesTask,
        **{per: tuple(reward.name for reward in task.rewards if reward.per == per) for per in PERIODS},
    }
    for task, steps in (
        (PalpateTask, EPISODE_STEPS),
        (RetractTask, EPISODE_STEPS),
        (BimanualRetractTask, EPISODE_STEPS),
        (PalpateSitesTask, BUDGET),
        (PalpateSitesTask, BUDGET_WIDE),
    )
}
IDS = sorted(TABLES)
SEED = 1


def of_a_step(table, *terms):
    """The largest pay of terms in a step."""
    return sum(table["weights"][term] for term in terms) / (table["steps"] if table["shared"] else 1)


@pytest.mark.parametrize("name", IDS)
def test_costs_are_negative_and_gains_positive(name):
    table = TABLES[name]
    assert table["failure"] and table["step left"] == ("forgone",)
    assert all(table["weights"][term] < 0.0 for per in ("step", "failure", "step left") for term in table[per])
    assert all(table["weights"][term] > 0.0 for per in ("change", "success") for term in table[per])


@pytest.mark.parametrize("name", IDS)
def test_at_no_moment_does_a_bad_end_pay_more_than_going_on(name):
    """Whatever was paid before, and whatever comes after.

    A bad end in a step with n more to come returns at most failure + n forgone + won, where what can be won at once is
    won in that very step. Going on returns at least (n + 1) per_step - won, where all that there is is lost again. What
    is won and lost are parts of one number in [0, 1], so that together they are that number once, not twice.
    """
    table = TABLES[name]
    weights = table["weights"]
    dearest, forgone = of_a_step(table, *table["step"]), of_a_step(table, "forgone")
    won = sum(weights[term] for term in table["change"])
    for failure in table["failure"]:
        for left in range(table["steps"]):
            assert weights[failure] + left * forgone + won < (left + 1) * dearest, (failure, left)


@pytest.mark.parametrize("name", [name for name in IDS if TABLES[name]["success"]])
def test_a_good_end_pays_more_than_standing_still(name):
    """Even the dearest way to success, in the last step, beats doing nothing at all, which pays time alone."""
    weights = TABLES[name]["weights"]
    reached = sum(weights[term] for term in TABLES[name]["success"])
    dearest = TABLES[name]["steps"] * of_a_step(TABLES[name], *TABLES[name]["step"])
    assert reached + dearest > TABLES[name]["steps"] * weights["time"]


# ---- early declares ---------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["phantom", "phantom_small"])
def test_declaring_at_the_likeliest_place_pays_less_than_a_search_that_finds(scene):
    """The best place of all to declare at once without feeling anything, over 150 draws of the lesion.

    A gentle search that finds in its last step returns found + 600 time.
    """
    weights = reward_weights(PalpateTask)
    right = blind_share(scene)
    missed = weights["wrong"] + EPISODE_STEPS * weights["forgone"]
    blind = right * weights["found"] + (1.0 - right) * missed
    assert blind < weights["found"] + EPISODE_STEPS * weights["time"]
    assert right < 0.2 and blind < EPISODE_STEPS * weights["time"], "a gentle search that finds nothing"


def blind_share(scene):
    """The largest share of drawn lesions that one place on the face is within the success distance of."""
    anatomy, rng = load_anatomy(surgsim_env.make_scene(scene)), np.random.default_rng(0)
    distance = PalpateTask(Scenario(anatomy)).success_distance
    places = np.array([anatomy.face.project(anatomy.random_lesion(rng).centre)[0] for _ in range(150)])
    tried = [places.mean(axis=0), *places[:40]]
    tried = [anatomy.face.project(place)[0] for place in tried]
    return max(float((anatomy.along_surface(place, places) <= distance).mean()) for place in tried)


# ---- failures, played -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["SurgSim/Palpate-v0", "SurgSim/Retract-v0", "SurgSim/BimanualRetract-v0"])
def test_a_fault_is_paid_less_than_an_episode_in_which_nothing_is_found(env_id):
    """In the second step, where it saves most of the time."""
    env: Any = gym.make(env_id).unwrapped
    env.reset(seed=SEED)
    rest = np.zeros(env.action_space.shape, dtype=np.float32)
    total = env.step(rest)[1]
    env.simulation.organ_state.node_velocity[100, 1] = np.nan
    _, reward, over, _, info = env.step(rest)
    assert over and info["sim_fault"]
    assert total + reward < EPISODE_STEPS * reward_weights(env.task)["time"]


# ---- press by press ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def presses():
    return gym.make("SurgSim/PalpateSites-v0")


@pytest.mark.slow
def test_a_press_that_ends_in_harm_is_paid_less_than_the_worst_episode(presses, monkeypatch):
    weights = reward_weights(PalpateSitesTask)
    # What `found` begins with is lost at most.
    worst = weights["error"] + weights["soft_force"] - weights["found"]
    presses.reset(seed=SEED)
    inner = presses.unwrapped
    limits = inner.task.limits
    monkeypatch.setattr(inner.task, "limits", dataclasses.replace(limits, soft_force=0.1, hard_force=0.2))
    _, reward, over, _, info = presses.step(np.zeros(2, dtype=np.float32))
    assert over and info["hard_limit"] and reward < worst
    monkeypatch.setattr(inner.task, "limits", limits)
    presses.reset(seed=SEED)
    total = presses.step(np.zeros(2, dtype=np.float32))[1]
    # A press begins from rest: what has to be wrong is the contact.
    monkeypatch.setattr(inner.simulation, "contact", inner.simulation.contact._replace(stiffness=1e12))
    _, reward, over, _, info = presses.step(np.zeros(2, dtype=np.float32))
    assert over and info["sim_fault"] and total + reward < worst
