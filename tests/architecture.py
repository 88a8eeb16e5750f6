"""The import graph of the project, read from the source; `python -m tests.architecture --graph` prints it.

A room is a first-level folder or a loose file of `surgsim_env`, or one of `msdm_core`, `agents`, `benchmarks` and
`scenes`. Every import counts: at the top of a file, inside a function, under TYPE_CHECKING.
"""

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("msdm_core", "surgsim_env", "agents", "benchmarks", "scenes")

# From the ground up: each imports only what stands before it. The package's own file registers the ids of the
# environments and offers the public names; the rooms of the package never import it.
ORDER = {
    "surgsim_env": (
        *("reports", "scene", "instruments", "coupling", "haptics", "palpation", "tasks", "identify", "validation"),
        *("rendering", "patient", "envs", "live", "scripting", "training", "scoring", "bench", "arm_study", "cli"),
        "__init__",
    ),
    "msdm_core": (
        *(
            "errors",
            "numba_cache",
            "kernels",
            "arithmetic",
            "mesh",
            "mesh_files",
            "material",
            "meshing",
            "organ",
            "lanes",
            "cuda",
        ),
        "__init__",
    ),
    # One script each.
    "agents": (
        *("__init__", "record_faces", "learn_from_scratch"),
        *("learn_palpate_organs", "learn_retract", "learn_sites"),
        *(
            "envhub",
            "lerobot_dataset",
            "record_demonstrations",
            "behaviour_cloning",
            "train_rllib",
            "leaderboard",
        ),
    ),
    "": ("msdm_core", "surgsim_env", "scenes", "agents", "benchmarks"),
}
MOST_ROOMS = 24


def module_files() -> dict[str, Path]:
    """Every module of the packages by its dotted name; a package's `__init__` has a name of its own."""
    return {
        ".".join(path.relative_to(REPOSITORY).with_suffix("").parts): path
        for package in PACKAGES
        for path in sorted((REPOSITORY / package).rglob("*.py"))
        if "__pycache__" not in path.parts
    }


@cache
def file_imports() -> dict[str, set[str]]:
    """For each module, the modules of the project that it imports, at whatever place."""
    files = module_files()
    return {
        module: set(imported_modules(path.read_text(encoding="utf-8"), files)) - {module}
        for module, path in files.items()
    }


def imported_modules(text: str, files: dict[str, Path]) -> Iterator[str]:
    """The modules among `files` that a source text imports; `from package import name` may mean either."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            for candidate in (name, f"{name}.__init__", parent(name), f"{parent(name)}.__init__"):
                if candidate in files:
                    yield candidate
                    break


def parent(module: str) -> str:
    """The dotted name without its last part."""
    return module.rpartition(".")[0]


def room(module: str, package: str) -> str:
    """The room of a module within `package`, or its package where `package` is empty."""
    return module.split(".")[1 if package else 0]


def room_imports(package: str) -> dict[str, set[str]]:
    """For each room of a package (of all packages where it is empty), the other rooms that it imports."""
    rooms: dict[str, set[str]] = defaultdict(set)
    for module, imports in file_imports().items():
        if package and not module.startswith(f"{package}."):
            continue
        inside = (name for name in imports if not package or name.startswith(f"{package}."))
        own = room(module, package)
        rooms[own] |= {room(name, package) for name in inside} - {own}
    return dict(rooms)


def against_order(package: str) -> list[str]:
    """Imports that go against ORDER, and rooms that it does not list, one sentence each."""
    rank = {name: place for place, name in enumerate(ORDER[package])}
    faults = [
        f"{package or 'the repository'}: ORDER does not list {name}"
        for name in room_imports(package)
        if name not in rank
    ]
    for module, imports in sorted(file_imports().items()):
        for name in sorted(imports):
            if package and not (module.startswith(f"{package}.") and name.startswith(f"{package}.")):
                continue
            own, other = room(module, package), room(name, package)
            if rank.get(other, -1) > rank.get(own, len(rank)):
                faults.append(f"{module} imports {name}, but {own} stands before {other}")
    return faults


def cycles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of two or more nodes that import each other in a circle (strongly connected components, Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph.get(node, ()):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = []
            while not group or group[-1] != node:
                group.append(stack.pop())
            if len(group) > 1:
                found.append(sorted(group))

    for node in graph:
        if node not in index:
            visit(node)
    return found


def rooms() -> list[str]:
    """All rooms of the project."""
    return sorted(room_imports("surgsim_env")) + [name for name in PACKAGES if name != "surgsim_env"]


def main() -> None:
    """Print the rooms of both packages with what they import, the cycles, and the counts."""
    if "--graph" not in sys.argv[1:]:
        sys.exit("usage: python -m tests.architecture --graph")
    for package in ("", "msdm_core", "surgsim_env", "agents"):
        graph = room_imports(package)
        print(f"{package or 'repository'}:")
        for name in (*(item for item in ORDER[package] if item in graph), *sorted(set(graph) - set(ORDER[package]))):
            print(f"  {name:12} <- {', '.join(item for item in ORDER[package] if item in graph[name]) or '-'}")
        for fault in against_order(package):
            print(f"  against the order: {fault}")
    files = file_imports()
    print(f"{len(rooms())} rooms (at most {MOST_ROOMS}), {len(files)} files, {sum(map(len, files.values()))} imports")
    for group in cycles(files):
        print("cycle of files:", ", ".join(group))
    if not cycles(files):
        print("no cycle between files")


if __name__ == "__main__":
    main()
