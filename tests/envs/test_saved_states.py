"""A state is loaded as a whole or refused as a whole: broken archives, one change at a time."""

import io
import json
import re
import zipfile

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from tests.envs.own_task import load_own_task

SMALL = {"scene": "phantom_small"}
PALPATE, SITES = "SurgSim/Palpate-v0", "SurgSim/PalpateSites-v0"
SHIPPED = {
    PALPATE: {**SMALL, "memory": True},
    SITES: {**SMALL, "budget": 5},
    "SurgSim/Retract-v0": {},
    "SurgSim/BimanualRetract-v0": {},
}
# What replaces an entry of a JSON document.
WRONG_VALUES = (None, True, -1, 0, 7, 10**30, 0.5, -0.5, 1e300, float("nan"), float("inf"), "", "text", [], [1.0], {})


def played(id: str, *, steps: int = 3, **settings):
    env = gym.make(id, **settings).unwrapped
    env.reset(seed=4)
    rng = np.random.default_rng(0)
    for _ in range(steps):
        env.step(rng.uniform(-0.5, 0.5, env.action_space.shape).astype(np.float32))
    return env


@pytest.fixture(scope="module")
def palpate():
    return played(PALPATE, **SHIPPED[PALPATE])


@pytest.fixture
def saved(palpate) -> dict[str, np.ndarray]:
    return unpack(palpate.save_state())


def unpack(state: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(state), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def pack(arrays: dict[str, np.ndarray], save=np.savez) -> bytes:
    buffer = io.BytesIO()
    save(buffer, **arrays)
    return buffer.getvalue()


def whole(env) -> tuple[object, ...]:
    """All that a refused state must leave as it is: saved, not saved, and which objects there are."""
    simulation = env.simulation
    data = simulation.instrument.data
    return (
        env.save_state() if env._begun else None,
        *(array.tobytes() for array in (data.qacc, data.xpos, data.site_xpos, data.cvel, data.qfrc_constraint)),
        *(array.tobytes() for array in (env.last_action, env._observation)),
        env._begun, env._running, env._np_random, env._picture, simulation.fault,
        *map(id, (simulation._taken, simulation.organ_model, simulation.organ_state, simulation.instrument.data)),
    )  # fmt: skip


def refusal(env, state: bytes) -> str | None:
    """Why a state is refused, after checks that nothing changed; None where it is loaded and saves to the same."""
    before, kept = whole(env), dict(vars(env.task))
    try:
        env.load_state(state)
    except ValueError as error:
        assert whole(env) == before
        assert all(vars(env.task)[name] is value for name, value in kept.items())
        message = str(error)
        assert message and message.isprintable() and len(message) < 1000, message
        return message
    found, given = unpack(env.save_state()), unpack(state)
    assert found.keys() == given.keys()
    for name, array in found.items():
        assert array.dtype.kind == given[name].dtype.kind, name
        if array.dtype.kind == "U" and str(array).startswith("{"):
            # 0 and 0.0 are one number.
            array, given[name] = (np.array(json.loads(str(one))) for one in (array, given[name]))
        np.testing.assert_array_equal(array, given[name], err_msg=name)
    return None


# ---- one change, and the message -----------------------------------------------------------------------------------


def told(document: np.ndarray, **entries) -> np.ndarray:
    return np.array(json.dumps({**json.loads(str(document)), **entries}))


def changed(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array.flat[array.size // 2] = value
    return array


def drawn(document: np.ndarray, **entries) -> np.ndarray:
    return told(document, drawn=str(told(json.loads(str(document))["drawn"], **entries)))


BREAKS = [
    ("random", lambda array: None, "random is missing"),
    ("organ_node_force", lambda array: None, "organ_node_force is missing"),
    ("made_by", lambda array: None, "made_by, the text that names its environment, is missing"),
    ("another", lambda array: np.zeros(3), "'another' is unknown; the entries are organ_node_position"),
    ("random", lambda array: np.array("{}"), r"random is '\{\}'; it must be the state of a PCG64 generator"),
    ("random", lambda array: told(array, bit_generator="MT19937"), "must be the state of a PCG64 generator"),
    ("random", lambda array: told(array, has_uint32=True), "must be the state of a PCG64 generator"),
    ("random", lambda array: np.array(1.5), "random is of type float64; it must be text"),
    ("running", lambda array: np.array(1), "running is of type int64; it must be bool"),
    ("observation", lambda array: changed(array, np.nan), r"observation .* = nan left its bounds"),
    ("observation", lambda array: changed(array, 1e6), r"observation .* = 1e\+06 left its bounds"),
    ("observation", lambda array: array.astype(np.float64), "observation is of type float64; it must be float32"),
    ("observation", lambda array: array[:-1], "observation has shape .*; it must be"),
    ("organ_node_position", lambda array: array.astype(np.float32), "is of type float32; it must be float64"),
    ("organ_node_position", lambda array: array.astype(str), "organ_node_position is of type <U32; it must be float64"),
    ("organ_node_position", lambda array: array[:10], r"has shape \(10, 3\); it must be \(\d+, 3\)"),
    ("organ_node_velocity", lambda array: changed(array, np.inf), r"organ_node_velocity\[\d+, \d\] is inf; without a"),
    ("rest_position", lambda array: changed(array, -1e308), r"is -1e\+308; without a fault it must be .* 1e\+100"),
    ("organ_contact_engaged", lambda array: changed(array, 2), r"organ_contact_engaged is 0 to 2; the rule is 0 <="),
    ("organ_contact_passed", lambda array: array - 1, "organ_contact_passed is -1 to -1; the rule is 0 <="),
    ("step", lambda array: array * 0 - 1, "step is -1 to -1; the rule is 0 <= step <"),
    ("step", lambda array: array * 0 + 2**62, "step is 4611686018427387904 .*; the rule is 0 <= step <"),
    ("pull_peak", lambda array: array * 0 - 0.1, "pull_peak is -0.1 to -0.1; the rule is 0 <= pull_peak < inf"),
    ("instrument", lambda array: changed(array, np.nan), r"instrument\[\d+\] is nan; without a fault it must be"),
    # The last twelve are the servo's: three joints' commands, flags of their limits, lower and upper limits.
    ("instrument", lambda array: np.concatenate([array[:-9], [0.5], array[-8:]]), "is 0.5, which no such instrument"),
    # After the time come the coordinates.
    ("instrument", lambda array: np.r_[array[0], 2e9, array[2:]], "its coordinate 0 is 2e.09; the rule is at most"),
    ("instrument", lambda array: np.r_[array[:-12], -1e6, array[-11:]], "its commanded speed 0 is -1e.06; the rule"),
    ("fault", lambda array: np.array(0.0), "fault is of type float64; it must be text"),
    ("task", lambda array: np.array("1"), "task: '1' is no JSON object"),
    ("task", lambda array: np.array("{}"), 'task: missing value for field "drawn"'),
    ("task", lambda array: np.array("[" * 100000), "is no JSON document"),
    ("task", lambda array: np.array(str(array)[:50]), "is no JSON document"),
    ("task", lambda array: told(array, more=1), "task: entry 'more' is unknown there"),
    ("task", lambda array: told(array, counts=[3.0, 0]), "task: counts: 3.0 is not a whole number"),
    ("task", lambda array: told(array, counts=[-1, 0]), r"task: counts\[0\] is -1; it must be at least 0, at most 600"),
    ("task", lambda array: told(array, counts=[3, 4]), r"task: counts\[1\] is 4; it must be at least 0, at most 3"),
    ("task", lambda array: told(array, bias=[0.0, np.nan, 0.0]), "task: bias: nan is not a finite number"),
    ("task", lambda array: told(array, bias=[0.0, 0.0]), "bias has 2 entries; the rule is 3 for this sensor"),
    ("task", lambda array: told(array, memory=None), "task: the episode has no memory, and this .* made with one"),
    ("task", lambda array: told(array, memory=[[1.0], [1.0]]), r"memory: sums of shapes \(1,\) and \(1,\); they must"),
    ("task", lambda array: drawn(array, background=-1.0), "drawn: background is -1; it must be finite and above 0"),
    ("task", lambda array: drawn(array, background=1e4), "substeps of .* ms are too long for this organ"),
    ("task", lambda array: drawn(array, lesions=[]), r"task: drawn.lesions is empty"),
    ("task", lambda array: drawn(array, lesions=[[9.0, 9.0, 9.0, 0.01, 1e4]]), "lies inside the organ"),
    ("task", lambda array: drawn(array, lesions=[[1.0] * 5] * 101), "lesions has 101 entries; at most 100"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "change", "message"), BREAKS, ids=[f"{n}-{one[0]}" for n, one in enumerate(BREAKS)])
def test_a_broken_entry_is_named_and_changes_nothing(palpate, saved, name, change, message):
    array = change(saved.get(name))
    rest = {key: value for key, value in saved.items() if key != name}
    reason = refusal(palpate, pack(rest if array is None else {**rest, name: array}))
    assert reason is not None and re.search(message, reason), reason


def test_bytes_that_are_no_archive_are_refused(palpate, saved, tmp_path):
    state = pack(saved)
    twice = io.BytesIO(state)
    with zipfile.ZipFile(twice, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("task.npy", b"")
    lone = io.BytesIO()
    np.save(lone, saved["organ_node_position"])
    bare = io.BytesIO(state)
    with zipfile.ZipFile(bare, "a") as archive:
        archive.writestr("more.npy", b"no array")
    for broken, message in (
        (b"", "not a zip file"),
        (b"garbage", "not a zip file"),
        (state[: len(state) // 2], "not a zip file"),
        (state[:-40], "not a zip file"),
        (lone.getvalue(), "not a zip file"),
        ("a text", "bytes-like object"),
        (None, "not a zip file"),
        (twice.getvalue(), "two entries of one name"),
        (bare.getvalue(), "'more' is unknown"),
        (pack(saved, np.savez_compressed), "is compressed, which save_state does not do"),
        (pack({**saved, "task": np.array([{}], dtype=object)}), "allow_pickle=False"),
    ):
        reason = refusal(palpate, broken)
        assert reason is not None and message in reason, reason


def test_an_environment_that_was_never_reset_stays_so(palpate, saved):
    env = gym.make(PALPATE, **SHIPPED[PALPATE]).unwrapped
    for change in ({"random": np.array("{}")}, {"task": np.array("{}")}, {"organ_node_position": np.zeros(3)}):
        assert refusal(env, pack({**saved, **change}))
        assert env._np_random is None and env.task.drawn is None
        with pytest.raises(gym.error.ResetNeeded):
            env.step(np.zeros(4, dtype=np.float32))
    env.load_state(pack(saved))
    assert env.save_state() == palpate.save_state()


def test_the_attributes_that_a_users_task_keeps_stay_of_their_kind():
    env = played(load_own_task())
    arrays = unpack(env.save_state())
    kept = json.loads(str(arrays["task"]))["kept"]
    for change, message in (
        ({"followed": "far"}, "kept.followed is a text; it must be a number, as in this environment"),
        ({"normal": [0.0, 0.0, 1.0]}, "kept.normal is a list; it must be an array of type float64 with 1 axes"),
        ({"normal": {"array": [0, 0, 1], "dtype": "int64"}}, "kept.normal is an array of type int64 with 1 axes"),
        ({"normal": {"array": ["x"], "dtype": "float64"}}, "kept.normal cannot be an array of type 'float64'"),
        ({"normal": {"array": [{}], "dtype": "object"}}, "kept.normal cannot be an array of type 'object': it must be"),
        ({"normal": {"list": []}}, "kept.normal has the entries ['list']; they must be array and dtype"),
        ({"more": 1.0}, "kept has the entries ['followed', 'line_end', 'line_start', 'more', 'normal']; they must be"),
    ):
        reason = refusal(env, pack({**arrays, "task": told(arrays["task"], kept={**kept, **change})}))
        assert reason is not None and message in reason, reason


def test_a_users_own_set_state_may_raise_anything(palpate, saved, monkeypatch):
    def broken(self, text):
        self.step_count = 10**6
        raise ZeroDivisionError("nothing is left")

    monkeypatch.setattr(type(palpate.task), "set_state", broken)
    reason = refusal(palpate, pack(saved))
    assert reason is not None and "PalpateTask.set_state raised ZeroDivisionError: nothing is left" in reason


def test_a_text_that_is_restored_otherwise_is_refused(palpate, saved, monkeypatch):
    monkeypatch.setattr(type(palpate.task), "set_state", lambda self, text: palpate.simulation.organ_model)
    reason = refusal(palpate, pack({**saved, "task": told(saved["task"], counts=[1, 0])}))
    assert reason is not None and re.search(r"'.*1, 0.*' at character \d+ is restored as '.*3, 0.*'", reason), reason


def test_a_press_that_was_begun_outlives_a_refusal():
    env = played(SITES, steps=0, **SHIPPED[SITES])
    broken = pack({**unpack(env.save_state()), "step": np.array(-1)})
    press = env.begin_press(np.full(2, 0.3))
    reason = refusal(env, broken)
    assert reason is not None and "step is -1" in reason
    assert env._made is not None and env._made[1] is press


def test_a_control_step_that_lanes_took_outlives_a_refusal():
    envs = gym.make_vec(PALPATE, num_envs=2, vectorization_mode="vector_entry_point", **SMALL)
    envs.reset(seed=5)
    single = envs.envs[0].unwrapped
    envs._groups[0].control_step(np.ones(2, dtype=bool), 5, np.inf)
    taken = single.simulation._taken
    assert taken is not None
    with pytest.raises(ValueError, match="random is missing"):
        single.load_state(pack({name: one for name, one in unpack(single.save_state()).items() if name != "random"}))
    assert single.simulation._taken is taken
    envs.close()


def test_the_state_of_a_fault_is_loaded_although_it_is_not_finite(palpate):
    env = gym.make(PALPATE, **SHIPPED[PALPATE]).unwrapped
    env.reset(seed=4)
    env.simulation.organ_state.node_velocity[40, 1] = np.nan
    *_, info = env.step(np.zeros(4, dtype=np.float32))
    assert "no longer finite" in info["sim_fault"]
    state = env.save_state()
    env.reset(seed=1)
    env.load_state(state)
    assert env.save_state() == state
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(4, dtype=np.float32))
    assert "without a fault it must be finite" in refusal(env, pack({**unpack(state), "fault": np.array("")}))


# ---- any change ----------------------------------------------------------------------------------------------------


def mutated(document: object, rng: np.random.Generator) -> object:
    """A JSON document with one change at a random depth; texts that hold JSON are opened."""
    if isinstance(document, str) and document.startswith("{"):
        return json.dumps(mutated(json.loads(document), rng))
    if isinstance(document, dict | list) and document and rng.random() < 0.9:
        changed = document.copy()
        key = (
            list(changed)[rng.integers(len(changed))] if isinstance(changed, dict) else int(rng.integers(len(changed)))
        )
        if rng.random() < 0.1:
            del changed[key]
        elif rng.random() < 0.1 and isinstance(changed, dict):
            changed["more"] = changed[key]
        else:
            changed[key] = mutated(changed[key], rng)
        return changed
    return WRONG_VALUES[rng.integers(len(WRONG_VALUES))]


def mutated_array(array: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An array with one entry, its type or its shape changed."""
    kinds = [np.float64, np.float32, np.int64, np.uint8, np.bool_, str, ">f8"]
    wrong = [np.nan, np.inf, -np.inf, -1.0, 1e300, 0.5, 2.0, 255.0, 2.0**62, -0.0]
    with np.errstate(all="ignore"):
        match rng.integers(4):
            case 0:
                return array.astype(kinds[rng.integers(len(kinds))])
            case 1 if array.ndim and array.size:
                return [array[:-1], array[None], np.concatenate([array, array]), array[..., 0]][rng.integers(4)]
            case _ if array.size:
                array = array.copy()
                array.flat[rng.integers(array.size)] = np.array(wrong[rng.integers(len(wrong))]).astype(array.dtype)
                return array
    return array[None]


def mutation(arrays: dict[str, np.ndarray], rng: np.random.Generator) -> bytes:
    """A state with one change somewhere."""
    names = list(arrays)
    name = names[rng.integers(len(names))]
    rest = {key: value for key, value in arrays.items() if key != name}
    match rng.integers(8):
        case 0:
            return pack(rest)
        case 1:
            return pack({**arrays, "more": arrays[name]})
        case 2 | 3:
            if arrays[name].dtype.kind != "U":
                return pack({**rest, name: mutated_array(arrays[name], rng)})
            text = str(arrays[name])
            return pack({**rest, name: np.array(text[: rng.integers(len(text))] if text else "fault")})
        case 4 | 5 | 6:
            name = ["task", "task", "task", "random"][rng.integers(4)]
            return pack({**arrays, name: np.array(mutated(str(arrays[name]), rng))})
    state = bytearray(pack(arrays))
    if rng.random() < 0.3:
        return bytes(state[: rng.integers(len(state))])
    for place in rng.integers(len(state), size=rng.integers(1, 4)):
        state[place] ^= 1 << rng.integers(8)
    return bytes(state)


def attack(id: str, count: int, *, steps: bool, **settings) -> tuple[int, int]:
    """Load that many broken states; returns how many were loaded and how many refused."""
    env, twin = played(id, **settings), played(id, **settings)
    good, rng, loaded = env.save_state(), np.random.default_rng(count), 0
    arrays, still = unpack(good), np.zeros(env.action_space.shape, dtype=np.float32)
    for _ in range(count):
        if refusal(env, mutation(arrays, rng)) is None:
            loaded += 1
            if steps and env._running:
                assert np.isfinite(env.step(still)[0]).all()
            env.load_state(good)
    one, other = env.step(still), twin.step(still)
    np.testing.assert_array_equal(one[0], other[0])
    assert one[1:] == other[1:] and env.save_state() == twin.save_state()
    return loaded, count - loaded


@pytest.mark.parametrize("own", [False, True])
def test_a_state_with_any_change_is_loaded_or_refused_as_a_whole(own):
    id, settings = (load_own_task(), {}) if own else (PALPATE, SHIPPED[PALPATE])
    loaded, refused = attack(id, 100, steps=False, **settings)
    assert refused > 50 and loaded > 3, "the changes must try both"


@pytest.mark.slow
@pytest.mark.parametrize("id", [*SHIPPED, "own"])
def test_hundreds_of_changes_and_a_step_after_each_that_is_loaded(id):
    # What its own attributes hold is a user's task's to check.
    own = id == "own"
    loaded, refused = attack(load_own_task() if own else id, 500, steps=not own, **SHIPPED.get(id, {}))
    print(f"{id}: {loaded} loaded, {refused} refused")
