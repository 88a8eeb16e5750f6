"""Fixed-seed episodes, presses and organs: the same bits on every x86-64 processor, compared with recorded hashes.

What decides an episode uses only operations whose rounding IEEE 754 fixes, in an order that the source fixes
(`msdm_core/arithmetic.py`), so that one record holds for all processors, BLAS kernels, versions of Python and numbers
of threads. MuJoCo's results are its own: they are recorded for each of its minor versions. After a deliberate change,
from the repository's root:

    python -m tests.test_unchanged --record                records all cases anew, for the MuJoCo that is installed
    python -m tests.test_unchanged --print CASE > a.txt    everything that is hashed, to be compared between two commits
"""

import argparse
import atexit
import contextlib
import functools
import hashlib
import io
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from llvmlite.binding import get_host_cpu_features

import msdm_core
import surgsim_env
from surgsim_apps.palpate.contrast_map import contrast_with_neighbours, feel_lesions
from surgsim_apps.scoring.site_search import AGENTS
from surgsim_apps.training.site_agent import site_facts
from surgsim_env.palpation.site_press import scan
from surgsim_env.scene.anatomy import MemberName
from surgsim_env.scene.family import make_member
from surgsim_env.scripting import ScriptError, Trace, oracle_script, run_script
from surgsim_env.tasks.runtime import _kept_value

ROOT = Path(__file__).resolve().parents[1]
HASHES = Path(__file__).with_name("unchanged_hashes.json")
RECORD = "python -m tests.test_unchanged --record"
MUJOCO = "MuJoCo " + ".".join(version("mujoco").split(".")[:2])
NO_MUJOCO = "without MuJoCo"
# Number of threads of lanes in a child process (`VARIATIONS`).
THREADS = "UNCHANGED_THREADS"

# What a case gives: by part (observation, reward, ...) anything that `lines` can write down.
Parts = dict[str, list]

# Where random actions lead: towards the tissue, so that contact, friction and force limits are in play.
PRESS = (0.0, 0.0, -0.3, 0.0)


def lines(value: object, path: str = "") -> Iterator[str]:
    """A value as lines of text with all its bits; names of types and the wording of messages do not enter."""
    if hasattr(value, "_asdict"):
        value = value._asdict()  # type: ignore[union-attr]
    if isinstance(value, Mapping):
        # Success by the name that trainers read.
        for key in sorted(key for key in value if key.removeprefix("_") != "is_success"):
            yield from lines(value[key], f"{path}.{key}")
    elif isinstance(value, np.ndarray) and value.dtype != object and value.dtype.kind != "U" and value.ndim:
        plain = np.ascontiguousarray(value)
        short = " ".join(map(repr, plain.ravel().tolist())) if plain.size <= 400 else "..."
        digest = hashlib.blake2b(plain.tobytes(), digest_size=16).hexdigest()
        yield f"{path} {plain.dtype} {plain.shape} {digest} {short}"
    elif isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim):
        yield f"{path} {len(value)} entries"
        for number, entry in enumerate(value):
            yield from lines(entry, f"{path}[{number}]")
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
        return {key: parsed(entry) for key, entry in value.items()}
    return [parsed(entry) for entry in value] if isinstance(value, list) else value


def tabled(value: Any) -> Any:
    """A kept value as plain JSON: arrays as lists with their types."""
    if isinstance(value, np.ndarray):
        return {"array": value.tolist(), "dtype": str(value.dtype)}
    if isinstance(value, Mapping):
        return {key: tabled(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [tabled(entry) for entry in value]
    return value.item() if isinstance(value, np.generic) else value


def saved(env: gym.Env) -> dict[str, object]:
    """The contents of an environment's saved state but for the mark of what made it, which names classes."""
    with np.load(io.BytesIO(env.unwrapped.save_state()), allow_pickle=False) as archive:  # type: ignore[attr-defined]
        arrays: dict[str, object] = {name: archive[name] for name in archive.files if name != "made_by"}
    task = json.loads(str(arrays["task"]))
    for part in ("sensed", "kept"):
        task[part] = {name: tabled(_kept_value(form)) for name, form in task[part].items()}
    return {
        **arrays,
        "task": parsed(json.dumps(task)),
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
WITHOUT_MUJOCO: set[str] = set()


def case(name: str, play: Callable[..., Parts], *given: object, mujoco: bool = True, **settings: object) -> None:
    assert name not in CASES
    CASES[name] = lambda: play(*given, **settings)
    if not mujoco:
        WITHOUT_MUJOCO.add(name)


@contextlib.contextmanager
def fresh_maps() -> Iterator[None]:
    """An empty folder for maps of healthy stiffness, so that these are pressed anew, once a process."""
    before = os.environ.get("SURGSIM_CACHE")
    os.environ["SURGSIM_CACHE"] = fresh_folder()
    try:
        yield
    finally:
        os.environ.pop("SURGSIM_CACHE")
        if before is not None:
            os.environ["SURGSIM_CACHE"] = before


@functools.cache
def fresh_folder() -> str:
    """An empty folder that lasts as long as the process."""
    folder = tempfile.TemporaryDirectory(prefix="unchanged-")
    atexit.register(folder.cleanup)
    return folder.name


def make(env_id: str, scene: str, **settings: object) -> gym.Env:
    return gym.make(f"SurgSim/{env_id}", scene=scene, scaled=False, **settings)  # type: ignore[arg-type]


def random_actions(env_id: str, space: gym.spaces.Box, count: int) -> np.ndarray:
    """Random actions towards the tissue, shape (count, n) or (count, n_env, n)."""
    size = space.shape[-1]
    scale, shift = np.full(size, 0.5), np.zeros(size)
    if "Palpate" in env_id:
        shift[:] = PRESS
        scale[3] = 1.0  # declares now and then
    elif "Slide" in env_id:
        shift[2] = 0.5  # presses
    else:
        # The jaw nearly closed and towards the free edge.
        scale[1], shift[1], shift[6 if "Bimanual" in env_id else -1] = 0.2, -0.8, -0.5
    spread = np.random.default_rng(7).uniform(-1.0, 1.0, (count, *space.shape)) * scale
    return np.clip(spread + shift, -1.0, 1.0).astype(np.float32)


def play_random(env_id: str, scene: str, steps: int, seed: int = 3, **settings: object) -> Parts:
    """Random actions from a seed; an episode that ends is followed by the next one."""
    env = make(env_id, scene, **settings)
    parts = blank()
    observation, info = env.reset(seed=seed)
    keep(parts, observation, None, None, None, info)
    for action in random_actions(env_id, env.action_space, steps):
        record = env.step(action)
        keep(parts, *record)
        if record[2] or record[3]:
            keep_state(parts, env)
            observation, info = env.reset()
            keep(parts, observation, None, None, None, info)
    keep_state(parts, env)
    env.close()
    return parts


def play_lanes(env_id: str, scene: str, steps: int, seed: int = 3, **settings: object) -> Parts:
    """The same side by side; ends, resets and their infos included."""
    envs = gym.make_vec(
        f"SurgSim/{env_id}",
        num_envs=3,
        vectorization_mode="vector_entry_point",
        scene=scene,
        scaled=False,
        threads=int(os.environ.get(THREADS, "2")),
        **settings,
    )
    parts = blank()
    observation, info = envs.reset(seed=seed)
    keep(parts, observation, None, None, None, info)
    for actions in random_actions(env_id, envs.action_space, steps):
        keep(parts, *envs.step(actions))
    for env in envs.envs:  # type: ignore[attr-defined]
        keep_state(parts, env)
    envs.close()
    return parts


def play_script(env_id: str, scene: str, script_steps: int | None = None, seed: int = 3, **settings: object) -> Parts:
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


def play_search(scene: str, search: str, seed: int = 3, **settings: object) -> Parts:
    """A site search, with the presses of the healthy map and the estimates of lesions."""
    with fresh_maps():
        env = make("PalpateSites-v0", scene, **settings)
    parts = blank()
    observation, info = env.reset(seed=seed)
    keep(parts, observation, None, None, None, info)
    agent, over = AGENTS[search](), False
    agent.reset(np.random.default_rng(seed), site_facts(env))
    while not over:
        observation, *rest = env.step(agent.act(observation))
        keep(parts, observation, *rest)
        over = bool(rest[1] or rest[2])
    keep_state(parts, env)
    env.close()
    return parts


def press_liver() -> Parts:
    """A press of the liver at a place of its palpable face, as `surgsim palpate` does it."""
    anatomy = surgsim_env.load_anatomy(surgsim_env.make_scene("liver"))
    site, normal = anatomy.face.random_point(np.random.default_rng(3), 0.01)
    (pressed,) = scan(anatomy, anatomy.organ(), site[None], normal[None])
    return {"press": [vars(pressed)]}


def organs() -> Parts:
    """Blocks with capsule, lesions and volume term by every rule, set swinging; one settled under gravity."""
    mesh = msdm_core.box_mesh((0.06, 0.05, 0.04), (6, 5, 4))
    tissue = msdm_core.Material(5000.0, 1060.0, 0.45)
    stiff = msdm_core.Material(20000.0, 1100.0, 0.3)
    parts: Parts = {"mesh": [mesh.points, mesh.tets, mesh.boundary_triangles], "organ": [], "motion": []}
    for rule, scheme, capsule in (
        ("lloyd", "barycentric", None),
        ("fitted", "voronoi", msdm_core.Capsule(1.0e6, 2.0e-5)),
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
        state = msdm_core.rest_state(organ)
        free = organ.node_inverse_mass > 0.0
        state.node_velocity[free] = np.random.default_rng(5).uniform(-0.1, 0.1, (int(free.sum()), 3))
        msdm_core.advance(organ, state, dt=0.5 * msdm_core.stable_dt(organ), substep_count=200)
        parts["organ"].append(organ._asdict())
        parts["motion"] += [state.node_position, state.node_velocity]
    hanging = msdm_core.box_mesh((0.03, 0.03, 0.03), (3, 3, 3))
    top = np.flatnonzero(hanging.points[:, 2] > 0.03 - 1e-6)
    material = msdm_core.Material(3000.0, 1060.0, 0.4)
    settled = msdm_core.OrganSpec(hanging, material, anchors=top, gravity=(0.0, 0.0, -9.81))
    parts["motion"].append(msdm_core.rest_state(msdm_core.compile_organ(settled)).node_position)
    return parts


def meshes() -> Parts:
    """Lattices in a closed surface and in a label image, and a member of a family."""
    corners = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]) * 0.04
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    places = (np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), axis=-1) - 11.5) * 0.002
    labels = ((places * places).sum(axis=-1) < 0.0004).astype(np.int64)
    labels[np.square(places - 0.006).sum(axis=-1) < 0.000049] = 2
    names = {1: "organ", 2: "lesion"}
    template = surgsim_env.load_anatomy(surgsim_env.make_scene("liver_family"))
    made = {
        "surface": msdm_core.mesh_surface(corners, faces, cell_size=0.01),
        "labels": msdm_core.mesh_segmentation(labels, (0.002, 0.002, 0.002), cell_size=0.006, region_names=names),
        "member": make_member(template, MemberName("test", 1)).mesh,
    }
    return {
        name: [
            mesh.points,
            mesh.tets,
            mesh.region,
            mesh.volumes,
            mesh.boundary_triangles,
            vars(msdm_core.mesh_quality(mesh)),
        ]
        for name, mesh in made.items()
    }


def maps() -> Parts:
    """Contrast over a fitted baseline, lesions felt on it, and a bell fitted to touches, of made-up stiffness."""
    rng = np.random.default_rng(11)
    plane = np.stack(np.meshgrid(*[np.arange(12) * 0.008] * 2), axis=-1).reshape(-1, 2)
    bell = np.square(plane - (0.04, 0.05)).sum(axis=1) < 0.00015
    stiffness = 300.0 * (1.0 + 0.5 * bell + 2.0 * plane[:, 0]) * rng.uniform(0.97, 1.03, len(plane))
    contrast = contrast_with_neighbours(stiffness, plane, 1.0 / (0.02 + plane[:, :1]))
    sites = np.column_stack([plane, 0.1 * plane[:, 0]])
    felt = [vars(estimate) for estimate in feel_lesions(sites, contrast, spacing=0.008)]
    return {"contrast": [contrast], "lesions": felt}


case("Palpate-v0", play_random, "Palpate-v0", "phantom", 40)
case("PalpateSites-v0, GP-UCB", play_search, "phantom_small", "gp_ucb", level="standard", budget=16)
case("Slide-v0", play_random, "Slide-v0", "phantom_small", 40)
case("Retract-v0", play_random, "Retract-v0", "lobe", 30)
case("BimanualRetract-v0", play_random, "BimanualRetract-v0", "lobe", 25)
case("lanes", play_lanes, "Palpate-v0", "phantom_small", 30, memory=True, level="standard", autoreset_mode="SameStep")
case("lanes, float32", play_lanes, "Palpate-v0", "phantom_small", 30, dtype="float32")
case("liver press", press_liver)
case("retraction, script", play_script, "Retract-v0", "lobe", 3)
case("arm, script", play_script, "Palpate-v0", "phantom_small", instrument="psm_palpator")
case("organs", organs, mujoco=False)
case("meshes", meshes, mujoco=False)
case("maps", maps, mujoco=False)


# ---- hashes ----------------------------------------------------------------------------------------------------------


def hashes(parts: Parts) -> dict[str, str]:
    """A hash for each part of what a case gave."""
    return {
        name: hashlib.blake2b("\n".join(lines(value)).encode(), digest_size=6).hexdigest()
        for name, value in parts.items()
    }


def recorded() -> dict[str, dict[str, str]]:
    """The hashes of each case with the MuJoCo that is installed."""
    record = json.loads(HASHES.read_text())
    return {name: hashed for key in (NO_MUJOCO, MUJOCO) for name, hashed in record.get(key, {}).items()}


def changed(name: str, part_hashes: dict[str, str]) -> list[str]:
    """The parts of a case that differ from the record."""
    known = recorded()
    if name not in known:
        pytest.skip(f"{name!r} is not recorded for {MUJOCO}, whose results are its own: {RECORD}")
    return sorted(
        part for part in part_hashes.keys() | known[name].keys() if part_hashes.get(part) != known[name].get(part)
    )


@pytest.mark.parametrize("name", CASES)
def test_numbers_are_what_they_were(name: str):
    differing = changed(name, hashes(CASES[name]()))
    assert not differing, (
        f"{name}: changed: {', '.join(differing)}. To see what: python -m tests.test_unchanged --print {name!r}, here "
        "and at the commit before"
    )


# ---- variations of the machine ---------------------------------------------------------------------------------------

NO_AVX512 = "X86_V4 AVX512_ICL AVX512_SPR"
# Variables of a child process that stand for another machine, and the features that the processor must have.
VARIATIONS: dict[str, tuple[dict[str, str], tuple[str, ...]]] = {
    # An AVX2 machine without AVX-512 differs from one with it by BLAS and by numpy's loops.
    "AVX2 alone": ({"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": NO_AVX512}, ("avx512f",)),
    "BLAS of Prescott": ({"OPENBLAS_CORETYPE": "Prescott"}, ()),
    "BLAS of SkylakeX": ({"OPENBLAS_CORETYPE": "SkylakeX"}, ("avx512f", "avx512vl")),
    "BLAS of Zen": ({"OPENBLAS_CORETYPE": "Zen"}, ("avx2", "fma")),
    "numpy without AVX2": ({"NPY_DISABLE_CPU_FEATURES": f"X86_V3 {NO_AVX512}"}, ("avx512f",)),
    "one thread": ({THREADS: "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}, ()),
    "two threads": ({THREADS: "2", "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}, ()),
    "kernels for Haswell": ({"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma"}, ("avx2", "fma")),
    "kernels for x86-64-v2": ({"NUMBA_CPU_NAME": "x86-64-v2", "NUMBA_CPU_FEATURES": "+sse4.2"}, ()),
}
# Run by `make test`.
USUAL = "AVX2 alone"


@pytest.mark.skipif(platform.machine().lower() not in ("x86_64", "amd64"), reason="the variables are those of x86-64")
@pytest.mark.parametrize(
    "variation", [pytest.param(name, marks=() if name == USUAL else pytest.mark.slow) for name in VARIATIONS]
)
def test_another_machine_gives_the_same(variation: str, tmp_path: Path):
    variables, needed = VARIATIONS[variation]
    features = get_host_cpu_features()
    if absent := [name for name in needed if not features.get(name)]:
        pytest.skip(f"this processor has no {', '.join(absent)}, which {variation!r} needs")
    # Numba's cache knows no NUMBA_CPU_FEATURES.
    own_cache = {"NUMBA_CACHE_DIR": str(tmp_path)} if "NUMBA_CPU_NAME" in variables else {}
    done = subprocess.run(
        [sys.executable, "-m", "tests.test_unchanged", "--hashes"],
        env={**os.environ, **variables, **own_cache},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=1800,
    )
    assert done.returncode == 0, done.stderr
    case_hashes = json.loads(done.stdout.splitlines()[-1])
    assert set(case_hashes) == set(CASES)
    differing = {name: parts for name, hashed in case_hashes.items() if (parts := changed(name, hashed))}
    assert not differing, f"{variation}: changed: {differing}"


def record() -> None:
    """Write the hashes of all cases."""
    known = json.loads(HASHES.read_text()) if HASHES.exists() else {}
    before = {**known.get(NO_MUJOCO, {}), **known.get(MUJOCO, {})}
    known[NO_MUJOCO], known[MUJOCO] = {}, {}
    for name, play in CASES.items():
        new = hashes(play())
        print(
            f"{'new' if name not in before else 'as before' if before[name] == new else 'CHANGED':>10}  {name}",
            flush=True,
        )
        known[NO_MUJOCO if name in WITHOUT_MUJOCO else MUJOCO][name] = new
    HASHES.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", action="store_true", help="record all cases")
    parser.add_argument("--hashes", action="store_true", help="print the hashes of all cases as one line of JSON")
    parser.add_argument("--print", choices=list(CASES), metavar="CASE", help="print all that is hashed of a case")
    chosen = parser.parse_args()
    if chosen.print:
        for part, value in CASES[chosen.print]().items():
            print("\n".join(lines(value, part)))
    elif chosen.hashes:
        print(json.dumps({name: hashes(play()) for name, play in CASES.items()}))
    elif chosen.record:
        record()
    else:
        parser.print_help()
