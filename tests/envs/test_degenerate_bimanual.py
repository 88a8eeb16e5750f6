"""SurgSim/BimanualRetract-v0: no degenerate strategy is paid as much as a plain script that reads the observation."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import ArrayLike

from surgsim_env.tasks.bimanual_retract import TOUCH_FORCE, BimanualRetractTask
from surgsim_env.tasks.declaration import SPEED_FULL_SCALE
from surgsim_env.tasks.retract import TURNING_FULL_SCALE
from tests.envs.strategies import Now, mean_return, play

ID = "SurgSim/BimanualRetract-v0"
CONTROL_STEP = 0.05
OPEN, CLOSED = 1.0, -1.0
STILL = np.zeros(3)
# Of the honest script. Offset of the left jaw from the target along x, away from the right arm; depth of its middle
# over the edge, distance before it at which it waits, from the lobe's top to the middle of its thickness [m].
BESIDE, GRASP_DEPTH, WAITING_GAP, HALF_THICKNESS = -0.008, 0.0065, 0.016, 0.006
# Ways of the left tip with the edge: up and over, y and z as shares of the lobe's depth, and rotations on them [rad].
WAYS = ((0.88, 0.50, math.radians(35.0)), (0.60, 0.72, math.radians(26.0)))
# Waypoints of the right tip from the target, z from the bed [m]: before the lobe, at its mouth, over the target.
BEFORE, MOUTH, OVER = (0.010, 0.052, 0.022), (0.002, 0.012, 0.010), (0.0, 0.0, 0.0095)
MIDDLE_OF_TOUCH = 0.6  # [N]


def script(now: Now) -> Iterator[np.ndarray]:
    """The honest agent: the left arm folds the lobe back, the right one reaches under it and presses.

    It reads the observation alone: places of the target, of the free edge and of both tips, the grip and the touch.
    """
    yield from grasp(now)
    yield from fold(now)
    yield from reach(now)
    yield from press(now)


# ---- parts of the script ----------------------------------------------------------------------------------------


def act(left: np.ndarray = STILL, right: np.ndarray = STILL, *, jaw: float = OPEN, turn: float = 0.0) -> np.ndarray:
    """Velocities over their full scale (3,) each, the jaw's target, and the left tip's turn about x."""
    return np.concatenate([left, [turn, 0.0, 0.0], [jaw], right, STILL])


def way(now: Now, channel: str, place: ArrayLike, speed: float = 0.015) -> np.ndarray:
    """Velocity of a tip towards a place [m] (3,), more slowly on its last millimetre."""
    gap = np.asarray(place) - now[channel]
    distance = float(np.linalg.norm(gap))
    return gap / max(distance, 1e-9) * min(speed, 0.6 * distance / CONTROL_STEP) / SPEED_FULL_SCALE


def far(now: Now, channel: str, place: ArrayLike, tolerance: float = 0.001) -> bool:
    return bool(np.linalg.norm(np.asarray(place) - now[channel]) > tolerance)


def edge(now: Now) -> tuple[float, float, float]:
    """The left jaw's place on the free edge [m]: x beside the target, the edge's y there, the middle's z."""
    points, x = now["edge_points"].reshape(-1, 3), float(now["target_place"][0]) + BESIDE
    y, top = (float(np.interp(x, points[:, 0], points[:, axis])) for axis in (1, 2))
    return x, y, top - HALF_THICKNESS


def grasp(now: Now) -> Iterator[np.ndarray]:
    x, y, z = edge(now)
    for place in ([x, y + WAITING_GAP, z], [x, max(y - GRASP_DEPTH, 0.0475), z]):
        while far(now, "tip_position", place):
            yield act(way(now, "tip_position", place))
    while now["grip_force"][0] < 0.25:
        yield act(jaw=CLOSED)


def fold(now: Now) -> Iterator[np.ndarray]:
    x, y, z = edge(now)
    depth = y
    for over, up, angle in WAYS:
        place, begin = np.array([x, over * depth, z + up * depth]), now["tip_position"]
        length = float(np.linalg.norm(place - begin))
        while far(now, "tip_position", place, 0.002):
            rate = angle * 0.015 / length
            yield act(way(now, "tip_position", place), jaw=CLOSED, turn=rate / TURNING_FULL_SCALE)


def reach(now: Now, jaw: float = CLOSED) -> Iterator[np.ndarray]:
    x, y = now["target_place"]
    for offset in (BEFORE, MOUTH, OVER):
        place = np.array([x, y, 0.0]) + offset
        while far(now, "right_position", place):
            yield act(right=way(now, "right_position", place), jaw=jaw)


def press(now: Now, force: float = MIDDLE_OF_TOUCH, jaw: float = CLOSED) -> Iterator[np.ndarray]:
    """The right tip down on the bed, after the touch [N]."""
    while True:
        missing = force - float(now["touch_force"][0])
        yield act(right=np.array([0.0, 0.0, -np.clip(0.01 * missing, -0.005, 0.005) / SPEED_FULL_SCALE]), jaw=jaw)


# ---- degenerate strategies --------------------------------------------------------------------------------------


def stand_still(now: Now) -> Iterator[np.ndarray]:
    while True:
        yield act()


def leave(now: Now) -> Iterator[np.ndarray]:
    """Both arms away from the lobe and up."""
    while True:
        yield act(np.array([0.0, 1.0, 1.0]), np.array([0.0, 1.0, 1.0]))


def ram(now: Now) -> Iterator[np.ndarray]:
    """The left arm into the free edge at full speed."""
    while True:
        yield act(np.array([0.0, -1.0, 0.0]), jaw=CLOSED)


def crush_the_bed(now: Now) -> Iterator[np.ndarray]:
    """The right arm through whatever lies under it, at full speed."""
    while True:
        yield act(right=np.array([0.0, -1.0, -1.0]))


def collide(now: Now) -> Iterator[np.ndarray]:
    """The arms into each other, which ends the episode."""
    while True:
        gap = now["tip_position"] - now["right_position"]
        aim = gap / max(float(np.linalg.norm(gap)), 1e-9)
        yield act(-aim, aim)


def wander(now: Now) -> Iterator[np.ndarray]:
    """Uniformly drawn actions."""
    while True:
        yield now.rng.uniform(-1.0, 1.0, 13)


def saturate(now: Now) -> Iterator[np.ndarray]:
    """The right tip on the lobe over the target, as hard as the hard limit allows."""
    yield from over_the_target(now)
    while True:
        short = 0.9 * now.scene.limits.hard_force - float(np.linalg.norm(now["right_force"]))
        yield act(right=np.array([0.0, 0.0, -np.clip(short, -0.3, 0.3)]))


def touch_through_the_lobe(now: Now) -> Iterator[np.ndarray]:
    """The right tip on the lobe over the target, which stays covered, with the force that counts as a touch."""
    yield from over_the_target(now)
    while True:
        short = MIDDLE_OF_TOUCH - float(np.linalg.norm(now["right_force"]))
        yield act(right=np.array([0.0, 0.0, -np.clip(short, -0.3, 0.3)]))


def hold(now: Now) -> Iterator[np.ndarray]:
    """Collect `grasped`, and rest."""
    yield from grasp(now)
    while True:
        yield act(jaw=CLOSED)


def farm_grasped(now: Now) -> Iterator[np.ndarray]:
    """Let go and grasp again."""
    while True:
        yield from grasp(now)
        for _ in range(10):
            yield act()


def farm_visible(now: Now) -> Iterator[np.ndarray]:
    """Fold the lobe back, lay it down, and so on."""
    yield from grasp(now)
    start = now["tip_position"]
    while True:
        yield from fold(now)
        while far(now, "tip_position", start, 0.002):
            yield act(way(now, "tip_position", start, SPEED_FULL_SCALE), jaw=CLOSED)


def farm_near(now: Now) -> Iterator[np.ndarray]:
    """The right tip over the lobe: to the target and away, and so on."""
    x, y = now["target_place"]
    while True:
        for place in ([x, y, 0.035], [x, y + 0.08, 0.035]):
            while far(now, "right_position", place, 0.002):
                yield act(right=way(now, "right_position", place, SPEED_FULL_SCALE))


def farm_touched(now: Now) -> Iterator[np.ndarray]:
    """Expose the target, touch it, let go before that has lasted, and so on."""
    yield from grasp(now)
    yield from fold(now)
    yield from reach(now)
    for action in press(now):
        if now["touch_force"][0] >= TOUCH_FORCE[0]:
            for _ in range(10):
                yield act(right=np.array([0.0, 0.0, 0.25]), jaw=CLOSED)
        else:
            yield action


def touch_too_gently(now: Now) -> Iterator[np.ndarray]:
    """All but the last step: expose the target, and stay just below the force that counts as a touch."""
    yield from grasp(now)
    yield from fold(now)
    yield from reach(now)
    yield from press(now, 0.6 * TOUCH_FORCE[0])


def tear(now: Now) -> Iterator[np.ndarray]:
    """Grasp, and pull at full speed."""
    yield from grasp(now)
    while True:
        yield act(np.array([0.0, 1.0, 0.0]), jaw=CLOSED)


DEGENERATE = {
    strategy.__name__: strategy
    for strategy in (
        stand_still,
        leave,
        ram,
        crush_the_bed,
        collide,
        wander,
        saturate,
        touch_through_the_lobe,
        hold,
        farm_grasped,
        farm_visible,
        farm_near,
        farm_touched,
        touch_too_gently,
        tear,
    )
}


def over_the_target(now: Now) -> Iterator[np.ndarray]:
    """The right tip above the lobe, over the target."""
    x, y = now["target_place"]
    while far(now, "right_position", [x, y, 0.03], 0.002):
        yield act(right=way(now, "right_position", [x, y, 0.03], SPEED_FULL_SCALE))


# ---- played -----------------------------------------------------------------------------------------------------

# Episodes are cut after so many control steps, somewhat more than the honest script takes: without success the four
# changes pay at most 7 in all, however long an episode lasts.
STEPS = 260


@pytest.mark.slow
def test_no_degenerate_strategy_is_paid_like_a_plain_script():
    """About five minutes of processor time."""
    seeds = range(2)
    honest = mean_return(play(ID, {"script": script}, seeds)["script"])
    assert honest > sum(reward.weight for reward in BimanualRetractTask.rewards if reward.per == "change")
    for name, records in play(ID, DEGENERATE, seeds, max_episode_steps=STEPS).items():
        assert not any(record.last["success"] for record in records), name
        assert mean_return(records) < honest, name
