"""A task follows from its declaration: one more channel or reward is one place; what is wrong with one is refused."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest

from surgsim_env import CONTACT_FORCE, TAXELS, TIP_POSITION, Channel, PalpateTask, Reward, Setup, Task, register_task
from surgsim_env.envs.ids import TASKS, environment_class
from surgsim_env.scene.levels import LESION_GAP
from surgsim_env.scripting import oracle_script, run_script
from tests.envs.own_task import IDS, load_own_task, own_task_code

HEIGHT = Channel(
    "height", 2, "m", -0.1, 0.1,
    read=lambda task, simulation: [simulation.instrument.tip_position[2], 0.01],
    meaning="height of the tip, and a hundredth", scale=0.01,
)  # fmt: skip
SLOW = Reward("slow", -0.5, "step", "speed of the tip", lambda task, step: task.speed(step.simulation))


class PalpateSlowly(PalpateTask):
    """Palpate slowly."""

    channels = (*PalpateTask.channels, HEIGHT)
    rewards = (*PalpateTask.rewards, SLOW)

    def speed(self, simulation):
        return float(np.linalg.norm(simulation.instrument.tip_velocity))


class Touch(Task):
    """Touch the organ."""

    channels = (TIP_POSITION, CONTACT_FORCE)
    rewards = (Reward("time", -1.0, "step", "each control step"), Reward("success", 1.0, "success", "it was touched"))
    setup = Setup(scene="phantom_small")

    def draw(self, rng):
        point, normal = self.anatomy.face.random_point(rng, 0.01)
        return point + 0.012 * normal


@pytest.fixture
def registered():
    """A function that registers a task under an id of this file's, which is forgotten afterwards."""
    made = []

    def register(task_class, id="Test/Own-v0", **more):
        register_task(id, task_class, **more)
        made.append(id)
        return id

    yield register
    for id in made:
        gym.registry.pop(id, None)
        TASKS.pop(id, None)


def test_an_own_task_feels_taxels(registered):
    """Of an instrument that has them, through their sensor model; without them the channel is left out."""

    class Feeling(Touch):
        channels = (TIP_POSITION, TAXELS)

    env_id = registered(Feeling)
    assert gym.make(env_id).observation_space.shape == (3,)
    env = gym.make(env_id, instrument="tactile_probe").unwrapped
    env.reset(seed=0)
    while not env.simulation.contact_force.any():
        observation, *_ = env.step(np.array([0.0, 0.0, -1.0], dtype=np.float32))
    felt = observation[env.observation_slices["taxels"]] * env.scene.limits.soft_force
    true = env.simulation.taxels.ravel()
    assert felt.shape == true.shape == (48,) and true.any()
    noise = env.scene.instrument.taxels.noise
    assert 0.0 < np.abs(felt - true).max() < 6.0 * noise


# ---- one place ---------------------------------------------------------------------------------------------------


def test_one_more_channel_and_reward_in_a_shipped_task_are_one_place(registered):
    """Bounds, slices, documentation, info and lanes follow, and what was there stays where it was."""
    id = registered(PalpateSlowly)
    env, plain = (gym.make(env_id, scene="phantom_small") for env_id in (id, "SurgSim/Palpate-v0"))
    inner = env.unwrapped
    slices = inner.observation_slices
    assert slices == {**plain.unwrapped.observation_slices, "height": slice(11, 13)}
    space = env.observation_space
    assert space.shape == (13,) and (space.high[11:] == np.float32(10.0)).all() and (space.low[11:] < 0.0).all()
    assert "| `height` | 2 | height of the tip, and a hundredth [m] | +-0.1 | 0.01 m |" in inner.__doc__
    assert "| `slow` | -0.5 | control step | speed of the tip |" in inner.__doc__
    assert "## Starting State" in inner.__doc__ or inner.__doc__.startswith("Palpate slowly.")
    observation, info = env.reset(seed=3)
    np.testing.assert_array_equal(observation[:11], plain.reset(seed=3)[0])
    assert info["reward_slow"] == 0.0
    down = np.array([0.0, 0.0, -0.5, 0.0], dtype=np.float32)
    for _ in range(3):
        (observation, reward, *_, info), (expected, paid, *_) = env.step(down), plain.step(down)
    np.testing.assert_array_equal(observation[:11], expected)
    seen = inner.si_values(observation)
    np.testing.assert_allclose(seen[slices["height"]], [seen[2], 0.01], atol=1e-7)
    np.testing.assert_allclose(observation[slices["height"]], [100.0 * seen[2], 1.0], rtol=1e-5)
    assert info["reward_slow"] == pytest.approx(-0.5 * 0.01, rel=0.1)
    assert reward == pytest.approx(paid + info["reward_slow"])
    envs = gym.make_vec(id, num_envs=2, vectorization_mode="vector_entry_point", scene="phantom_small")
    assert envs.reset(seed=[3, 4])[0].shape == (2, 13) and envs.unwrapped.observation_slices == slices
    envs.close()


def test_a_small_task_has_arguments_level_end_state_and_lanes(registered):
    class Gentle(Touch):
        kept = ("place", "steps", "words")

        def __init__(self, scenario, *, force=0.05):
            super().__init__(scenario)
            self.force = force

        def draw(self, rng):
            self.place, self.steps, self.words = rng.uniform(size=2), [0, 0.5], "none"
            return super().draw(rng)

        def update(self, step):
            self.steps = [self.step_count, 0.5]

        def end(self, step):
            return super().end(step) or (
                "success" if np.linalg.norm(step.simulation.contact_force) > self.force else ""
            )

    env = gym.make(registered(Gentle), force=0.1, level="hard").unwrapped
    assert env.task.force == 0.1
    env.reset(seed=1)
    assert env.task.level.name == "hard" and env.scene.timing.mass_scaling
    down = np.array([0.0, 0.0, -0.8], dtype=np.float32)
    env.step(down)
    saved = env.save_state()
    kept = env.task.place.copy()
    expected = [env.step(down) for _ in range(20) if not env.halted]
    assert expected[-1][2] and expected[-1][-1]["success"] and expected[-1][-1]["reward_success"] == 1.0
    env.reset(seed=9)
    env.load_state(saved)
    assert env.save_state() == saved and (env.task.place == kept).all() and env.task.steps == [1, 0.5]
    for record in expected:
        observation, *rest = env.step(down)
        np.testing.assert_array_equal(observation, record[0])
        assert rest == list(record[1:])
    with pytest.raises(ValueError, match="no oracle is known for GentleEnv"):
        oracle_script(env)


# ---- the tutorial's tasks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", IDS)
def test_the_tutorials_tasks_have_at_most_45_lines(name):
    assert len(own_task_code(name).splitlines()) <= 45


@pytest.mark.parametrize("seed", [1, 5])
def test_the_tutorials_oracle_holds_the_force_over_the_lesion(seed):
    env = gym.make(load_own_task("hold_force"))
    env.reset(seed=seed)
    inner = env.unwrapped
    assert inner.task.level.name == "standard" and len(inner.task.lesions) == 1
    trace = run_script(env, oracle_script(env))
    force = trace.between("AwaitEnd").force
    assert trace.info["success"] and (np.abs(np.linalg.norm(force, axis=1) - 0.3) < 0.05).all()
    assert trace.reward.sum() == pytest.approx(6.0)


# ---- members and lesions -----------------------------------------------------------------------------------------


def test_a_task_has_twelve_public_members():
    """Class attributes, properties and methods of the base."""
    assert [name for name in dir(Task) if not name.startswith("_")] == [
        *("accepts", "channels", "command", "commands", "draw", "end", "info", "kept", "pictured", "rewards", "setup"),
        "update",
    ]


@pytest.mark.parametrize("level", [None, "hard"])
@pytest.mark.parametrize(("declared", "counts"), [(2, {2}), ((1, 2), {1, 2})])
def test_lesions_are_as_many_as_declared(declared, counts, level):
    setup = Setup(scene="phantom", level=level, lesion_count=declared)
    env = environment_class(type("Lesions", (Touch,), {"setup": setup}))()
    task, drawn = env.task, set()
    for seed in range(8):
        env.runtime.draw(np.random.default_rng(seed))
        drawn.add(len(task.lesions))
        balls = [(np.array(lesion.centre), lesion.radius) for lesion in task.lesions]
        for number, (centre, radius) in enumerate(balls):
            for other, other_radius in balls[:number]:
                assert np.linalg.norm(centre - other) >= radius + other_radius + LESION_GAP
    assert drawn == counts


def test_without_a_level_a_task_draws_lesions_only_if_it_declares_them():
    plain, levelled = (environment_class(Touch)(**settings) for settings in ({}, {"level": "standard"}))
    counts = {0: set(), 1: set()}
    for seed in range(12):
        for number, env in enumerate((plain, levelled)):
            env.runtime.draw(np.random.default_rng(seed))
            counts[number].add(len(env.task.lesions))
    assert counts[0] == {0} and len(counts[1]) > 1


# ---- refusals of a declaration --------------------------------------------------------------------------------------


def channel(**changes):
    return Channel(
        **{"name": "one", "size": 1, "low": 0.0, "high": 1.0, "read": lambda *_: 0.5, "meaning": "it", **changes}
    )


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"low": None}, "'one'.*low"),
        ({"sensor": 1.0}, "'one'.*sensor is 1.0"),
    ],
)
def test_wrong_channels_are_refused(changes, named):
    with pytest.raises(ValueError, match=named):
        channel(**changes)


def test_a_reward_for_a_change_needs_a_value():
    with pytest.raises(ValueError, match=r"'one'.*value"):
        Reward("one", 1.0, "change", "it")


# ---- refusals of a class and an id -----------------------------------------------------------------------------------


def test_two_channels_of_one_name_are_refused():
    with pytest.raises(ValueError, match="tip_position, tip_position"):
        type("Changed", (Touch,), {"channels": (TIP_POSITION, TIP_POSITION)})


# ---- refusals at construction and at the first reset -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"low": lambda *_: np.nan}, "'one'.*nan"),
        ({"low": lambda *_: 3.0}, r"one\[0\].*low is 3"),
    ],
)
def test_wrong_bounds_are_refused_at_construction(changes, named):
    with pytest.raises(ValueError, match=named):
        environment_class(type("Wrong", (Touch,), {"channels": (CONTACT_FORCE, channel(**changes))}))()


@pytest.mark.parametrize(
    ("read", "named"),
    [
        (lambda *_: [0.1, 0.2], r"'one'.*\(2,\)"),
        (lambda *_: np.nan, r"one\[0\] = nan"),
        (lambda *_: 1.5, r"one\[0\] = 1.5"),
    ],
)
def test_wrong_reads_are_refused_at_the_first_reset(read, named):
    env = environment_class(type("Wrong", (Touch,), {"channels": (CONTACT_FORCE, channel(read=read))}))()
    with pytest.raises(ValueError, match=named):
        env.reset(seed=0)


def test_a_channel_that_leaves_its_bounds_later_is_a_fault():
    late = channel(read=lambda task, simulation: 0.5 + task.step_count)
    env = environment_class(type("Late", (Touch,), {"channels": (CONTACT_FORCE, late)}))()
    first = env.reset(seed=0)[0]
    observation, _, terminated, _, info = env.step(np.zeros(3, dtype=np.float32))
    assert terminated and info["sim_fault"] == "observation one[0] = 1.5 left its bounds, 0 to 1"
    np.testing.assert_array_equal(observation, first)


# ---- a task's own numbers, ends and draws ----------------------------------------------------------------------------

STILL = np.zeros(3, dtype=np.float32)
MASKED = np.ma.array(0.5, mask=True)


class OfTouch(environment_class(Touch)):
    """A user's own class of an environment."""


def played(**attributes):
    """An environment of `Touch` with other attributes, one step after a reset."""
    env = environment_class(type("Own", (Touch,), attributes))()
    env.reset(seed=1)
    return env, env.step(STILL)


@pytest.mark.parametrize("per", ["step", "change"])
@pytest.mark.parametrize(
    "value", [np.nan, np.inf, -np.inf, 1j, np.complex128(1.0), None, "1", np.ones(2), [], np.ma.masked, MASKED]
)
def test_a_reward_that_is_no_finite_number_is_named(value, per):
    late = lambda task, step: value if task.step_count else 0.0  # noqa: E731
    for amount in (late, lambda task, step: value):
        with pytest.raises(ValueError, match="'odd'"):
            played(rewards=(Reward("time", -1.0, "step"), Reward("odd", 1.0, per, "", amount)))


@pytest.mark.parametrize("weight", [np.nan, np.inf, 1j, "1", None, np.ones(1), MASKED])
def test_a_weight_that_is_not_finite_is_refused(weight):
    with pytest.raises(ValueError, match="'odd'"):
        Reward("odd", weight, "step")


def test_a_period_that_no_reward_has_is_named():
    with pytest.raises(ValueError, match="'sucess'"):
        Reward("odd", 1.0, "sucess")  # type: ignore[arg-type]


def test_steps_left_need_a_number_of_steps():
    with pytest.raises(ValueError, match="'odd'"):
        played(setup=Setup(scene="phantom_small", episode_steps=None), rewards=(Reward("odd", -1.0, "step left"),))


@pytest.mark.parametrize("value", [0.5, np.float32(0.5), np.array(0.5), True, 2])
def test_numbers_of_any_kind_are_paid(value):
    _, (_, reward, *_, info) = played(rewards=(Reward("own", 2.0, "step", "", lambda *_: value),))
    assert reward == info["reward_own"] == 2.0 * float(value) and type(reward) is float


@pytest.mark.parametrize("end", [True, 1, None, ["success"], np.array(["success"]), b"success", "sucess", "time"])
def test_an_end_that_is_not_declared_is_named(end):
    with pytest.raises(ValueError, match=r"Own\.end"):
        played(end=lambda self, step: end)


@pytest.mark.parametrize("end", ["", "success", "done", "damage", "torn"])
def test_a_declared_end_ends_the_episode(end):
    rewards = (*Touch.rewards, Reward("torn", -3.0, "failure"))
    _, (_, reward, terminated, _, info) = played(end=lambda self, step: end, rewards=rewards)
    assert (terminated, info["success"]) == (end != "", end == "success")
    assert reward == {"success": 0.0, "torn": -4.0}.get(end, -1.0)


@pytest.mark.parametrize(
    "tip",
    [
        lambda point, normal: point - 0.01 * normal,
        lambda point, normal: point - 0.0005 * normal,
        lambda point, normal: point * np.nan,
        lambda point, normal: point + 0.012 * normal + 1j,
        lambda point, normal: (point + 0.012 * normal)[:2],
        lambda point, normal: 0.05,
        lambda point, normal: None,
        lambda point, normal: np.ma.array(point + 0.012 * normal, mask=[0, 0, 1]),
    ],
)
def test_a_tip_inside_the_organ_or_nowhere_is_named(tip):
    with pytest.raises(ValueError, match=r"draw.*Own|Own\.draw"):
        played(draw=lambda self, rng: tip(*self.anatomy.face.random_point(rng, 0.01)))


def test_after_a_reset_that_raised_nothing_is_played_or_saved():
    env, _ = played()
    draw = env.task.draw
    env.task.draw = lambda rng: 1 / 0
    with pytest.raises(ZeroDivisionError):
        env.reset()
    for call in (lambda: env.step(STILL), env.save_state):
        with pytest.raises(gym.error.ResetNeeded):
            call()
    env.task.draw = draw
    env.reset()
    env.step(STILL)


@pytest.mark.parametrize(
    "value", [0.5 + 0.1j, np.complex64(0.5), "0.5", None, [0.5, [0.1]], np.array([0.5], dtype=object), MASKED]
)
def test_a_read_that_is_no_real_number_is_named(value):
    with pytest.raises(ValueError, match="'one'"):
        played(channels=(CONTACT_FORCE, channel(read=lambda *_: value)))


@pytest.mark.parametrize("value", [1.0, np.ones(1), np.ones(2), np.ones(3) * 1j])
def test_a_read_in_front_of_a_sensor_has_three_real_numbers(value):
    force = Channel("force", 3, "N", sensor=1.0, scale=1.0, read=lambda *_: value)
    with pytest.raises(ValueError, match="'force'"):
        played(channels=(force,))


def test_a_pickled_subclass_is_of_its_own_class():
    env = OfTouch()
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        assert type(twin) is OfTouch
    assert type(pickle.loads(pickle.dumps(environment_class(Touch)()))) is environment_class(Touch)


# ---- kept attributes -------------------------------------------------------------------------------------------------

KEPT = [
    *(np.zeros((0, 3)), np.zeros((2, 0), np.float32), np.array(3.0), np.ones(2) * 1j, np.ones(2, np.longdouble) / 3.0),
    *(np.array(["2026-01-01", "NaT"], "datetime64[D]"), np.arange(3, dtype=">i4"), np.array(["a", "bcd"])),
    *(np.zeros(2, [("a", "f8"), ("b", "i4")]), np.asfortranarray(np.arange(6.0).reshape(2, 3))),
    *(np.float32(0.1), np.float64(0.1), np.int64(7), np.bool_(True), np.datetime64("NaT"), np.timedelta64(3, "s")),
    *(np.nan, -0.0, 10**30, True, None, "a\0b"),
    *((1, 2.0), [(1, np.ones(1)), []], (), {}, {1: 2, (1, 2): [3]}, {"array": [1], "dtype": "f8"}, {"tuple": 1}),
]


def identical(value, other):
    if type(value) is not type(other):
        return False
    if isinstance(value, np.ndarray | np.generic):
        return value.dtype == other.dtype and value.shape == other.shape and value.tobytes() == other.tobytes()
    if isinstance(value, list | tuple):
        return len(value) == len(other) and all(map(identical, value, other))
    if isinstance(value, dict):
        return identical(list(value.items()), list(other.items()))
    return repr(value) == repr(other)


@pytest.mark.parametrize("value", KEPT, ids=repr)
def test_kept_values_come_back_as_they_were(value):
    env, _ = played(kept=("thing",), update=lambda self, step: setattr(self, "thing", value))
    saved = env.save_state()
    env.task.thing = "another"
    env.load_state(saved)
    assert identical(env.task.thing, value) and env.save_state() == saved


@pytest.mark.parametrize(
    "value",
    [
        np.array([None]),
        np.ma.array([1], mask=[1]),
        np.zeros(2, [("a", "O")]),
        {1},
        b"a",
        len,
        np.random.default_rng(0),
        1j,
        [1, {1}],
        {"a": (b"a",)},
        # Of other bits after numpy's file: a record's type, a text's last zero, a text of variable length.
        np.rec.array([(1, 2.0)])[0],
        [np.bytes_(b"a\0")],
        np.array(["a"], np.dtypes.StringDType()),
    ],
    ids=lambda value: type(value).__name__,
)
def test_kept_values_that_would_change_are_refused_by_name(value):
    env, _ = played(kept=("thing",), update=lambda self, step: setattr(self, "thing", value))
    with pytest.raises(TypeError, match="'thing'"):
        env.save_state()
