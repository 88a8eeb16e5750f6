"""The rules that the layout rests on, read from the source (ast) and from fresh interpreters.

Each rule is a function from one source file to the sentences that break it. It is applied to every file of both
packages, and to planted violations, so that a rule which catches nothing is noticed.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from msdm_core import numba_cache

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("msdm_core", "surgsim_env")

# numba's disk cache does not see edits in other files: what is compiled, the structures and the constants it reads
# stand in these, whose text names the cache's folder (`numba_cache.kernel_cache`); they import nothing else of ours.
KERNEL_FILES = tuple(
    path.relative_to(REPOSITORY).as_posix()
    for package in PACKAGES
    for name in numba_cache.KERNEL_FILES
    for path in sorted((REPOSITORY / package).glob(name))
)
KERNEL_IMPORTS = {"math", "typing", "collections", "operator", "numpy", "numba", "llvmlite"}
# May import numba, though nothing in it is compiled.
NUMBA_SETTINGS = ("msdm_core/numba_cache.py",)

LINES_PER_FILE = 400
LINES_PER_FUNCTION = 80
# What may be longer, how long, and why.
LONGER_FILES: dict[str, int] = {}
# One contact law, unrolled: calls cost there.
LONGER_FUNCTIONS = {"msdm_core/contact_kernels.py:add_contact_forces": 150}

# What runs scripts: commands, and what a report has run.
EPISODE_RUNNERS = {"surgsim_env/evaluation/episodes.py"}
SCRIPT_USERS = {"surgsim_env/cli.py"} | EPISODE_RUNNERS

EMPTY_NAMES = {"util", "utils", "helper", "helpers", "manager", "managers", "misc", "common"}
ADVANCING = re.compile(r"mj_step\w*|step|haptic_step|control_step|compiled_steps|begin_step|end_step|advance\w*")
JIT = {"jit", "njit", "vectorize", "guvectorize", "cfunc", "stencil", "generated_jit"}
ALLOCATING = {
    *("array", "asarray", "ascontiguousarray", "zeros", "ones", "empty", "full", "arange", "linspace", "eye"),
    *("zeros_like", "ones_like", "empty_like", "full_like", "copy", "concatenate", "stack", "vstack", "hstack"),
    *("column_stack", "cross", "outer", "append", "repeat", "tile", "where", "nonzero", "unique", "astype", "flatten"),
}
HEAVY = {
    "PIL",
    "SimpleITK",
    "matplotlib",
    "meshio",
    "minari",
    "nibabel",
    "pettingzoo",
    "pydicom",
    "pytetwild",
    "pyvista",
    "ray",
    "sb3_contrib",
    "skfem",
    "skimage",
    "sklearn",
    "stable_baselines3",
    "torch",
    "trimesh",
    "tyro",
    "viser",
}


class Source(NamedTuple):
    path: str  # from the repository's root, with slashes
    text: str

    @property
    def tree(self) -> ast.Module:
        return ast.parse(self.text, self.path)

    @property
    def functions(self) -> list[ast.FunctionDef]:
        return [node for node in ast.walk(self.tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def sources() -> list[Source]:
    paths = [path for package in PACKAGES for path in sorted((REPOSITORY / package).rglob("*.py"))]
    return [Source(path.relative_to(REPOSITORY).as_posix(), path.read_text(encoding="utf-8")) for path in paths]


def imported(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Full name and line of every absolute import, also inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield ("." * node.level + (node.module or ""), node.lineno)


def last_name(node: ast.expr) -> str:
    """`njit` of `njit`, `numba.njit` and `numba.njit(cache=True)`."""
    if isinstance(node, ast.Call):
        return last_name(node.func)
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


# ---- the rules --------------------------------------------------------------------------------------------------


def core_stands_alone(source: Source) -> Iterator[str]:
    """msdm_core knows neither MuJoCo nor Gymnasium nor the environments."""
    if source.path.startswith("msdm_core/"):
        for name, line in imported(source.tree):
            if name.split(".")[0] in {"mujoco", "gymnasium", "surgsim_env"}:
                yield f"line {line} imports {name}"


def absolute_imports(source: Source) -> Iterator[str]:
    """Imports name their module in full."""
    yield from (f"line {line} imports {name}" for name, line in imported(source.tree) if name.startswith("."))


def compiled_code_in_kernels(source: Source) -> Iterator[str]:
    """Only kernels files import numba and compile."""
    if source.path in KERNEL_FILES:
        return
    for name, line in imported(source.tree):
        if name.split(".")[0] == "numba" and source.path not in NUMBA_SETTINGS:
            yield f"line {line} imports {name}; compiled functions stand in {', '.join(KERNEL_FILES)}"
    for node in ast.walk(source.tree):
        if isinstance(node, ast.Call | ast.Attribute | ast.Name) and last_name(node) in JIT:
            yield f"line {node.lineno} compiles with {last_name(node)}"


def kernel_modules() -> list[str]:
    return [path.removesuffix(".py").replace("/", ".") for path in KERNEL_FILES]


def kernels_import_little(source: Source) -> Iterator[str]:
    """A kernels file imports KERNEL_IMPORTS and other kernels files, nothing whose change the cache would not see."""
    if source.path in KERNEL_FILES:
        for name, line in imported(source.tree):
            # `from module import name` is listed by the module's name and with the name added.
            ours = any(name == file or name.startswith(f"{file}.") for file in kernel_modules())
            if name.split(".")[0] not in KERNEL_IMPORTS and not ours:
                yield f"line {line} imports {name}"


def kernels_allocate_nothing(source: Source) -> Iterator[str]:
    """No arrays, lists or dictionaries are made in a compiled function."""
    if source.path not in KERNEL_FILES:
        return
    for function in source.functions:
        if not any(last_name(item) in JIT for item in function.decorator_list):
            continue
        for node in (item for statement in function.body for item in ast.walk(statement)):
            if isinstance(node, ast.Call) and last_name(node) in ALLOCATING:
                yield f"line {node.lineno}: {function.name} allocates with {last_name(node)}"
            if isinstance(node, ast.List | ast.Dict | ast.Set | ast.ListComp | ast.DictComp | ast.SetComp):
                yield f"line {node.lineno}: {function.name} makes a {type(node).__name__}"


def kernels_repeat_to_the_bit(source: Source) -> Iterator[str]:
    """No fastmath, no threads, no functions whose last bit differs between libraries."""
    for node in ast.walk(source.tree):
        if isinstance(node, ast.keyword) and node.arg == "fastmath":
            if ast.unparse(node.value) != "False":
                yield f"line {node.value.lineno}: fastmath={ast.unparse(node.value)}"
        if isinstance(node, ast.keyword) and node.arg == "parallel" and ast.unparse(node.value) != "False":
            yield f"line {node.value.lineno}: parallel={ast.unparse(node.value)}"
        if source.path in KERNEL_FILES and isinstance(node, ast.Call):
            function = ast.unparse(node.func)
            if re.fullmatch(
                r"(math|np|numpy)\.(exp|expm1|log\w*|a?(sin|cos|tan)h?|atan2|arctan2?|pow|power)", function
            ):
                yield f"line {node.lineno}: {function}"


def tasks_do_not_advance(source: Source) -> Iterator[str]:
    """A task, and what draws, reads the simulation and never advances it."""
    if source.path.startswith(("surgsim_env/tasks/", "surgsim_env/rendering/")):
        for node in ast.walk(source.tree):
            if isinstance(node, ast.Call) and ADVANCING.fullmatch(last_name(node)):
                yield f"line {node.lineno} calls {last_name(node)}"


def arms_know_no_task(source: Source) -> Iterator[str]:
    """An arm is an instrument: it, and what evaluates it at rest, know no task, no environment and no simulation."""
    if source.path in EPISODE_RUNNERS:
        return
    if source.path.startswith(("surgsim_env/arms/", "surgsim_env/evaluation/")):
        for name, line in imported(source.tree):
            if name.split(".")[0] == "gymnasium" or re.match(r"surgsim_env\.(tasks|env|vector_env|simulation)\b", name):
                yield f"line {line} imports {name}"


def haptics_know_no_task(source: Source) -> Iterator[str]:
    """A haptic loop steps a simulation: it knows no task, no environment and no picture."""
    if source.path.startswith("surgsim_env/haptics/"):
        for name, line in imported(source.tree):
            if name.split(".")[0] == "gymnasium" or re.match(
                r"surgsim_env\.(tasks|env|vector_env|surgical_env)\b", name
            ):
                yield f"line {line} imports {name}"


def pictures_are_asked_for(source: Source) -> Iterator[str]:
    """Only environments, the command line and reports draw: the simulation and its tasks do not know how they look."""
    may = (
        *("surgsim_env/rendering/", "surgsim_env/__init__.py", "surgsim_env/surgical_env.py", "surgsim_env/cli.py"),
        *("surgsim_env/evaluation/arms.py", "surgsim_env/evaluation/arm_pictures.py"),
        *("surgsim_env/scripting/retract_command.py", "surgsim_env/evaluation/episodes.py", "surgsim_env/live/"),
    )
    if not source.path.startswith(may):
        for name, line in imported(source.tree):
            if name.startswith("surgsim_env.rendering"):
                yield f"line {line} imports {name}"


def patients_know_no_environment(source: Source) -> Iterator[str]:
    """What makes an organ of a scan writes a scene; it knows no task, no environment and no simulation."""
    if source.path.startswith("surgsim_env/patient/"):
        for name, line in imported(source.tree):
            if name.split(".")[0] in {"gymnasium", "mujoco"} or re.match(
                r"surgsim_env\.(tasks|env|vector_env|simulation|rendering)\b", name
            ):
                yield f"line {line} imports {name}"


def scripts_stand_on_top(source: Source) -> Iterator[str]:
    """Scripts run environments; nothing else of the package knows of them but what commands ask for."""
    if not source.path.startswith("surgsim_env/scripting/") and source.path not in SCRIPT_USERS:
        for name, line in imported(source.tree):
            if name.startswith("surgsim_env.scripting"):
                yield f"line {line} imports {name}"


def live_stands_on_top(source: Source) -> Iterator[str]:
    """A live session runs what is below it; nothing but the command line knows of it."""
    if not source.path.startswith("surgsim_env/live/") and source.path != "surgsim_env/cli.py":
        for name, line in imported(source.tree):
            if name.startswith("surgsim_env.live"):
                yield f"line {line} imports {name}"


def short_enough(source: Source) -> Iterator[str]:
    """A file is read at one sitting, a function at one glance."""
    lines, limit = len(source.text.splitlines()), LONGER_FILES.get(source.path, LINES_PER_FILE)
    if lines > limit:
        yield f"{lines} lines, more than {limit}"
    for function in source.functions:
        lines = (function.end_lineno or function.lineno) - function.lineno + 1
        limit = LONGER_FUNCTIONS.get(f"{source.path}:{function.name}", LINES_PER_FUNCTION)
        if lines > limit:
            yield f"{function.name} has {lines} lines, more than {limit}"


def named_for_what_it_does(source: Source) -> Iterator[str]:
    """A module's name says what is in it."""
    for part in Path(source.path).with_suffix("").parts:
        if EMPTY_NAMES & set(part.split("_")):
            yield f"{part} says nothing about what is in it"


RULES: tuple[Callable[[Source], Iterator[str]], ...] = (
    core_stands_alone,
    absolute_imports,
    compiled_code_in_kernels,
    kernels_import_little,
    kernels_allocate_nothing,
    kernels_repeat_to_the_bit,
    tasks_do_not_advance,
    arms_know_no_task,
    haptics_know_no_task,
    pictures_are_asked_for,
    patients_know_no_environment,
    scripts_stand_on_top,
    live_stands_on_top,
    short_enough,
    named_for_what_it_does,
)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_rule(rule):
    broken = [f"{source.path}: {fault}" for source in sources() for fault in rule(source)]
    assert not broken, f"{rule.__doc__}\n" + "\n".join(broken)


def test_exceptions_are_still_needed():
    """A file or function that became short loses its longer limit."""
    by_path = {source.path: source for source in sources()}
    for path in LONGER_FILES:
        assert len(by_path[path].text.splitlines()) > LINES_PER_FILE, path
    for place in LONGER_FUNCTIONS:
        path, name = place.split(":")
        (function,) = (item for item in by_path[path].functions if item.name == name)
        assert (function.end_lineno or 0) - function.lineno + 1 > LINES_PER_FUNCTION, place


HOT = "from numba import njit\nimport numpy as np\n@njit(cache=True)\ndef _move(x):\n    "
PLANTED = [
    (core_stands_alone, "msdm_core/organ.py", "import mujoco"),
    (core_stands_alone, "msdm_core/organ.py", "def late():\n    from gymnasium.spaces import Box"),
    (core_stands_alone, "msdm_core/organ.py", "from surgsim_env.scenes import list_scenes"),
    (absolute_imports, "msdm_core/organ.py", "from .mesh import TetMesh"),
    (compiled_code_in_kernels, "msdm_core/organ.py", "import numba"),
    (compiled_code_in_kernels, "surgsim_env/exchange.py", "from numba import njit"),
    (compiled_code_in_kernels, "msdm_core/numba_cache.py", "import numba\nfast = numba.njit(abs)"),
    (compiled_code_in_kernels, "msdm_core/numba_cache.py", "@numba.njit\ndef f(): pass"),
    (kernels_import_little, "msdm_core/kernels.py", "from msdm_core.mesh import TetMesh"),
    (kernels_import_little, "msdm_core/kernels.py", "import scipy.sparse"),
    (kernels_import_little, "surgsim_env/haptic_kernels.py", "import mujoco"),
    (kernels_import_little, "surgsim_env/haptic_kernels.py", "from surgsim_env.tool_bodies import ToolBodies"),
    (kernels_allocate_nothing, "surgsim_env/haptic_kernels.py", HOT + "return np.zeros(3)"),
    (kernels_allocate_nothing, "msdm_core/kernels.py", HOT + "return np.zeros(3)"),
    (kernels_allocate_nothing, "msdm_core/kernels.py", HOT + "y = x.copy()"),
    (kernels_allocate_nothing, "msdm_core/kernels.py", HOT + "return [x]"),
    (kernels_allocate_nothing, "msdm_core/kernels.py", HOT.replace("_move", "advance") + "return np.empty(3)"),
    (kernels_repeat_to_the_bit, "msdm_core/kernels.py", "@njit(fastmath=True)\ndef f(): pass"),
    (kernels_repeat_to_the_bit, "msdm_core/kernels.py", "f = njit(fastmath={'contract'})(g)"),
    (kernels_repeat_to_the_bit, "msdm_core/kernels.py", "@njit(parallel=True)\ndef f(): pass"),
    (kernels_repeat_to_the_bit, "msdm_core/kernels.py", "def f(x):\n    return math.exp(x)"),
    (kernels_repeat_to_the_bit, "msdm_core/kernels.py", "def f(x):\n    return np.arctan2(x, x)"),
    (tasks_do_not_advance, "surgsim_env/tasks/palpate.py", "def judge(simulation):\n    simulation.haptic_step()"),
    (tasks_do_not_advance, "surgsim_env/tasks/palpate.py", "env.step(action)"),
    (tasks_do_not_advance, "surgsim_env/tasks/palpate.py", "simulation.control_step(50)"),
    (tasks_do_not_advance, "surgsim_env/tasks/palpate.py", "compiled_steps(model, state)"),
    (tasks_do_not_advance, "surgsim_env/tasks/palpate.py", "mujoco.mj_step1(model, data)"),
    (arms_know_no_task, "surgsim_env/arms/arm.py", "from surgsim_env.tasks.palpate import PalpateTask"),
    (arms_know_no_task, "surgsim_env/arms/arm.py", "def late():\n    import gymnasium"),
    (tasks_do_not_advance, "surgsim_env/rendering/stage.py", "mujoco.mj_step(model, data)"),
    (pictures_are_asked_for, "surgsim_env/simulation.py", "from surgsim_env.rendering.renderer import OrganRenderer"),
    (arms_know_no_task, "surgsim_env/evaluation/reach.py", "from surgsim_env.simulation import Simulation"),
    (haptics_know_no_task, "surgsim_env/haptics/loop.py", "from surgsim_env.tasks.palpate import PalpateTask"),
    (haptics_know_no_task, "surgsim_env/haptics/loop.py", "import gymnasium"),
    (patients_know_no_environment, "surgsim_env/patient/report.py", "from surgsim_env.simulation import Simulation"),
    (patients_know_no_environment, "surgsim_env/patient/command.py", "def late():\n    import gymnasium"),
    (scripts_stand_on_top, "surgsim_env/env.py", "from surgsim_env.scripting.run import run_script"),
    (live_stands_on_top, "surgsim_env/haptics/loop.py", "from surgsim_env.live.session import Session"),
    (short_enough, "msdm_core/organ.py", "x = 1\n" * (LINES_PER_FILE + 1)),
    (short_enough, "msdm_core/organ.py", "def f():\n" + "    x = 1\n" * LINES_PER_FUNCTION),
    (named_for_what_it_does, "msdm_core/mesh_utils.py", ""),
    (named_for_what_it_does, "surgsim_env/helpers/__init__.py", ""),
]
ALLOWED = [
    (compiled_code_in_kernels, "msdm_core/kernels.py", HOT + "pass"),
    (compiled_code_in_kernels, "msdm_core/numba_cache.py", "from numba.core import config"),
    (kernels_import_little, "msdm_core/kernels.py", "from numpy.typing import NDArray\nimport math"),
    (kernels_import_little, "msdm_core/kernels.py", "from msdm_core.vector import root"),
    (kernels_import_little, "surgsim_env/haptic_kernels.py", "from msdm_core.kernels import advance_substeps"),
    (kernels_allocate_nothing, "msdm_core/kernels.py", "TABLE = np.array([1.0])"),
    (kernels_repeat_to_the_bit, "msdm_core/kernels.py", "@njit(fastmath=False)\ndef f(x): return math.sqrt(x)"),
    (tasks_do_not_advance, "surgsim_env/env.py", "simulation.haptic_step()"),
    (arms_know_no_task, "surgsim_env/arms/arm.py", "from surgsim_env.environment_words import WORDS"),
    (haptics_know_no_task, "surgsim_env/haptics/loop.py", "from surgsim_env.simulation import Simulation"),
    (pictures_are_asked_for, "surgsim_env/surgical_env.py", "from surgsim_env.rendering.renderer import OrganRenderer"),
    (scripts_stand_on_top, "surgsim_env/scripting/run.py", "from surgsim_env.scripting.trace import Trace"),
    (live_stands_on_top, "surgsim_env/cli.py", "from surgsim_env.live.command import view"),
    (short_enough, "msdm_core/organ.py", "x = 1\n" * LINES_PER_FILE),
    (named_for_what_it_does, "msdm_core/mesh_io.py", ""),
]


@pytest.mark.parametrize(("rule", "path", "text"), PLANTED)
def test_planted_violation_is_caught(rule, path, text):
    assert list(rule(Source(path, text)))


@pytest.mark.parametrize(("rule", "path", "text"), ALLOWED)
def test_allowed_source_passes(rule, path, text):
    assert not list(rule(Source(path, text)))


@pytest.mark.parametrize(
    ("package", "unwanted"), [("msdm_core", HEAVY | {"mujoco", "gymnasium", "surgsim_env"}), ("surgsim_env", HEAVY)]
)
def test_import_stays_light(package, unwanted):
    """In a fresh interpreter, the package brings none of the heavy libraries."""
    code = f"import {package}, sys; print(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    assert package in loaded
    assert not loaded & unwanted
