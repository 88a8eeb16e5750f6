"""Every environment id under the same contract: checkers, bit-exact replay, save and restore, seeds that matter.

One of them is the task of docs/tutorials/own_task.md, a file outside the package.
"""

import copy
import io
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.palpation.chart import MAP_SIDE
from surgsim_env.scene.load import scenes_folder
from tests.envs.own_task import load_own_task
from tests.envs.walks import rollout

OWN = load_own_task()
IDS = [*sorted(env_id for env_id in gym.registry if env_id.startswith("SurgSim/")), OWN]
# A small organ where the id has one. A press a step, which takes as long as some ten steps of the other ids: enough of
# them for walks that are shorter.
SETTINGS = {
    "SurgSim/Palpate-v0": {"scene": "phantom_small"},
    "SurgSim/PalpateSites-v0": {"scene": "phantom_small", "budget": 20},
    "SurgSim/Slide-v0": {"scene": "phantom_small"},
}
SHORTER = {"SurgSim/PalpateSites-v0": 5, "SurgSim/Retract-v0": 2, "SurgSim/BimanualRetract-v0": 2}
# Every id with its scene's own instrument, and some with an arm.
CASES = [(env_id, SETTINGS.get(env_id, {})) for env_id in IDS] + [
    ("SurgSim/Palpate-v0", {"scene": "phantom", "instrument": "psm_palpator"}),
    pytest.param(("SurgSim/Retract-v0", {"instrument": "psm_retractor"}), marks=pytest.mark.slow),
    ("SurgSim/Palpate-v0", {"scene": "kidney_family"}),
    ("SurgSim/Palpate-v0", {"scene": "phantom_small", "instrument": "tactile_probe"}),
    ("SurgSim/PalpateSites-v0", {"scene": "phantom_small", "instrument": "tactile_probe", "budget": 20}),
    # All that an episode may remember, draw and follow.
    (
        "SurgSim/Palpate-v0",
        {"scene": "phantom_small", "memory": True, "frame": "face", "level": "standard", "motion": "calm"},
    ),
    *(
        pytest.param((env_id, {"scene": scene}), marks=pytest.mark.slow)
        for env_id, scene in (
            ("SurgSim/Palpate-v0", "liver_family"),
            ("SurgSim/Palpate-v0", "spleen_family"),
            *(("SurgSim/PalpateSites-v0", f"{organ}_family") for organ in ("liver", "kidney", "spleen")),
        )
    ),
]
# The cells of a scene, and fewer.
CELLS = {
    "phantom": ("[12, 12, 6]", "[6, 6, 3]"),
    "phantom_small": ("[8, 8, 4]", "[6, 6, 3]"),
    "lobe": ("[20, 13, 3]", "[20, 13, 2]"),
    "liver_family": ("coarse_cell_size = 0.0156", "coarse_cell_size = 0.0312"),
    "kidney_family": ("coarse_cell_size = 0.0082", "coarse_cell_size = 0.0164"),
    "spleen_family": ("coarse_cell_size = 0.0082", "coarse_cell_size = 0.0164"),
}
# Entries of an observation that a walk of some steps leaves as they are: the axis of a wrist that is a hinge, what is
# grasped and what is seen.
# (Of the sites of a chart's grid a walk presses some, and the phantom is flat.)
HINGE = {f"tip_axes[{entry}]" for entry in range(4)}
UNSEEN = {"grip_force[0]", "holds[0]", "visible[0]"}
STILL = {
    "SurgSim/Palpate-v0": {
        *(f"{name}[{site}]" for name in ("contrast", "visited", "face") for site in range(MAP_SIDE**2)),
        *(f"{name}[{axis}]" for name in ("surface_normal", "map_cell", "chart_share") for axis in range(3)),
    },
    "SurgSim/PalpateSites-v0": {
        *(f"{name}[{site}]" for name in ("contrast_map", "pressed_map", "face_map") for site in range(MAP_SIDE**2)),
        *(
            "map_cell[0]",
            "chart_share[0]",
            "chart_share[1]",
            "contrast_noise[0]",
            "excess_least[0]",
            "lesion_radius[0]",
            "gradient_noise[0]",
        ),
        *(f"gradient_map[{entry}]" for entry in range(2 * MAP_SIDE**2)),
    },
    "SurgSim/Slide-v0": {
        *(f"surface_normal[{axis}]" for axis in range(3)),
        *("chart_share[0]", "chart_share[1]", "map_cell[0]", "thickness[0]"),
    },
    "SurgSim/Retract-v0": HINGE | UNSEEN,
    "SurgSim/BimanualRetract-v0": UNSEEN | {"touch_force[0]", "uncovered[0]"},
}


@pytest.fixture(params=CASES, ids=lambda case: "-".join(map(str, [case[0], *case[1].values()])))
def made(request):
    """A function that makes the environment, alone or, given `num_envs`, many of them."""
    env_id, settings = request.param

    def make(**more):
        return (gym.make_vec if "num_envs" in more else gym.make)(env_id, **{**settings, **more})

    return make


def assert_same(first, second):
    assert len(first) == len(second)
    for record, other in zip(first, second, strict=True):
        assert record[0].tobytes() == other[0].tobytes()
        assert record[1:] == other[1:]


def test_there_are_ids():
    assert "SurgSim/Palpate-v0" in IDS


def test_passes_gymnasiums_checker_without_a_warning(made):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(made().unwrapped)


@pytest.mark.agents
def test_passes_stable_baselines3s_checker_without_a_warning(made):
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the `agents` extra")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(made().unwrapped)


def test_same_seed_repeats_to_the_bit_also_after_other_episodes(made):
    env = made()
    steps = 6 if "Sites" in env.spec.id else 30  # until a walk touches the organ
    first = rollout(env, seed=3, steps=steps)
    rollout(env, seed=11, steps=5, action_seed=8)
    assert_same(first, rollout(env, seed=3, steps=steps))
    assert_same(first, rollout(made(), seed=3, steps=steps))
    assert any(record[-1]["force_peak"] > 0.0 for record in first), "the walk must touch the organ to prove anything"


def test_seeds_that_differ_differ(made):
    env = made()
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    # Where nothing is seen before it is touched, the first step tells.
    starts = [(env.reset(seed=seed)[0].tobytes(), env.step(still)[0].tobytes()) for seed in range(5)]
    assert len(set(starts)) == 5


def test_saved_state_resumes_to_the_bit_in_the_same_and_in_another_environment(made):
    env = made().unwrapped
    shorter = SHORTER.get(env.spec.id, 1)
    rollout(env, seed=5, steps=25 // shorter)
    saved = env.save_state()
    actions = np.random.default_rng(1).uniform(-0.4, 0.4, (10 // shorter, *env.action_space.shape)).astype(np.float32)

    def go_on(environment):
        return [environment.step(action) for action in actions]

    expected = go_on(env)
    next_start = env.reset()
    other = made().unwrapped
    other.reset(seed=99)
    for environment in (env, other):
        environment.load_state(saved)
        assert environment.save_state() == saved
        assert_same(expected, go_on(environment))
        # The random generator went on as well: the next episode is the same too.
        assert_same([next_start], [environment.reset()])


def test_pickled_environments_go_on_to_the_bit_as_copies_do(made):
    env, fresh = made(), pickle.loads(pickle.dumps(made()))
    steps = 10 // SHORTER.get(env.spec.id, 1)
    walked = rollout(env, seed=5, steps=steps)
    assert_same(walked, rollout(fresh, seed=5, steps=steps))
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    action = np.full(env.action_space.shape, -0.2, dtype=np.float32)
    expected = [env.step(action), env.step(action), env.reset()]
    for twin in twins:
        assert_same(expected, [twin.step(action), twin.step(action), twin.reset()])
        assert twin.unwrapped.save_state() == env.unwrapped.save_state()


def test_foreign_or_broken_states_are_refused(made, tmp_path):
    env = made().unwrapped
    with pytest.raises(gym.error.ResetNeeded):
        env.save_state()
    env.reset(seed=0)
    saved = env.save_state()
    name = env.scene.name
    cells, fewer = CELLS[name]
    # A family's template is another file.
    texts = {path.name: path.read_text("utf-8") for path in (scenes_folder() / "organs").glob("*.toml")}
    assert any(cells in text for text in texts.values())
    for file, text in texts.items():
        text = text.replace("../meshes", str(scenes_folder() / "meshes"))
        (tmp_path / file).write_text(text.replace(cells, fewer), "utf-8")
    other = made(scene=str(tmp_path / f"{name}.toml")).unwrapped
    counts = [environment.simulation.anatomy.mesh.node_count for environment in (env, other)]
    with pytest.raises(
        ValueError, match=rf"saved by .*{counts[0]} nodes.*, this is .*{counts[1]} nodes.* use the same scene"
    ):
        other.load_state(saved)
    for broken in (b"", b"garbage", saved[: len(saved) // 2], saved[:-40]):
        with pytest.raises(ValueError, match="not a saved state"):
            env.load_state(broken)
    with np.load(io.BytesIO(saved)) as archive:
        arrays = {name: archive[name] for name in archive.files}
    for change in ({"organ_node_position": np.zeros((10, 3))}, {"random": None}):
        kept = {name: array for name, array in {**arrays, **change}.items() if array is not None}
        buffer = io.BytesIO()
        np.savez(buffer, **kept)
        with pytest.raises(ValueError, match=f"{next(iter(change))}' (has shape|is missing)"):
            env.load_state(buffer.getvalue())
    assert env.save_state() == saved, "nothing was changed by what was refused"


def test_info_has_fixed_keys_and_types(made):
    records = rollout(made(), seed=2, steps=5)
    shapes = [{key: type(value) for key, value in record[-1].items()} for record in records]
    assert all(shape == shapes[0] for shape in shapes)
    assert shapes[0]["sim_fault"] is str
    assert set(shapes[0].values()) <= {str, bool, float}


def test_observation_has_no_constant_entry(made):
    env = made()
    # Two episodes: what is drawn stays as it is within one.
    steps = 40 // SHORTER.get(env.spec.id, 1)
    observations = np.array([record[0] for seed in (4, 5) for record in rollout(env, seed=seed, steps=steps)])
    constant = np.flatnonzero(np.ptp(observations, axis=0) == 0.0)
    assert {env.unwrapped.layout.entry_name(int(entry)) for entry in constant} <= STILL.get(env.spec.id, set())


def test_channels_make_up_the_observation_in_their_order(made):
    env = made().unwrapped
    task, slices = env.task, env.observation_slices
    ends = [0, *(part.stop for part in slices.values())]
    assert [part.start for part in slices.values()] == ends[:-1] and ends[-1] == env.observation_space.shape[0]
    declared = [channel.name for channel in task.channels]
    assert [name for name in declared if name in slices] == list(slices)
    assert list(env.layout.action_slices.values())[-1].stop == env.action_space.shape[0]
    # What was read is what is observed: the tip, where the task observes it.
    observation, info = env.reset(seed=1)
    if "tip_position" in slices:
        tip = env.simulation.instrument.tip_position.astype(np.float32)
        np.testing.assert_array_equal(env.task_observation[slices["tip_position"]], tip)
        np.testing.assert_allclose(env.si_values(observation)[slices["tip_position"]], tip, atol=1e-7)
    assert [key for key in info if key.startswith("reward_")] == [f"reward_{reward.name}" for reward in task.rewards]


def test_scaled_observations_are_of_order_one_and_hold_what_si_units_do(made):
    scaled, plain = made(), made(scaled=False)
    steps = 12 // SHORTER.get(scaled.spec.id, 1)
    first, second = rollout(scaled, seed=3, steps=steps), rollout(plain, seed=3, steps=steps)
    inner = scaled.unwrapped
    for record, other in zip(first, second, strict=True):
        # To the rounding of single precision, of the value or of what it was less.
        back, rounding = inner.si_values(record[0]), 3e-7 * (np.abs(inner._origin) + inner._scale)
        assert (np.abs(back - other[0]) <= rounding + 3e-7 * np.abs(other[0])).all()
        assert record[1:] == other[1:]
        assert np.abs(record[0]).max() < 40.0
    assert inner.save_state() == plain.unwrapped.save_state()


def test_documentation_names_every_command_channel_and_reward(made):
    env = made().unwrapped
    for part in (*env.task.commands, *env.task.channels, *env.task.rewards):
        assert f"| `{part.name}` |" in env.__doc__ and part.meaning in env.__doc__


def test_without_force_the_felt_channels_are_zero_and_all_else_is_the_same(made):
    """Observed only: the episode, its rewards and its saved state stay."""
    seeing, blind = made(), made(observe_force=False)
    felt = seeing.unwrapped.layout.force_entries
    assert felt
    steps = 12 // SHORTER.get(seeing.spec.id, 1)
    first, second = rollout(seeing, seed=3, steps=steps), rollout(blind, seed=3, steps=steps)
    assert any(np.any(record[0][felt]) for record in first)
    for record, other in zip(first, second, strict=True):
        expected = record[0].copy()
        expected[felt] = 0.0
        np.testing.assert_array_equal(other[0], expected)
        assert record[1:] == other[1:]
    assert seeing.unwrapped.save_state() == blind.unwrapped.save_state()


def test_lanes_give_what_single_environments_give(made):
    if gym.spec(made().spec.id).vector_entry_point is None:
        with pytest.raises(gym.error.Error, match="vector"):
            made(num_envs=2, vectorization_mode="vector_entry_point")
        return
    lanes, singles = (made(num_envs=2, vectorization_mode=mode) for mode in ("vector_entry_point", "sync"))
    assert lanes.unwrapped.observation_slices == made().unwrapped.observation_slices
    actions = np.random.default_rng(2).uniform(-0.3, 0.3, (4, *lanes.action_space.shape)).astype(np.float32)
    for envs in (lanes, singles):
        envs.reset(seed=[5, 6])
    for action in actions:
        for part, other in zip(lanes.step(action)[:4], singles.step(action)[:4], strict=True):
            np.testing.assert_array_equal(part, other)
    lanes.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_works_in_make_vec(made, mode):
    envs = made(num_envs=2, vectorization_mode=mode)
    observations, _ = envs.reset(seed=[3, 4])
    assert observations.shape == (2, *envs.single_observation_space.shape)
    alone = made().reset(seed=4)[0]
    np.testing.assert_array_equal(observations[1], alone)
    for _ in range(3):
        envs.step(envs.action_space.sample())
    envs.close()


@pytest.mark.parametrize("env_id", IDS)
def test_bad_actions_are_refused(env_id):
    env = gym.make(env_id, **SETTINGS.get(env_id, {})).unwrapped
    env.reset(seed=0)
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    with pytest.raises(ValueError, match="shape"):
        env.step(still[1:])
    for place, value in ((1, np.nan), (min(2, len(still) - 1), 1.5), (len(still) - 1, -1.25)):
        action = still.copy()
        action[place] = value
        with pytest.raises(ValueError, match=rf"action\[{place}\] is {value:g}"):
            env.step(action)


@pytest.mark.parametrize("env_id", IDS)
def test_bad_arguments_are_refused(env_id):
    with pytest.raises(ValueError, match="did you mean 'phantom'"):
        gym.make(env_id, scene="fantom")
    env = gym.make(env_id).unwrapped
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    with pytest.raises(ValueError, match="option 'difficulty' is unknown"):
        env.reset(options={"difficulty": 3})
