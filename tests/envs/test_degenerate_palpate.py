"""SurgSim/Palpate-v0: no degenerate strategy is paid as much as a plain search by touch."""

from collections.abc import Iterator

import numpy as np
import pytest

from surgsim_apps.scoring.episodes import agent_generator, episode_facts
from surgsim_env.tasks.declaration import SPEED_FULL_SCALE, reward_weights
from surgsim_env.tasks.palpate import DECLARE_STEPS, EPISODE_STEPS, PalpateTask
from tests.envs.raster_agent import RasterAgent
from tests.envs.strategies import Now, mean_return, play

ID = "SurgSim/Palpate-v0"
CONTROL_STEP = 0.05
# Below the surface [m], where a declaration is made.
PRESS_DEPTH = 0.002


def move(x: float = 0.0, y: float = 0.0, z: float = 0.0, declare: float = 0.0) -> np.ndarray:
    return np.array([x, y, z, declare])


def raster(now: Now) -> Iterator[np.ndarray]:
    """The honest agent: presses 4 x 4 sites, goes back to the stiffest and declares it, by observations alone."""
    agent = RasterAgent(sites_per_side=4)
    agent.reset(agent_generator(0), episode_facts(now.env, ID, {"scene": SCENE}))
    while True:
        yield agent.act(now.observation)


# ---- degenerate strategies --------------------------------------------------------------------------------------


def stand_still(now: Now) -> Iterator[np.ndarray]:
    while True:
        yield move()


def leave(now: Now) -> Iterator[np.ndarray]:
    """Up and away, out of reach of any force."""
    while True:
        yield move(1.0, 1.0, 1.0)


def hover(now: Now) -> Iterator[np.ndarray]:
    """Declare without rest, a millimetre over the surface."""
    while True:
        yield go(now, over_middle(now, -0.001), declare=1.0)


def ram(now: Now) -> Iterator[np.ndarray]:
    """End the episode, and with it what time costs, by the hard limit."""
    while True:
        yield move(z=-1.0)


def plough(now: Now) -> Iterator[np.ndarray]:
    """End it by a fault: dig in and drag to and fro at full speed."""
    yield from arrive(now, over_middle(now, 2.0 * PRESS_DEPTH))
    while True:
        for x in (1.0, -1.0):
            for _ in range(8):
                yield move(x=x, z=-0.1)


def declare_at_once(now: Now) -> Iterator[np.ndarray]:
    """Declare wherever the tip happens to touch first."""
    while True:
        yield move(z=-0.3, declare=1.0)


def declare_in_the_middle(now: Now) -> Iterator[np.ndarray]:
    """Declare the likeliest place without a search."""
    yield from arrive(now, over_middle(now, PRESS_DEPTH))
    while True:
        yield move(declare=1.0)


def guess_late(now: Now) -> Iterator[np.ndarray]:
    """Declare the likeliest place in the last step, where a failure forgoes nothing."""
    yield from arrive(now, over_middle(now, PRESS_DEPTH))
    while now.task.step_count < EPISODE_STEPS - DECLARE_STEPS:
        yield move()
    while True:
        yield move(declare=1.0)


def shake(now: Now) -> Iterator[np.ndarray]:
    """Up and down at full speed on the tissue."""
    yield from arrive(now, over_middle(now, 0.0005))
    while True:
        yield move(z=-1.0)
        yield move(z=1.0)


def wander(now: Now) -> Iterator[np.ndarray]:
    """Uniformly drawn actions."""
    while True:
        yield now.rng.uniform(-1.0, 1.0, 4)


def lean(now: Now) -> Iterator[np.ndarray]:
    """Keep the force just under the soft limit, where it costs nothing."""
    yield from hold_force(now, 0.9 * now.scene.limits.soft_force)


def strain(now: Now) -> Iterator[np.ndarray]:
    """Keep the force between the limits."""
    yield from hold_force(now, 0.5 * (now.scene.limits.soft_force + now.scene.limits.hard_force))


def saturate(now: Now) -> Iterator[np.ndarray]:
    """Press till the sensor shows the end of its range, above the hard limit."""
    yield from hold_force(now, now.scene.sensor.range)


def farm_found(now: Now) -> Iterator[np.ndarray]:
    """Begin a declaration at one place after the other, one control step too short to be judged."""
    while True:
        x, y = now.rng.uniform(-0.01, 0.01, 2)
        yield from arrive(now, over_middle(now, PRESS_DEPTH) + np.array([x, y, 0.0]))
        for _ in range(DECLARE_STEPS - 1):
            yield move(declare=1.0)
        yield move()


DEGENERATE = {
    strategy.__name__: strategy
    for strategy in (
        stand_still,
        leave,
        hover,
        ram,
        plough,
        declare_at_once,
        declare_in_the_middle,
        guess_late,
        shake,
        wander,
        lean,
        strain,
        saturate,
        farm_found,
    )
}


def go(now: Now, place: np.ndarray, declare: float = 0.0) -> np.ndarray:
    """At full speed towards a place [m] (3,), more slowly in its last millimetre."""
    return np.append((place - now["tip_position"]) / (SPEED_FULL_SCALE * CONTROL_STEP), declare)


def arrive(now: Now, place: np.ndarray) -> Iterator[np.ndarray]:
    while np.linalg.norm(place - now["tip_position"]) > 0.0007:
        yield go(now, place)


def over_middle(now: Now, depth: float) -> np.ndarray:
    """The tip [m] (3,) where its ball is so deep in the middle of the block's top."""
    x, y, z = now.scene.mesh.block.size
    return np.array([0.5 * x, 0.5 * y, z + now.scene.instrument.tip_radius - depth])


def hold_force(now: Now, force: float) -> Iterator[np.ndarray]:
    """Down till a force [N] is felt, then after it."""
    while True:
        short = force - now["contact_force"][2]
        yield move(z=-np.clip(short / 0.3, -0.4, 0.4))


# ---- played -----------------------------------------------------------------------------------------------------


def test_only_a_declaration_pays():
    """So that an episode without one returns at most 0, whatever is done in it."""
    assert [reward.name for reward in PalpateTask.rewards if reward.weight > 0.0] == ["found"]


SCENE, SEEDS = "phantom_small", range(8)


@pytest.fixture(scope="module")
def honest():
    return mean_return(play(ID, {"raster": raster}, SEEDS, scene=SCENE)["raster"])


def test_a_plain_search_is_paid_more_than_early_declarations_and_than_none(honest):
    assert honest > 0.0
    early = {strategy.__name__: strategy for strategy in (declare_at_once, declare_in_the_middle)}
    for name, records in play(ID, early, SEEDS, scene=SCENE).items():
        assert all(record.last["declared"] for record in records), name
        assert mean_return(records) < honest, name


@pytest.mark.slow
def test_no_degenerate_strategy_is_paid_like_a_plain_search(honest):
    """Whole episodes; about two minutes of processor time."""
    for name, records in play(ID, DEGENERATE, SEEDS[:4], scene=SCENE).items():
        assert mean_return(records) < honest, name
        if not any(record.last["declared"] for record in records):
            # Nor more than an episode in which nothing is done, and nothing is hurt.
            assert mean_return(records) <= EPISODE_STEPS * reward_weights(PalpateTask)["time"] + 1e-9, name
