"""The same press in this project, in MuJoCo's flex and in Newton: time for a simulated second, and the force."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from statistics import median

from surgsim_apps.bench.measurement import Cells, Effort, spread
from surgsim_apps.bench.peers import EXPLICIT_DAMPING, EXPLICIT_STEPS, Flex, Newton, fastest_within, longest_stable
from surgsim_apps.bench.presses import PLACES, RIGID, Contender, DivergedError, organ_press, reference_force
from surgsim_apps.bench.report import AbsentError, Figure, Section, absent
from surgsim_apps.validation.elements import has_fem

# Flex at its own fastest step stays within this share of its force at 1 ms.
SHARE = 0.02
# Longest repeated round [s].
LONGEST_ROUND = 60.0
NEWTON_STEPS = (5e-4, 2e-4, 1e-4)  # [s] of the explicit solver; the longest stable one is used
METHOD = """One press of a frictionless ball of 8 mm radius, 4 mm deep at 40 mm/s, then 0.1 s of rest, on a block of 60
x 60 x 30 mm, E 5 kPa, nu 0.45, density 1060, bottom held, no gravity; one thread each, same process, in turn in each
round. `wall` and `processor` are seconds per simulated second (1 is real time), medians; `ratio` is processor time
relative to surgsim. A round that takes more than a minute is not repeated. Force is the mean of two places, over a
node in the block's middle and half a cell to the side; `error` is relative to axisymmetric quadratic finite elements
with small strains: {references}. surgsim has friction 0.2, which hardly affects a straight press, and its instrument
in MuJoCo, and reads the force in every haptic step, the others once, at the end. They have nodes on a cubic or nearly
cubic grid, surgsim on a body-centred lattice: numbers of nodes are similar, positions differ."""
WALL, PROCESSOR, RATIO = ("wall", "s/s"), ("processor", "s/s"), ("ratio to surgsim", "1")
FORCE, ERROR = ("force", "N"), ("error", "%")


@dataclass
class Tally:
    """Times and forces of a contender's presses."""

    contender: Contender
    walls: list[float] = field(default_factory=list)
    processors: list[float] = field(default_factory=list)
    forces: dict[float, float] = field(default_factory=dict)
    fault: str = ""
    longest: float = 0.0

    def press(self) -> None:
        """One round: a press at each place."""
        if self.fault or (self.walls and self.longest > LONGEST_ROUND):
            return
        wall = processor = simulated = 0.0
        for place in PLACES:
            try:
                pressed = self.contender.press(place)
            except DivergedError as fault:
                self.fault = f"diverged: {fault}"
                return
            wall, processor = wall + pressed.wall, processor + pressed.processor
            simulated += pressed.simulated
            self.forces[place] = pressed.force
        self.longest = wall
        self.walls.append(wall / simulated)
        self.processors.append(processor / simulated)


def measure(effort: Effort) -> Section:
    """All installed contenders, round by round; the others are listed with the reason."""
    references = "scikit-fem is absent, no error is given"
    if has_fem():
        references = f"{reference_force(organ_press(effort.organ_cells).contact):.4f} N with this project's contact "
        references += f"stiffness, {reference_force(RIGID):.4f} N with a rigid one, for the other simulators"
    section = Section(
        "side_by_side", "Beside MuJoCo flex and Newton", METHOD.format(references=references), closing=LIMITS
    )
    tallies = [Tally(organ_press(effort.organ_cells))]
    for name, make in peers(effort):
        try:
            tallies.append(Tally(make()))
        except (AbsentError, DivergedError) as error:
            section.figures.append(absent(name, *WALL, error))
    for _ in range(effort.press_rounds):
        for tally in tallies:
            tally.press()
    section.figures[:0] = [figure for tally in tallies for figure in _figures(tally, tallies[0])]
    return section


def peers(effort: Effort) -> Iterator[tuple[str, Callable[[], Contender]]]:
    """Name and maker of each peer at each setting; a maker may search for the setting, or find the peer absent."""
    grid = effort.grid
    yield "MuJoCo flex full, discrete 1 ms", Flex(grid).contender
    yield "MuJoCo flex full, discrete, fastest step", lambda: _fastest(grid, effort)
    explicit = (Flex(grid, "Euler", dt, EXPLICIT_DAMPING) for dt in EXPLICIT_STEPS)
    yield "MuJoCo flex full, Euler", lambda: longest_stable(explicit)
    for cells in ((1, 1, 1), (4, 4, 2), (6, 6, 3)):
        yield "MuJoCo flex trilinear " + "x".join(map(str, cells)), Flex(grid, trilinear=cells).contender
    yield "Newton explicit", lambda: longest_stable(Newton(grid, "explicit", dt) for dt in NEWTON_STEPS)
    yield "Newton vbd", Newton(grid, "vbd", 1e-3, damping=0.001).contender


def _fastest(grid: Cells, effort: Effort) -> Contender:
    """Flex at its fastest step with a force near that at 1 ms."""
    base = Flex(grid)
    best, tried = fastest_within(base, base.contender().press(0.0).force, effort.longer_steps, SHARE)
    if best is None:
        raise AbsentError(f"no longer step stays within {100 * SHARE:g} %: {'; '.join(tried)}")
    contender, name = best.contender(), f"MuJoCo flex full, discrete, fastest step, {1e3 * best.dt:g} ms"
    return replace(contender, name=name, setting=f"{contender.setting}; against 1 ms: {', '.join(tried)}")


def _figures(tally: Tally, own: Tally) -> list[Figure]:
    contender = tally.contender
    if tally.fault or not tally.walls:
        return [absent(contender.name, *WALL, f"{tally.fault}; {contender.setting}")]
    processor = median(tally.processors)
    force = sum(tally.forces.values()) / len(tally.forces)
    places = " and ".join(f"{value:.4f}" for value in tally.forces.values())
    note = f"{contender.mesh}; {contender.setting}; force {places} N; processor {spread(tally.processors)} s/s"
    figures = [
        Figure(contender.name, WALL[0], median(tally.walls), WALL[1], note),
        Figure(contender.name, PROCESSOR[0], processor, PROCESSOR[1]),
        Figure(contender.name, FORCE[0], force, FORCE[1]),
    ]
    if own.processors:
        figures.append(Figure(contender.name, RATIO[0], processor / median(own.processors), RATIO[1]))
    if has_fem():
        error = 100.0 * (force / reference_force(contender.contact) - 1.0)
        figures.append(Figure(contender.name, ERROR[0], error, ERROR[1]))
    return figures


# From running the two that are measured (mujoco 4.0.0, newton 1.8.0), from the others' repositories and threads.
LIMITS = """### Features

| simulator | moduli per region | tool force in newtons | Gymnasium environment of a soft organ | source |
|---|---|---|---|---|
| surgsim | per tet: capsule, lesions, tags | wrench on each tool, every 1 ms | yes | this repository |
| MuJoCo flex | no: `young` is one number a flex (elements' stiffness is writable after compilation, \
undocumented) | yes: sum of `mj_contactForce`; none with passive contact | no | run here; XML reference, `elasticity` |
| Newton, explicit | per tet | `body_f` of a body without joints; contact at particles only, not on faces | no \
| run here |
| Newton, vbd | per tet | `contact_f` observable | no | run here; Newton #3052 on deformable contact force |
| Isaac Lab | one a body | no: 0 for rigid-deformable contact, closed as not planned | yes, \
no soft organ in its surgical tasks | IsaacLab #806, #4290 |
| sofa_env (LapGym) | one a body | no: sum of internal forces, scaled by 1e-9 | yes, one simulation a process | \
ScheiklP/sofa_env 85bf7e0 |
| PyBullet soft bodies | one a body | no: the normal force is always 1 | no | bullet3 #4406, #3326, #4333 |
| FF-SRL | one a mesh | no | no, two demonstrations | SanoScience/FF-SRL 1036742 |

Only the first four were run here; the others are described from their code and threads."""
