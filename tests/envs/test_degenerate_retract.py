"""SurgSim/Retract-v0: no degenerate strategy is paid as much as a plain script that reads the observation."""

from collections.abc import Iterator

import numpy as np
import pytest

from surgsim_apps.scoring.expert_retract import RetractExpert
from surgsim_env.tasks.declaration import SPEED_FULL_SCALE, reward_weights
from surgsim_env.tasks.retract import EPISODE_STEPS, SUCCESS_SHARE, RetractTask
from tests.envs.strategies import Now, mean_return, play

ID = "SurgSim/Retract-v0"
CONTROL_STEP = 0.05
OPEN, CLOSED = 1.0, -1.0


def move(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0, jaw: float = OPEN) -> np.ndarray:
    return np.array([x, y, z, turn, jaw])


def script(now: Now) -> Iterator[np.ndarray]:
    """The honest agent: `surgsim_apps/scoring/expert_retract.py`, whose action is a function of the observation."""
    while True:
        yield expert(now)


# ---- degenerate strategies --------------------------------------------------------------------------------------


def stand_still(now: Now) -> Iterator[np.ndarray]:
    while True:
        yield move()


def leave(now: Now) -> Iterator[np.ndarray]:
    """Away from the lobe and up."""
    while True:
        yield move(y=1.0, z=1.0)


def ram_the_edge(now: Now) -> Iterator[np.ndarray]:
    """Into the free edge at full speed."""
    while True:
        yield move(y=-1.0, jaw=CLOSED)


def ram_the_bed(now: Now) -> Iterator[np.ndarray]:
    """Over the lobe, and down at full speed."""
    yield from over_the_lobe(now)
    while True:
        yield move(z=-1.0, jaw=CLOSED)


def bite_air(now: Now) -> Iterator[np.ndarray]:
    """Open and close before the edge."""
    while True:
        for jaw in (OPEN, CLOSED):
            for _ in range(10):
                yield move(jaw=jaw)


def wander(now: Now) -> Iterator[np.ndarray]:
    """Uniformly drawn actions."""
    while True:
        yield now.rng.uniform(-1.0, 1.0, 5)


def saturate(now: Now) -> Iterator[np.ndarray]:
    """Press the lobe onto its bed as hard as the hard limit allows."""
    yield from over_the_lobe(now)
    while True:
        short = 0.9 * now.scene.limits.hard_force - np.linalg.norm(now["contact_force"])
        yield move(z=-np.clip(short, -0.3, 0.3), jaw=CLOSED)


def hold(now: Now) -> Iterator[np.ndarray]:
    """Collect `grasped`, and rest."""
    yield from grasp(now)
    while True:
        yield move(jaw=CLOSED)


def farm_grasped(now: Now) -> Iterator[np.ndarray]:
    """Let go and grasp again, as often as the time allows."""
    while True:
        yield from grasp(now)
        for _ in range(10):
            yield move(jaw=OPEN)


def farm_visible(now: Now) -> Iterator[np.ndarray]:
    """Fold the lobe back till much is seen, lay it down till little is seen, and so on."""
    yield from grasp(now)
    start = now["tip_position"]
    while True:
        while now["visible"][0] < 0.9 * SUCCESS_SHARE:
            yield expert(now)
        while now["visible"][0] > 0.3 and np.linalg.norm(start - now["tip_position"]) > 0.001:
            yield go(now, start, CLOSED)


def stop_short(now: Now) -> Iterator[np.ndarray]:
    """Fold the lobe back till almost enough is seen, and rest."""
    while now["visible"][0] < 0.75 * SUCCESS_SHARE:
        yield expert(now)
    while True:
        yield move(jaw=CLOSED)


def flash(now: Now) -> Iterator[np.ndarray]:
    """Show all of the target, but never long enough: success ends what can be collected."""
    shown = 0
    while True:
        shown = shown + 1 if now["visible"][0] >= SUCCESS_SHARE else 0
        yield move(y=1.0, z=-1.0, jaw=CLOSED) if shown > 5 else expert(now)


def tear(now: Now) -> Iterator[np.ndarray]:
    """Grasp, and pull at full speed."""
    yield from grasp(now)
    while True:
        yield move(y=1.0, jaw=CLOSED)


def shake(now: Now) -> Iterator[np.ndarray]:
    """Grasp, and go up and down at full speed."""
    yield from grasp(now)
    while True:
        for z in (1.0, -1.0):
            for _ in range(3):
                yield move(z=z, jaw=CLOSED)


def begin_late(now: Now) -> Iterator[np.ndarray]:
    """The honest script, when the time is almost over."""
    while now.task.step_count < EPISODE_STEPS - 60:
        yield move()
    yield from script(now)


DEGENERATE = {
    strategy.__name__: strategy
    for strategy in (
        stand_still,
        leave,
        ram_the_edge,
        ram_the_bed,
        bite_air,
        wander,
        saturate,
        hold,
        farm_grasped,
        farm_visible,
        stop_short,
        flash,
        tear,
        shake,
        begin_late,
    )
}


def expert(now: Now) -> np.ndarray:
    return RetractExpert().act(now.env.si_values(now.observation))


def go(now: Now, place: np.ndarray, jaw: float) -> np.ndarray:
    """At full speed towards a place [m] (3,), more slowly in its last millimetre."""
    return move(*(place - now["tip_position"]) / (SPEED_FULL_SCALE * CONTROL_STEP), jaw=jaw)


def over_the_lobe(now: Now) -> Iterator[np.ndarray]:
    """Up, and over the middle of the lobe."""
    x = float(now["tip_position"][0])
    for place in ([x, 0.075, 0.04], [x, 0.03, 0.04]):
        while np.linalg.norm(np.array(place) - now["tip_position"]) > 0.002:
            yield go(now, np.array(place), CLOSED)


def grasp(now: Now) -> Iterator[np.ndarray]:
    """As the expert grasps, till tissue is held."""
    while now["holds"][0] < 0.5 or now["grip_force"][0] < 0.2:
        yield expert(now)


# ---- played -----------------------------------------------------------------------------------------------------

# Episodes are cut after so many control steps, three times what the honest script takes: without success the changes of
# `visible` and `grasped` pay at most 5 in all, however long an episode lasts.
STEPS = 250


@pytest.mark.slow
def test_no_degenerate_strategy_is_paid_like_a_plain_script():
    """About three minutes of processor time."""
    seeds = range(2)
    honest = mean_return(play(ID, {"script": script}, seeds)["script"])
    late = {"begin_late": begin_late}
    others = {name: strategy for name, strategy in DEGENERATE.items() if name not in late}
    assert honest > reward_weights(RetractTask)["visible"] + reward_weights(RetractTask)["grasped"]
    paid = play(ID, others, seeds, max_episode_steps=STEPS) | play(ID, late, seeds[:1])
    for name, records in paid.items():
        assert not any(record.last["success"] for record in records), name
        assert mean_return(records) < honest, name
