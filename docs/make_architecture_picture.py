"""Draw the import graph of the three packages: docs/images/architecture.svg.

    python -m docs.make_architecture_picture

Rooms stand on floors: each imports only rooms of lower floors. An arrow that longer ways imply is left out.
"""

from itertools import pairwise
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from tests.architecture import room_imports

IMAGES = Path(__file__).parent / "images"
PACKAGES = {"msdm_core": "#dbe9f6", "surgsim_env": "#dff0dc", "surgsim_apps": "#fbe9d3"}
INK, GREY = "#1f2933", "#7b8794"
# Width and height of a room, and distances between rooms and floors [inches].
WIDTH, HEIGHT, GAP, FLOOR = 1.16, 0.34, 0.18, 0.78


def reachable(graph: dict[str, set[str]], room: str) -> set[str]:
    """All rooms below a room."""
    return {lower for direct in graph[room] for lower in (direct, *reachable(graph, direct))}


def floor_of(graph: dict[str, set[str]], room: str) -> int:
    """Number of rooms on the longest way down."""
    return max((1 + floor_of(graph, lower) for lower in graph[room]), default=0)


def draw_package(axes: Axes, package: str, left: float) -> float:
    """Draw the rooms of a package from a left edge on; returns its right edge."""
    graph = room_imports(package)
    floors: dict[int, list[str]] = {}
    for room in graph:
        floors.setdefault(floor_of(graph, room), []).append(room)
    width = max(len(rooms) * (WIDTH + GAP) for rooms in floors.values()) + GAP
    place = {}
    for floor, rooms in sorted(floors.items()):
        # Rooms stand above the middle of the rooms that they import.
        centres = {room: [place[lower][0] for lower in graph[room]] for room in rooms}
        rooms.sort(key=lambda room: (sum(centres[room]) / max(len(centres[room]), 1), room))
        start = left + (width - len(rooms) * (WIDTH + GAP) + GAP) / 2
        for number, room in enumerate(rooms):
            place[room] = start + number * (WIDTH + GAP) + WIDTH / 2, floor * FLOOR
    top = max(floors) * FLOOR + HEIGHT
    frame = FancyBboxPatch(
        (left, -GAP), width, top + 3.6 * GAP, boxstyle="round,pad=0,rounding_size=0.12", fc=PACKAGES[package], ec="none"
    )
    axes.add_patch(frame)
    axes.text(left + GAP, top + 1.3 * GAP, package, fontsize=12, weight="bold", color=INK)
    for room, lower_rooms in graph.items():
        implied = {below for lower in lower_rooms for below in reachable(graph, lower)}
        for lower in sorted(lower_rooms - implied):
            (x, y), (lower_x, lower_y) = place[room], place[lower]
            ends = (x, y), (lower_x, lower_y + HEIGHT)
            arrow = FancyArrowPatch(
                *ends, arrowstyle="-|>", mutation_scale=8, shrinkA=0, shrinkB=1, color=GREY, lw=0.9, zorder=2
            )
            axes.add_patch(arrow)
    for room, (x, y) in place.items():
        box = FancyBboxPatch(
            (x - WIDTH / 2, y),
            WIDTH,
            HEIGHT,
            boxstyle="round,pad=0,rounding_size=0.06",
            fc="white",
            ec=INK,
            lw=0.9,
            zorder=3,
        )
        axes.add_patch(box)
        axes.text(x, y + HEIGHT / 2, room, ha="center", va="center", fontsize=9, color=INK, zorder=4)
    return left + width


def main() -> None:
    """Draw the packages beside each other, with the arrows between them."""
    figure = Figure()
    axes = figure.subplots()
    edges, right = [], 0.0
    for package in PACKAGES:
        left = right + 0.55 * bool(edges)
        right = draw_package(axes, package, left)
        edges.append((left, right))
    for (_, lower_edge), (upper_edge, _) in pairwise(edges):
        ends = (upper_edge, FLOOR * 2.5), (lower_edge, FLOOR * 2.5)
        axes.add_patch(
            FancyArrowPatch(*ends, arrowstyle="-|>", mutation_scale=18, color=INK, lw=2, shrinkA=2, shrinkB=2)
        )
    axes.set_aspect("equal")
    axes.axis("off")
    axes.autoscale_view()
    (x_low, x_high), (y_low, y_high) = axes.get_xlim(), axes.get_ylim()
    figure.set_size_inches(x_high - x_low, y_high - y_low)
    figure.subplots_adjust(0, 0, 1, 1)
    # Without a date and random ids the file is the same each time.
    with rc_context({"svg.hashsalt": "surgsim"}):
        figure.savefig(IMAGES / "architecture.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
