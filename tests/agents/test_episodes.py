"""Episodes played for scores: agents' random numbers, lanes without a seed, and who sees the truth."""

import contextlib
import copy
import itertools
from collections.abc import Callable
from dataclasses import is_dataclass, replace
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest

from surgsim_apps.scoring.episodes import (
    AgentActor,
    EpisodeFacts,
    agent_generator,
    check_agent,
    episode_facts,
    equal_members,
    make_envs,
    play_sites,
    play_tasks,
    site_success,
)
from surgsim_apps.scoring.figures import EVALUATION_SEEDS, MapScore, press_errors
from surgsim_apps.scoring.site_search import Middle, OracleNear, RandomSites, TruthAgent
from surgsim_apps.scoring.submission import SEED_LEAST, submission_seeds
from surgsim_env.rendering import gl
from surgsim_env.tasks.palpate import EPISODE_STEPS

pytestmark = pytest.mark.agents
SITES = "SurgSim/PalpateSites-v0"
SMALL: dict[str, Any] = {"scene": "phantom_small", "budget": 2}


# ---- random numbers --------------------------------------------------------------------------------------------------


def test_an_agent_cannot_redraw_the_hidden_lesions():
    """Its generator does not give the level's draw, which the environment's own seed does give."""
    env = gym.make(SITES, **SMALL).unwrapped
    for seed in (1_000_000, 1_000_001, 1_000_002):
        env.reset(seed=seed)
        draw, drawn = env.task.level.draw, env.task.drawn  # type: ignore[attr-defined]
        assert draw(env.task.anatomy, np.random.default_rng(seed)) == drawn  # type: ignore[attr-defined]
        rng = agent_generator(seed)
        again = [draw(env.task.anatomy, rng) for _ in range(20)]  # type: ignore[attr-defined]
        assert drawn not in again and all(episode.background != drawn.background for episode in again)


def test_its_stream_is_none_of_the_environments_or_their_children():
    seed, count = 1_000_000, 1000
    own = set(agent_generator(seed).integers(2**63, size=count).tolist())
    sequence = np.random.SeedSequence(seed)
    for other in (
        np.random.default_rng(seed),
        *map(np.random.default_rng, sequence.spawn(4)),
        agent_generator(seed + 1),
    ):
        assert not own & set(other.integers(2**63, size=count).tolist())
    np.testing.assert_array_equal(agent_generator(seed).random(5), agent_generator(seed).random(5))


def test_it_does_not_hold_the_seed():
    sequence: Any = agent_generator(1_000_000).bit_generator.seed_seq
    assert 1_000_000 not in np.atleast_1d(sequence.entropy) and sequence.spawn_key == ()


def test_members_of_a_family_play_in_equal_numbers():
    """Of 3 members 40 episodes: 13 each and one more; every seed that is passed over is of a full member."""
    seeds = equal_members(itertools.count(1_000_000), 40, 3)
    members = {seed: int(np.random.default_rng(seed).integers(3)) for seed in range(1_000_000, seeds[-1] + 1)}
    counts = [0, 0, 0]
    for seed, member in members.items():
        if seed in seeds:
            counts[member] += 1
        else:
            assert counts[member] == 14 or (counts[member] == 13 and 14 in counts), seed
    assert sorted(counts) == [13, 13, 14] and len(seeds) == 40 < len(members)
    assert equal_members(itertools.count(5), 4, 1) == (5, 6, 7, 8)


# ---- lanes -----------------------------------------------------------------------------------------------------------


class Counting(RandomSites):
    """Counts the actions of all its kind."""

    acted: ClassVar[list[int]] = []

    def act(self, observation: np.ndarray) -> np.ndarray:
        self.acted.append(1)
        return super().act(observation)


def test_lanes_without_a_seed_are_not_stepped(monkeypatch: pytest.MonkeyPatch):
    """Three seeds on two lanes, as on one: equal records, each press chosen and simulated once."""
    Counting.acted.clear()
    seeds, envs = [5, 6, 7], make_envs(SITES, 2, dtype="float64", **SMALL)
    stepped = []
    singles = envs.unwrapped.envs  # type: ignore[attr-defined]
    for number, single in enumerate(singles):
        inner = single.unwrapped.begin
        monkeypatch.setattr(
            single.unwrapped, "begin", lambda action, n=number, inner=inner: stepped.append(n) or inner(action)
        )
    records = play_sites(AgentActor(Counting), envs, seeds)
    assert len(Counting.acted) == 3 * 2 and sorted(stepped) == [0, 0, 0, 0, 1, 1]
    alone = play_sites(AgentActor(RandomSites), make_envs(SITES, 1, dtype="float64", **SMALL), seeds)
    for record, expected in zip(records, alone, strict=True):
        np.testing.assert_array_equal(record.truth, expected.truth)
        np.testing.assert_array_equal(record.force, expected.force)
        np.testing.assert_array_equal(press_errors(record, 2), press_errors(expected, 2))


def test_more_lanes_than_seeds():
    (record,) = play_sites(AgentActor(RandomSites), make_envs(SITES, 3, **SMALL), [5])
    assert len(record.force) == 2


# ---- cheating --------------------------------------------------------------------------------------------------------


def overwrite(value: Any) -> int:
    """Write into all arrays and dictionaries that a value reaches, by force; the number of arrays."""
    if isinstance(value, np.ndarray):
        for array in (value, value.base):
            if isinstance(array, np.ndarray):
                with contextlib.suppress(ValueError):
                    array.setflags(write=True)
                    array[...] = 0
        return 1
    count = 0
    if isinstance(value, dict):
        count = sum(map(overwrite, list(value.values())))
        value.clear()
    elif isinstance(value, (tuple, list)):
        count = sum(map(overwrite, value))
    elif is_dataclass(value):
        names = [name for name in dir(value) if not name.startswith("_")]
        parts = [part for name in names if not callable(part := getattr(value, name))]
        count = sum(map(overwrite, parts))
        for name in vars(value):
            object.__setattr__(value, name, None)
    return count


class Vandal(RandomSites):
    """Writes into everything that it is given."""

    def reset(self, rng: np.random.Generator, facts: Any) -> None:
        super().reset(rng, copy.deepcopy(facts))
        with np.errstate(all="ignore"):  # lengths of 0
            assert overwrite(facts) >= 8

    def act(self, observation: np.ndarray) -> np.ndarray:
        action = super().act(observation)
        assert overwrite(observation) == 1
        return action


def test_an_agent_that_writes_into_what_it_is_given_changes_no_episode():
    """Nor one of another environment of the process, whose chart is the same."""
    seeds = [5, 6, 7]
    records = play_sites(AgentActor(Vandal), make_envs(SITES, 1, dtype="float64", **SMALL), seeds)
    after = play_sites(AgentActor(RandomSites), make_envs(SITES, 1, dtype="float64", **SMALL), seeds)
    for record, expected in zip(records, after, strict=True):
        np.testing.assert_array_equal(record.force, expected.force)
        np.testing.assert_array_equal(record.estimates[-1], expected.estimates[-1])
    env: Any = gym.make(SITES, **SMALL).unwrapped
    observation, _ = env.reset(seed=5)
    assert observation[env.observation_slices["face_map"]].sum() > 100 and env.task.felt.healthy.grid.all()


@pytest.mark.parametrize(("env_id", "kwargs"), [(SITES, SMALL), ("SurgSim/Palpate-v0", {"scene": "phantom_small"})])
def test_facts_infos_and_observations_are_copies(env_id: str, kwargs: dict[str, Any]):
    kwargs, made = kwargs | {"nested": {"list": [1]}}, dict(kwargs)
    given = copy.deepcopy(kwargs)
    spoiled, other = (gym.make(env_id, **made) for _ in range(2))
    facts = episode_facts(spoiled, env_id, kwargs)
    overwrite(facts.env_kwargs["nested"])
    overwrite(facts)
    assert kwargs == given
    for seen in zip(spoiled.reset(seed=5), other.reset(seed=5), strict=True):
        overwrite(seen[0])
    action = np.zeros(spoiled.action_space.shape or (), dtype=np.float32)
    for _ in range(2):
        parts, expected = spoiled.step(action), other.step(action)
        np.testing.assert_array_equal(parts[0], expected[0])
        assert parts[1:] == expected[1:] and parts[4]
        overwrite(parts[0]), overwrite(parts[4])
    assert spoiled.unwrapped.observation_slices == other.unwrapped.observation_slices  # type: ignore[attr-defined]


def test_a_table_of_public_seeds_does_not_know_those_of_a_submission():
    """An agent that recognises its episode by the first observation finds all public ones and no other."""
    env = gym.make("SurgSim/Palpate-v0", scene="phantom_small")

    def first(seed: int) -> bytes:
        return env.reset(seed=seed)[0].tobytes()

    def submitted(digest: str) -> list[int]:
        return list(itertools.islice(submission_seeds(digest, "SurgSim/Palpate-v0", "phantom_small", ""), 100))

    table = {first(seed) for seed in EVALUATION_SEEDS[:3]}
    assert all(first(seed) in table for seed in EVALUATION_SEEDS[:3])
    seeds, others = submitted("a"), submitted("b")
    assert not any(first(seed) in table for seed in seeds[:3])
    assert seeds == submitted("a") and len({*seeds, *others, *EVALUATION_SEEDS}) == 300
    assert all(SEED_LEAST <= seed < 2 * SEED_LEAST for seed in seeds)
    for place in (("SurgSim/Palpate-v0", "phantom", ""), ("SurgSim/Palpate-v0", "phantom_small", "hard")):
        assert next(submission_seeds("a", *place)) not in seeds


# ---- the truth -------------------------------------------------------------------------------------------------------


class Peeking(RandomSites):
    """Takes the task without declaring it."""

    def see(self, task: object) -> None:
        raise AssertionError("it was given the task")


def test_the_truth_is_for_those_that_declare_it():
    env = gym.make(SITES, **SMALL)
    env.reset(seed=5)
    with pytest.raises(ValueError, match=r"Peeking has a method see, .* does not declare sees_truth = True"):
        check_agent(Peeking(), "Peeking")
    begun(Peeking, env)
    assert len(begun(OracleNear, env).first_places) == 1 + 4 * len(env.unwrapped.task.truth)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(begun(TruthAgent, env).truth, env.unwrapped.task.truth)  # type: ignore[attr-defined]


def begun(make: Callable[[], Any], env: gym.Env) -> Any:
    """An agent that has begun an episode."""
    actor = AgentActor(make)
    actor.begin(0, env, agent_generator(5))
    return actor.agents[0]


@pytest.mark.parametrize(
    ("entries", "missing"),
    [
        ({"act": print}, "reset"),
        ({"reset": print}, "act"),
        ({"reset": print, "act": print, "sees_truth": True}, "see"),
        ({"reset": print, "act": print, "estimate": print}, "estimate_map"),
    ],
)
def test_an_agent_without_a_method_is_refused_before_its_episode(entries: dict[str, Any], missing: str):
    with pytest.raises(ValueError, match=f"Partial has no method {missing}:"):
        check_agent(type("Partial", (), entries)(), "Partial")


class Prying(Middle):
    """Makes its map of what it finds in the estimator's."""

    seen: ClassVar[list[MapScore]] = []

    def estimate_map(self, made: MapScore) -> MapScore:
        self.seen.append(made)
        return made


def test_an_estimate_of_ones_own_is_made_without_the_truth():
    envs = make_envs(SITES, 1, **SMALL)
    (record,) = play_sites(AgentActor(Prying), envs, [1_000_000])
    (shown,) = Prying.seen
    assert record.map is not None and record.map.lesion.any() and record.map.outline_true.any()
    assert not shown.lesion.any() and not shown.outline_true.any()
    charted = envs.unwrapped.envs[0].unwrapped.task.charted  # type: ignore[attr-defined]
    np.testing.assert_array_equal(record.estimates[-1], charted.surface(np.zeros((1, 2))))


def test_an_attribute_named_estimate_is_no_estimate():
    class Keeps(RandomSites):
        def reset(self, rng: np.random.Generator, facts: Any) -> None:
            super().reset(rng, facts)
            self.estimate = np.zeros(2)

    (record,) = play_sites(AgentActor(Keeps), make_envs(SITES, 1, **SMALL), [5])
    assert len(record.force) == 2


def test_an_episode_that_ends_in_harm_is_no_success():
    (record,) = play_sites(AgentActor(TruthAgent), (envs := make_envs(SITES, 1, **SMALL)), [5])
    task = envs.unwrapped.envs[0].unwrapped.task  # type: ignore[attr-defined]
    assert site_success(record, task)
    for harm in ({"hard_limit": True}, {"fault": "inverted"}):
        assert not site_success(replace(record, **harm), task)


# ---- other environments ----------------------------------------------------------------------------------------------


class Still:
    """Does nothing, and keeps its random numbers and facts."""

    received: ClassVar[list[tuple[np.random.Generator, EpisodeFacts]]] = []

    def reset(self, rng: np.random.Generator, facts: EpisodeFacts) -> None:
        self.received.append((rng, facts))

    def act(self, observation: np.ndarray) -> np.ndarray:
        return np.zeros(self.received[-1][1].action_size, dtype=np.float32)


class Looking:
    """Moves where its random numbers say, and keeps what it was shown."""

    shown: ClassVar[list[list[dict[str, np.ndarray]]]] = []

    def reset(self, rng: np.random.Generator, facts: EpisodeFacts) -> None:
        self.rng, self.size, self.seen = rng, facts.action_size, []
        self.shown.append(self.seen)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        self.seen.append({name: part.copy() for name, part in observation.items()})
        return self.rng.uniform(-1.0, 1.0, self.size).astype(np.float32)


def test_each_agent_is_shown_its_own_part_of_dictionaries():
    """Three episodes on two lanes, the second of which ends without a seed: each as it is alone, picture and force."""
    try:
        gl.context()
    except gl.NoGLError as error:
        pytest.skip(f"no pictures on this machine: {error}")
    env_id, kwargs = "SurgSim/Retract-v0", {"obs_mode": "rgb_force", "max_episode_steps": 2}
    Looking.shown.clear()
    actor = AgentActor(Looking, lambda env: episode_facts(env, env_id, kwargs))
    play_tasks(actor, make_envs(env_id, 2, dtype="float64", **kwargs), [8, 9, 10])
    assert [len(shown) for shown in Looking.shown] == [2, 2, 2]
    single = gym.make(env_id, **kwargs)
    for seed, shown in zip((8, 9, 10), Looking.shown, strict=True):
        rng = agent_generator(seed)
        seen = [single.reset(seed=seed)[0]]
        seen.append(single.step(rng.uniform(-1.0, 1.0, single.action_space.shape).astype(np.float32))[0])
        for observation, expected in zip(shown, seen, strict=True):
            assert set(observation) == {"picture", "force"}
            for name, part in observation.items():
                np.testing.assert_array_equal(part, expected[name])


def test_an_agent_plays_an_environment_of_control_steps():
    env_id, kwargs = "SurgSim/Palpate-v0", {"scene": "phantom_small"}
    envs = make_envs(env_id, 1, max_episode_steps=3, **kwargs)
    records = play_tasks(AgentActor(Still, lambda env: episode_facts(env, env_id, kwargs)), envs, [8, 9])
    assert [record.steps for record in records] == [3, 3]
    (first, facts), (second, _) = Still.received
    assert facts.env_kwargs == kwargs and facts.step_count == EPISODE_STEPS
    assert facts.observation_slices["contact_force"].stop <= envs.single_observation_space.shape[0]  # type: ignore[index]
    assert 0.0 < facts.soft_force < facts.hard_force and facts.control_step == 0.05
    assert first.random() == agent_generator(8).random() and second.random() == agent_generator(9).random()
