"""The import graph of the project, read from the source; `python -m tests.architecture --graph` prints it.

The rooms at the top are the packages; the rooms of a package are its folders and loose files. Every import counts: at
the top of a file, inside a function, under TYPE_CHECKING. Applications, agents and benchmarks may import from the
engine (`msdm_core`, `surgsim_env`) only names in the `__all__` of the engine's packages and their rooms.
"""

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("msdm_core", "surgsim_env", "surgsim_apps", "agents", "benchmarks", "scenes")

ENGINE = ("msdm_core", "surgsim_env")
APPLICATIONS = ("surgsim_apps", "agents", "benchmarks")

# From the ground up: each imports only what stands before it. A package's own file offers the public names.
ORDER = {
    "": ("msdm_core", "surgsim_env", "surgsim_apps", "scenes", "agents", "benchmarks"),
    "msdm_core": (
        *("errors", "numba_cache", "kernels", "arithmetic", "mesh", "mesh_files", "material", "meshing", "organ"),
        *("lanes", "__init__"),
    ),
    "surgsim_env": (
        *("step_progress", "scene", "instruments", "coupling", "palpation", "tasks", "rendering", "envs", "scripting"),
        "__init__",
    ),
    "surgsim_apps": (
        *("__init__", "reports", "palpate", "patient", "identify", "validation", "haptics", "live", "training"),
        *("scoring", "bench", "arms", "cli"),
    ),
    # One script each.
    "agents": (
        *("__init__", "record_faces", "learn_palpate_organs", "learn_retract", "learn_sites"),
        "learn_slide",
        *("envhub", "lerobot_dataset", "record_demonstrations", "behaviour_cloning", "leaderboard"),
    ),
}


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
    """For each room of a package (of all packages where it is empty), the other rooms that it imports.

    A package's own file is no room: it offers names of all of them.
    """
    rooms: dict[str, set[str]] = defaultdict(set)
    for module, imports in file_imports().items():
        if package and (not module.startswith(f"{package}.") or module == f"{package}.__init__"):
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
    groups: list[list[str]] = []

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
                groups.append(sorted(group))

    for node in graph:
        if node not in index:
            visit(node)
    return groups


def floors(graph: dict[str, set[str]]) -> int:
    """Number of rooms on the longest way down a graph without cycles."""

    @cache
    def height(name: str) -> int:
        return 1 + max((height(lower) for lower in graph.get(name, ())), default=0)

    return max(map(height, graph))


@cache
def exported_names() -> dict[str, set[str]]:
    """The `__all__` of each engine package and each of its rooms, by dotted name."""
    names = {}
    for module, path in module_files().items():
        package = module.removesuffix(".__init__")
        if package.split(".")[0] in ENGINE and package.count(".") <= 1:
            names[package] = set(declared_names(path.read_text(encoding="utf-8")))
    return names


def declared_names(text: str) -> list[str]:
    """The `__all__` of a source text, empty without one."""
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return ast.literal_eval(node.value)
    return []


def unexported_imports(text: str) -> Iterator[str]:
    """Imports from the engine in a source text, other than of an exported name or of a room as `import ROOM`."""
    exported = exported_names()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in ENGINE:
            for alias in node.names:
                if alias.name not in exported.get(node.module, ()):
                    yield f"{node.module}.{alias.name}"
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] in ENGINE and alias.name not in exported:
                    yield alias.name


def applications_unexported() -> list[str]:
    """Names of the engine that applications import although no room exports them: "module: name"."""
    return [
        f"{module}: {name}"
        for module, path in module_files().items()
        if module.split(".")[0] in APPLICATIONS
        for name in unexported_imports(path.read_text(encoding="utf-8"))
    ]


def main() -> None:
    """Print the rooms of each package with their imports, the counts, the cycles and imports of unexported names."""
    if "--graph" not in sys.argv[1:]:
        sys.exit("usage: python -m tests.architecture --graph")
    for package, order in ORDER.items():
        graph = room_imports(package)
        arrows = sum(map(len, graph.values()))
        print(f"{package or 'top'}: {len(graph)} rooms, {floors(graph)} floors, {arrows} arrows")
        for name in (*(room for room in order if room in graph), *sorted(set(graph) - set(order))):
            print(f"  {name:13} <- {', '.join(room for room in order if room in graph[name]) or '-'}")
        for fault in against_order(package):
            print(f"  against the order: {fault}")
    files, groups, unexported = file_imports(), cycles(file_imports()), applications_unexported()
    print(f"{len(files)} files, {sum(map(len, files.values()))} imports, {len(groups)} cycles between files")
    for group in groups:
        print("  cycle:", ", ".join(group))
    print(f"{len(unexported)} imports of engine names that are not exported, in {', '.join(APPLICATIONS)}")
    for line in unexported:
        print(f"  {line}")


if __name__ == "__main__":
    main()
