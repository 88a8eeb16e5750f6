"""Search the ports of two arms on several organs, beside given ports and random placements.

    python benchmarks/port_search.py liver_family kidney_family kidney/organ.toml --left psm_grasper --right six_axis

A family gives its first `--members` of the test split. Shares are of the points that both arms reach at once: `given`,
`random` (the best of 500 random placements) and `found` (each seed) by the search's quick reach at 48 points; in the
last two columns given and found (the first seed) by the evaluation at 200 points.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

from surgsim_apps.arms.clearance import Obstacles
from surgsim_apps.arms.port_search import BOUNDS, PortSearch, on_one_wall
from surgsim_apps.arms.ports import default_ports
from surgsim_apps.arms.quick_reach import QuickReach
from surgsim_apps.arms.study import ArmSetup, evaluate_arms, find_sites, make_tables
from surgsim_env.scene import Anatomy, family_of, load_anatomy, make_scene, read_description
from surgsim_env.step_progress import StepProgress

RANDOM, AT_ONCE, EXACT_POINTS, SEARCH_POINTS = 500, 25, 200, 48


def organs(scene: str, members: int) -> Iterator[tuple[str, Anatomy]]:
    """Names and anatomies: a scene's organ, or members of its family's test split."""
    anatomy = load_anatomy(make_scene(scene))
    family = family_of(anatomy, "test") if anatomy.scene.family is not None else None
    if family is None:
        yield anatomy.scene.name, anatomy
        return
    for number in range(members):
        yield f"{anatomy.scene.name} {number}", family.member(number)


def best_random(search: PortSearch, seed: int) -> float:
    """Greatest share of RANDOM random placements that keep the search's rules."""
    rng, best, count = np.random.default_rng(seed), 0.0, 0
    low, high = np.transpose(BOUNDS * 2)
    while count < RANDOM:
        drawn = (search.placed(rng.uniform(low, high)) for _ in range(4 * AT_ONCE))
        ports = [each for each in drawn if each is not None][: min(AT_ONCE, RANDOM - count)]
        if ports:
            best, count = max(best, float(search.quick.evaluate(ports).share.max())), count + len(ports)
    return best


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--left", default="psm_grasper")
    parser.add_argument("--right", default="six_axis")
    parser.add_argument("--members", type=int, default=2)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=300.0, help="of each search, at most")
    options = parser.parse_args()
    console = Console()
    shown = Table("organ", "given", "random", "found", "seconds", "given, exact", "found, exact")
    for scene in options.scenes:
        for name, anatomy in organs(scene, options.members):
            given = on_one_wall(default_ports(anatomy))
            left, right = (read_description(arm) for arm in (options.left, options.right))
            setup = ArmSetup(name, "", left, right, given)
            choices = make_tables(setup, anatomy.scene.instrument.tip_radius, shifted=True)
            tables = {side: row[0] for side, row in choices.items()}
            sites = find_sites(anatomy, given, SEARCH_POINTS, 0)
            quick = QuickReach(anatomy, tables, Obstacles.of(anatomy, given), sites)
            search = PortSearch(anatomy, quick, given, choices)
            began = time.monotonic()
            found = [search.run(options.seconds, seed, StepProgress()) for seed in range(options.seeds)]
            taken = (time.monotonic() - began) / options.seeds
            search.quick.tables = tables
            setups = setup, replace(setup, ports=found[0].best.ports, **found[0].arms)
            exact = [
                evaluate_arms(anatomy, each.left, each.right, each.ports, faced=given, count=EXACT_POINTS).both.mean()
                for each in setups
            ]
            shares = [f"{100 * each.best.share:.0f}" for each in found]
            shown.add_row(
                name, f"{100 * found[0].given.share:.0f}", f"{100 * best_random(search, 99):.0f}", ", ".join(shares),
                f"{taken:.0f}", *(f"{100 * share:.0f}" for share in exact),
            )  # fmt: skip
            console.print(shown)


if __name__ == "__main__":
    sys.exit(main())
