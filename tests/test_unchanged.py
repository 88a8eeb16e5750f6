"""Fixed-seed episodes and organs whose numbers must not change by one bit, compared with recorded hashes.

The hashes are in `unchanged_hashes.json`, one set for each family of machines: compilers and libraries round
differently on another processor or in another version. What changes on purpose is recorded where it is changed and
dropped from other families: a case without a hash of a family skips there. From the repository's root:

    python -m tests.test_unchanged --record                adds (or replaces) the hashes of this machine's family
    python -m tests.test_unchanged --record CASE ...       those of the named cases alone, after a deliberate change
    python -m tests.test_unchanged --print CASE > a.txt    everything that is hashed, to be compared between two commits
"""

import argparse
import atexit
import contextlib
import csv
import functools
import hashlib
import importlib
import io
import json
import os
import platform
import tempfile
import tomllib
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import scipy.linalg  # noqa: F401  (loads scipy's BLAS)
from llvmlite.binding import get_host_cpu_features
from threadpoolctl import threadpool_info

import msdm_core
import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.scripting import ScriptError, Trace, oracle_script, run_script

ROOT = Path(__file__).resolve().parents[1]
HASHES = Path(__file__).with_name("unchanged_hashes.json")
RECORD = "python -m tests.test_unchanged --record"

# What a case gives: by part (observation, reward, ...) anything that `lines` can write down.
Parts = dict[str, list]

# Where random actions lead: towards the tissue, so that contact, friction and force limits are in play.
PRESS = {"phantom": (0.0, 0.0, -0.3, 0.0), "phantom_small": (0.0, 0.0, -0.3, 0.0), "liver": (0.0, 0.25, -0.25, 0.0)}


def lines(value: object, path: str = "") -> Iterator[str]:
    """A value as lines of text with all its bits; names of types and the wording of messages do not enter."""
    if hasattr(value, "_asdict"):
        value = value._asdict()  # type: ignore[union-attr]
    if isinstance(value, Mapping):
        for key in sorted(value):
            yield from lines(value[key], f"{path}.{key}")
    elif isinstance(value, np.ndarray) and value.dtype != object and value.dtype.kind != "U" and value.ndim:
        plain = np.ascontiguousarray(value)
        short = " ".join(map(repr, plain.ravel().tolist())) if plain.size <= 400 else "..."
        digest = hashlib.blake2b(plain.tobytes(), digest_size=16).hexdigest()
        yield f"{path} {plain.dtype} {plain.shape} {digest} {short}"
    elif isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim):
        yield f"{path} {len(value)} entries"
        for number, one in enumerate(value):
            yield from lines(one, f"{path}[{number}]")
    elif isinstance(value, str | np.str_) or (isinstance(value, np.ndarray) and value.dtype.kind == "U"):
        # Messages may be reworded: whether there is one counts.
        yield f"{path} text {bool(str(value))}"
    elif value is None or isinstance(value, bool | int | np.bool_ | np.integer):
        yield f"{path} {value}"
    else:
        number = np.asarray(value)
        if number.dtype == object:
            raise TypeError(f"{path}: {type(value).__name__} has no bits to compare")
        yield f"{path} {number.dtype} {number.tobytes().hex()} {number.item()!r}"


def parsed(value: object) -> object:
    """JSON in whose texts there may be JSON again."""
    if isinstance(value, str):
        try:
            return parsed(json.loads(value))
        except ValueError:
            return value
    if isinstance(value, dict):
        return {key: parsed(one) for key, one in value.items()}
    return [parsed(one) for one in value] if isinstance(value, list) else value


def saved(env: gym.Env) -> dict[str, object]:
    """The contents of an environment's saved state but for the mark of what made it, which names classes."""
    with np.load(io.BytesIO(env.unwrapped.save_state()), allow_pickle=False) as archive:  # type: ignore[attr-defined]
        arrays: dict[str, object] = {name: archive[name] for name in archive.files if name != "made_by"}
    return {
        **arrays,
        "task": parsed(str(arrays["task"])),
        "random": parsed(str(arrays["random"])),
    }


def blank() -> Parts:
    return {name: [] for name in ("observation", "reward", "end", "info", "state", "task")}


def keep(
    parts: Parts, observation: object, reward: object, terminated: object, truncated: object, info: object
) -> None:
    for name, value in zip(parts, (observation, reward, (terminated, truncated), info), strict=False):
        parts[name].append(value)


def keep_state(parts: Parts, env: gym.Env) -> None:
    state = saved(env)
    parts["task"].append(state.pop("task"))
    parts["state"].append(state)


# ---- cases -----------------------------------------------------------------------------------------------------------

CASES: dict[str, Callable[[], Parts]] = {}
SLOW: set[str] = set()


def case(name: str, play: Callable[..., Parts], *given: object, slow: bool = False, **settings: object) -> None:
    assert name not in CASES
    CASES[name] = lambda: play(*given, **settings)
    if slow:
        SLOW.add(name)


@contextlib.contextmanager
def variable(name: str, value: str) -> Iterator[None]:
    """An environment variable for a while."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        os.environ.pop(name)
        if before is not None:
            os.environ[name] = before


@functools.cache
def fresh_folder() -> str:
    """An empty folder that lasts as long as the process."""
    folder = tempfile.TemporaryDirectory(prefix="unchanged-")
    atexit.register(folder.cleanup)
    return folder.name


def make(env_id: str, scene: str, **settings: object) -> gym.Env | gym.vector.VectorEnv:
    """An environment, or many of them if given `num_envs`; the small scene's map of healthy stiffness is made anew."""
    maker = (
        functools.partial(gym.make_vec, vectorization_mode="vector_entry_point") if "num_envs" in settings else gym.make
    )
    # Others take from half a minute on, so that they may come from the user's cache.
    fresh = scene == "phantom_small" and "Sites" in env_id
    with variable("SURGSIM_CACHE", fresh_folder()) if fresh else contextlib.nullcontext():
        return maker(f"SurgSim/{env_id}", scene=scene, scaled=False, **settings)  # type: ignore[arg-type, operator, return-value]


def random_actions(env_id: str, space: gym.spaces.Box, scene: str, count: int) -> np.ndarray:
    """Random actions towards the tissue, the same on every machine, shape (count, n) or (count, n_env, n)."""
    size = space.shape[-1]
    scale, shift = np.full(size, 0.5), np.zeros(size)
    if "Sites" in env_id:
        scale[:] = 1.0
    elif "Palpate" in env_id:
        shift[:] = PRESS[scene]
        scale[3] = 1.0  # declares now and then
    else:
        # The jaw nearly closed and towards the free edge.
        scale[1], shift[1], shift[6 if "Bimanual" in env_id else -1] = 0.2, -0.8, -0.5
    spread = np.random.default_rng(7).uniform(-1.0, 1.0, (count, *space.shape)) * scale
    return np.clip(spread + shift, -1.0, 1.0).astype(np.float32)


def play_random(
    env_id: str, scene: str, steps: int, loop: str = "compiled", seed: int = 3, **settings: object
) -> Parts:
    """Random actions from a seed; an episode that ends is followed by the next one."""
    with variable("SURGSIM_LOOP", loop):
        env = make(env_id, scene, **settings)
    parts = blank()
    observation, info = env.reset(seed=seed)
    keep(parts, observation, None, None, None, info)
    for action in random_actions(env_id, env.action_space, scene, steps):
        record = env.step(action)
        keep(parts, *record)
        if record[2] or record[3]:
            keep_state(parts, env)
            observation, info = env.reset()
            keep(parts, observation, None, None, None, info)
    keep_state(parts, env)
    env.close()
    return parts


def play_vector(env_id: str, scene: str, steps: int, count: int = 3, seed: int = 3, **settings: object) -> Parts:
    """The same side by side; ends, resets and what they tell included."""
    envs = make(env_id, scene, num_envs=count, **settings)
    parts = blank()
    observation, info = envs.reset(seed=seed)
    keep(parts, observation, None, None, None, info)
    for actions in random_actions(env_id, envs.action_space, scene, steps):
        keep(parts, *envs.step(actions))
    for env in envs.envs:  # type: ignore[attr-defined]
        keep_state(parts, env)
    envs.close()
    return parts


def play_oracle(env_id: str, scene: str, script_steps: int | None = None, seed: int = 3, **settings: object) -> Parts:
    """The package's own oracle; `script_steps`: only the first steps of its script."""
    env = make(env_id, scene, **settings)
    env.reset(seed=seed)
    try:
        trace: Trace = run_script(env, oracle_script(env)[:script_steps])
    except ScriptError as error:
        trace = error.trace
    parts: Parts = {
        "observation": [trace.observation],
        "reward": [trace.reward],
        "end": [trace.terminated, trace.truncated, bool(trace.failure)],
        "info": list(trace.infos),
        "state": [],
        "task": [],
        "action": [trace.action, [(step.start, step.end) for step in trace.steps], trace.control_time],
        "haptic": [trace.haptic_time, trace.wrench, trace.tip_position, trace.tip_orientation, trace.depth],
    }
    keep_state(parts, env)
    env.close()
    return parts


def play_greedy(scene: str, presses: int, seed: int = 3, **settings: object) -> Parts:
    """Press half of the time at random and half near the largest contrast that the observation shows."""
    env = make("PalpateSites-v0", scene, **settings)
    parts = blank()
    observation, info = env.reset(seed=seed)
    keep(parts, observation, None, None, None, info)
    actions = random_actions("PalpateSites-v0", env.action_space, scene, presses)
    sites = env.unwrapped.task.charted.touch_map.places  # type: ignore[union-attr]
    for number, action in enumerate(actions):
        if number % 2:
            place = sites[int(np.argmax(observation[: len(sites)]))]
            action = np.clip(place + 0.1 * action, -1.0, 1.0).astype(np.float32)
        observation, *rest = env.step(action)
        keep(parts, observation, *rest)
    keep_state(parts, env)
    env.close()
    return parts


def constants(organ: msdm_core.OrganModel) -> dict[str, object]:
    """The arrays of an organ, without those of motions, which these do not have."""
    assert not len(organ.motion_node_shift)
    return {name: value for name, value in organ._asdict().items() if not name.startswith("motion_")}


def scene_organ(env_id: str, scene: str, **settings: object) -> Parts:
    """The arrays of a scene's organ, healthy and as an episode draws it, with its stable step."""
    env = make(env_id, scene, **settings)
    simulation = env.unwrapped.simulation  # type: ignore[attr-defined]
    parts: Parts = {
        "organ": [constants(simulation.organ_model)],
        "stable_dt": [msdm_core.stable_dt(simulation.organ_model)],
    }
    env.reset(seed=3)
    parts["organ"].append(constants(simulation.organ_model))
    parts["stable_dt"].append(msdm_core.stable_dt(simulation.organ_model))
    env.close()
    return parts


def block_organ() -> Parts:
    """A block with capsule, lesions and volume term by every rule, set swinging."""
    mesh = msdm_core.box_mesh((0.06, 0.05, 0.04), (6, 5, 4))
    tissue = msdm_core.Material(5000.0, 1060.0, 0.45)
    stiff = msdm_core.Material(20000.0, 1100.0, 0.3)
    parts: Parts = {"mesh": [mesh.points, mesh.tets, mesh.boundary_triangles]}
    for rule, scheme, capsule in (
        ("lloyd", "barycentric", None),
        ("fitted", "voronoi", msdm_core.Capsule(1.0e6, 2.0e-5)),
        ("van_gelder", "barycentric", msdm_core.Capsule(20000.0)),
    ):
        specification = msdm_core.OrganSpec(
            mesh,
            tissue,
            capsule=capsule,
            lesions=(
                msdm_core.Lesion((0.02, 0.02, 0.02), 0.013, stiff),
                msdm_core.Lesion((0.045, 0.03, 0.02), material=stiff, radii=(0.011, 0.012, 0.013), name="ellipsoid"),
            ),
            anchors=np.flatnonzero(mesh.points[:, 2] < 1e-6),
            mass_scheme=scheme,  # type: ignore[arg-type]
            stiffness_rule=rule,
            damping=msdm_core.Damping(alpha=10.0, beta=1e-4),
        )
        organ = msdm_core.compile_organ(specification)
        step = msdm_core.stable_dt(organ)
        state = msdm_core.rest_state(organ)
        free = organ.node_inverse_mass > 0.0
        state.node_velocity[free] = np.random.default_rng(5).uniform(-0.1, 0.1, (int(free.sum()), 3))
        msdm_core.advance(organ, state, dt=0.5 * step, substep_count=200)
        parts.setdefault("organ", []).append(constants(organ))
        parts.setdefault("stable_dt", []).append(step)
        parts.setdefault("motion", []).extend([state.node_position, state.node_velocity])
    return parts


def heavy_block() -> Parts:
    """Static equilibrium of a hanging block."""
    mesh = msdm_core.box_mesh((0.03, 0.03, 0.03), (3, 3, 3))
    organ = msdm_core.compile_organ(
        msdm_core.OrganSpec(
            mesh,
            msdm_core.Material(3000.0, 1060.0, 0.4),
            anchors=np.flatnonzero(mesh.points[:, 2] > 0.03 - 1e-6),
            gravity=(0.0, 0.0, -9.81),
        )
    )
    state = msdm_core.rest_state(organ)
    return {"motion": [state.node_position, state.node_velocity]}


def meshes() -> Parts:
    """Lattices in a closed surface and in a label image."""
    corners = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]) * 0.04
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    places = (np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), axis=-1) - 11.5) * 0.002
    labels = (np.linalg.norm(places, axis=-1) < 0.02).astype(np.int64)
    labels[np.linalg.norm(places - 0.006, axis=-1) < 0.007] = 2
    names = {1: "organ", 2: "lesion"}
    made = {
        "surface": msdm_core.mesh_surface(corners, faces, cell_size=0.01),
        "labels": msdm_core.mesh_segmentation(labels, (0.002, 0.002, 0.002), cell_size=0.006, region_names=names),
    }
    parts: Parts = {}
    for name, mesh in made.items():
        quality = msdm_core.mesh_quality(mesh)
        parts[name] = [mesh.points, mesh.tets, mesh.region, mesh.volumes, mesh.boundary_triangles]
        parts[name].append(vars(quality) if hasattr(quality, "__dict__") else quality)
    return parts


def scan(scene: str, around: str) -> Parts:
    """Numbers that `surgsim palpate` writes."""
    module, function = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]["surgsim"].split(":")
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        arguments = ["palpate", "--scene", scene, "--around", around, "--out", folder, "--seed", "3", "--workers", "2"]
        status = getattr(importlib.import_module(module), function)(arguments)
        with open(Path(folder, "palpation.csv"), newline="") as file:
            rows = list(csv.reader(file))
        summary = json.loads(Path(folder, "summary.json").read_text())
    return {
        "status": [status],
        "csv": [[cell for cell in map(_number, row) if cell is not None] for row in rows],
        "summary": [{key: summary[key] for key in ("organ", "press", "sites", "model", "truth")}],
    }


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


for _scene, _steps in (("phantom", 40), ("phantom_small", 80), ("liver", 40)):
    case(f"Palpate-v0 {_scene} random", play_random, "Palpate-v0", _scene, _steps, slow=_scene == "liver")
    case(f"Palpate-v0 {_scene} oracle", play_oracle, "Palpate-v0", _scene, slow=_scene != "phantom_small")
case("Palpate-v0 phantom_small random, plain loop", play_random, "Palpate-v0", "phantom_small", 80, loop="python")
case("Palpate-v0 phantom_small random, memory", play_random, "Palpate-v0", "phantom_small", 40, memory=True)
case(
    "Palpate-v0 phantom random, memory, level hard",
    *(play_random, "Palpate-v0", "phantom", 30),
    memory=True,
    level="hard",
    slow=True,
)
case("Palpate-v0 phantom_small oracle, level standard", play_oracle, "Palpate-v0", "phantom_small", level="standard")
case("Palpate-v0 phantom random, psm_palpator", play_random, "Palpate-v0", "phantom", 30, instrument="psm_palpator")
case(
    "Palpate-v0 phantom oracle, psm_palpator",
    play_oracle,
    "Palpate-v0",
    "phantom",
    instrument="psm_palpator",
    slow=True,
)
for _scene in ("phantom_small", "phantom", "liver"):
    # Maps of healthy stiffness take long: that of the liver a minute after each change of the kernels.
    _slow = _scene != "phantom_small"
    case(f"PalpateSites-v0 {_scene} random", play_random, "PalpateSites-v0", _scene, 10, budget=8, slow=_slow)
    case(f"PalpateSites-v0 {_scene} greedy", play_greedy, _scene, 10, slow=_slow)
case(
    "PalpateSites-v0 phantom_small random, no memory", play_random, "PalpateSites-v0", "phantom_small", 8, memory=False
)
case("PalpateSites-v0 phantom_small greedy, level hard", play_greedy, "phantom_small", 10, level="hard")
case(
    "PalpateSites-v0 phantom_small random, level easy", play_random, "PalpateSites-v0", "phantom_small", 5, level="easy"
)
case(
    "PalpateSites-v0 phantom random, psm_palpator",
    *(play_random, "PalpateSites-v0", "phantom", 3),
    instrument="psm_palpator",
    slow=True,
)
case("Retract-v0 lobe random", play_random, "Retract-v0", "lobe", 40)
case("Retract-v0 lobe random, plain loop", play_random, "Retract-v0", "lobe", 40, loop="python", slow=True)
case(
    "Retract-v0 lobe random, psm_retractor",
    play_random,
    "Retract-v0",
    "lobe",
    40,
    instrument="psm_retractor",
    slow=True,
)
case("Retract-v0 lobe oracle", play_oracle, "Retract-v0", "lobe", slow=True)
case("Retract-v0 lobe oracle, psm_retractor", play_oracle, "Retract-v0", "lobe", instrument="psm_retractor", slow=True)
case("BimanualRetract-v0 lobe random", play_random, "BimanualRetract-v0", "lobe", 40)
case("BimanualRetract-v0 lobe oracle, first steps", play_oracle, "BimanualRetract-v0", "lobe", 4, slow=True)
case("BimanualRetract-v0 lobe oracle", play_oracle, "BimanualRetract-v0", "lobe", slow=True)

case("Palpate-v0 phantom vector", play_vector, "Palpate-v0", "phantom", 30, slow=True)
case(
    "Palpate-v0 phantom_small vector, SameStep",
    play_vector,
    "Palpate-v0",
    "phantom_small",
    60,
    autoreset_mode="SameStep",
)
case("Palpate-v0 phantom_small vector, float32", play_vector, "Palpate-v0", "phantom_small", 60, dtype="float32")
case(
    "Palpate-v0 phantom_small vector, memory, level standard",
    *(play_vector, "Palpate-v0", "phantom_small", 30),
    memory=True,
    level="standard",
)
case(
    "Palpate-v0 phantom vector, psm_palpator",
    play_vector,
    "Palpate-v0",
    "phantom",
    12,
    instrument="psm_palpator",
    slow=True,
)
case("Palpate-v0 liver vector", play_vector, "Palpate-v0", "liver", 12, slow=True)
case("PalpateSites-v0 phantom_small vector", play_vector, "PalpateSites-v0", "phantom_small", 7, budget=4)
case(
    "PalpateSites-v0 phantom vector, SameStep, float32",
    *(play_vector, "PalpateSites-v0", "phantom", 4),
    budget=3,
    autoreset_mode="SameStep",
    dtype="float32",
    slow=True,
)
case("Retract-v0 lobe vector", play_vector, "Retract-v0", "lobe", 32, max_episode_steps=29, slow=True)
case(
    "Retract-v0 lobe vector, psm_retractor",
    play_vector,
    "Retract-v0",
    "lobe",
    25,
    instrument="psm_retractor",
    slow=True,
)
# It alone compiles float32 for rest shapes of their own.
case("Retract-v0 lobe vector, float32", play_vector, "Retract-v0", "lobe", 25, dtype="float32", slow=True)

for _id, _scene in (
    ("Palpate-v0", "phantom"), ("Palpate-v0", "phantom_small"), ("Palpate-v0", "liver"), ("Retract-v0", "lobe")
):  # fmt: skip
    case(f"organ of {_scene}", scene_organ, _id, _scene)
case("organ of phantom, level hard", scene_organ, "Palpate-v0", "phantom", level="hard")
case("organ, block", block_organ)
case("organ, hanging block", heavy_block)
case("meshes", meshes)
case("surgsim palpate phantom_small", scan, "phantom_small", "0.02,0.02,0.02,0.012", slow=True)
case("surgsim palpate liver", scan, "liver", "-0.07,-0.02,0.04,0.02", slow=True)


# ---- hashes ----------------------------------------------------------------------------------------------------------


def family() -> str:
    """What decides how numbers are rounded: instruction set, kernels of OpenBLAS, versions of compilers and libraries.

    OpenBLAS picks its kernels by the processor: on one machine those of Haswell and of SkylakeX give other bits of a
    stable step. The number of its threads makes no difference.
    """
    features = get_host_cpu_features()
    if platform.machine().lower() in ("x86_64", "amd64"):
        vectors = next((name for name in ("avx512f", "avx2", "avx") if features.get(name)), "sse2")
        vectors += "+fma" if features.get("fma") else ""
    else:
        vectors = "sve" if features.get("sve") else "neon"
    blas = {str(library["architecture"]) for library in threadpool_info() if library.get("internal_api") == "openblas"}
    python = ".".join(platform.python_version_tuple()[:2])
    versions = [f"{name} {'.'.join(version(name).split('.')[:2])}" for name in ("numpy", "scipy", "numba", "mujoco")]
    machine = [platform.system(), platform.machine(), vectors, "+".join(sorted(blas)) or "another BLAS"]
    return ", ".join([*machine, f"python {python}", *versions])


def hashes(parts: Parts) -> dict[str, str]:
    """A hash for each part of what a case gave."""
    return {
        name: hashlib.blake2b("\n".join(lines(value)).encode(), digest_size=6).hexdigest()
        for name, value in parts.items()
    }


def recorded() -> dict[str, dict[str, dict[str, str]]]:
    return json.loads(HASHES.read_text()) if HASHES.exists() else {}


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in CASES])
def test_numbers_are_what_they_were(name: str):
    everything = recorded()
    assert any(name in one for one in everything.values()), f"{name!r} was recorded nowhere: {RECORD} {name!r}"
    known = everything.get(family(), {})
    if name not in known:
        pytest.skip(f"no hash of {name!r} for machines like this one ({family()}); to record it: {RECORD} {name!r}")
    found = hashes(CASES[name]())
    changed = sorted(part for part in found.keys() | known[name].keys() if found.get(part) != known[name].get(part))
    assert not changed, (
        f"{name}: changed: {', '.join(changed)}. To see what: python -m tests.test_unchanged --print {name!r}, here "
        "and at the commit before"
    )


@pytest.mark.parametrize("name", ["Palpate-v0 phantom_small random", "Retract-v0 lobe random"])
def test_plain_and_compiled_loop_gave_the_same(name: str):
    both = [known for known in recorded().values() if name in known and f"{name}, plain loop" in known]
    assert both
    for known in both:
        assert known[f"{name}, plain loop"] == known[name]


def test_hashes_see_one_bit():
    one = {"info": [{"force_peak": 0.1, "sim_fault": "", "hard_limit": False}], "state": [np.arange(40.0)]}
    other = {
        "info": [{"force_peak": np.nextafter(0.1, 1.0), "sim_fault": "", "hard_limit": False}],
        "state": one["state"],
    }
    third = {"info": one["info"], "state": [np.arange(40.0)]}
    third["state"][0].view(np.uint64)[7] ^= 1
    a, b, c = hashes(one), hashes(other), hashes(third)
    assert a["info"] != b["info"] and a["state"] == b["state"]
    assert a["state"] != c["state"] and a["info"] == c["info"]


def record(names: list[str]) -> None:
    """Write the hashes of this machine's family: all of them, or those of named cases."""
    everything = recorded()
    own = dict(everything.get(family(), {}))
    for name in names or list(CASES):
        new = hashes(CASES[name]())
        same = "new" if name not in own else "as before" if own[name] == new else "CHANGED"
        print(f"{same:>10}  {name}", flush=True)
        own[name] = new
    everything[family()] = {name: own[name] for name in CASES if name in own}
    rows = []
    for machine in sorted(everything):
        cases = ",\n".join(
            f"    {json.dumps(name)}: {json.dumps(value)}" for name, value in everything[machine].items()
        )
        rows.append(f"  {json.dumps(machine)}: {{\n{cases}\n  }}")
    HASHES.write_text("{\n" + ",\n".join(rows) + "\n}\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--record", nargs="*", metavar="CASE", help="record this machine's family; all cases by default"
    )
    parser.add_argument("--print", choices=list(CASES), metavar="CASE", help="print all that is hashed of a case")
    chosen = parser.parse_args()
    if chosen.print:
        for part, value in CASES[chosen.print]().items():
            print("\n".join(lines(value, part)))
    elif chosen.record is not None:
        if unknown := [name for name in chosen.record if name not in CASES]:
            parser.error(f"unknown: {', '.join(unknown)}; the cases are:\n" + "\n".join(CASES))
        record(chosen.record)
    else:
        parser.print_help()
