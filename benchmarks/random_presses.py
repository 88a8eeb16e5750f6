"""Random presses on a scene with stiffening tissue, beside the same presses on its linear tissue.

    python benchmarks/random_presses.py --scene liver --material pig_liver_ex_vivo --substeps 1000000

Each press goes to a random point of the palpable face, in a direction up to 30 degrees from its normal, at a random
speed, until a random force or depth, then slides along the surface and withdraws. Where the stiffening organ ends in a
fault, the linear organ repeats the press up to the force at which the fault occurred: a fault that it does not have is
the law's own.
Prints `name value unit` lines and one line for each fault; the exit status is 1 if the law has one of its own.
"""

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.random import Generator
from tqdm import tqdm

from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.stability import stable_dt
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import make_material, make_scene
from surgsim_env.scene.model import substeps_needed
from surgsim_env.scene.palpable_surface import find_palpable_face, tangent_axes

CLEARANCE = 1e-3  # [m]
TILT_MOST = np.radians(30.0)
SPEEDS = (0.005, 0.1)  # [m/s], logarithmic
DEPTH_MOST = 0.02  # [m]
SLIDE_STEPS = 200


@dataclass(frozen=True)
class RandomPress:
    """What one press does.

    Args:
        start: tip above the surface [m] (3,).
        inward, along: unit directions of the press and of the slide (3,).
        speed: [m/s].
        force: at which the way in ends [N].
    """

    start: FloatArray
    inward: FloatArray
    along: FloatArray
    speed: float
    force: float


def draw(rng: Generator, anatomy: Anatomy, force_most: float) -> RandomPress:
    """Draw a press on the palpable face of a scene."""
    scene = anatomy.scene
    face = find_palpable_face(anatomy.mesh, scene.instrument.approach, scene.palpation, scene.instrument.tip_radius)
    point, normal = face.random_point(rng, 0.0)
    u, v = tangent_axes(normal)
    turn, tilt = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, TILT_MOST)
    along = np.cos(turn) * u + np.sin(turn) * v
    return RandomPress(
        start=point + normal * (scene.instrument.tip_radius + CLEARANCE),
        inward=-np.cos(tilt) * normal + np.sin(tilt) * along,
        along=along,
        speed=float(np.exp(rng.uniform(*np.log(SPEEDS)))),
        force=float(rng.uniform(0.1, 1.0) * force_most),
    )


def execute(simulation: Simulation, press: RandomPress, force: float) -> tuple[int, float]:
    """Press until a force [N] or DEPTH_MOST, slide and withdraw; haptic steps and the largest force [N]."""
    simulation.restart(press.start)
    inward = round((CLEARANCE + DEPTH_MOST) / (press.speed * simulation.haptic_dt))
    back = round(0.5 * DEPTH_MOST / (SPEEDS[1] * simulation.haptic_dt))
    count, largest = 0, 0.0
    for velocity, steps in (
        (press.speed * press.inward, inward),
        (min(press.speed, 0.02) * press.along, SLIDE_STEPS),
        (-SPEEDS[1] * press.inward, back),
    ):
        simulation.instrument.command_velocity(velocity)
        largest = max(largest, simulation.control_step(steps, force))
        count += steps
        if simulation.fault:
            break
        simulation.end_control_step()
    return round(simulation.time / simulation.haptic_dt), largest


def main() -> None:
    """Press and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="liver", help="a scene's name or file")
    parser.add_argument("--material", help="of the library, in place of the scene's own stiffening and relaxation")
    parser.add_argument("--substeps", type=int, default=1_000_000)
    parser.add_argument("--force", type=float, help="largest force [N]; the scene's hard limit by default")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    scene = make_scene(Path(arguments.scene) if arguments.scene.endswith(".toml") else arguments.scene)
    if arguments.material:
        law = make_material(arguments.material).material
        scene = replace(scene, material=replace(scene.material, stiffening=law.stiffening, relaxation=law.relaxation))
        limit = stable_dt(load_anatomy(scene).organ(), scene.contact.law)
        count = max(scene.timing.substep_count, substeps_needed(scene.timing.haptic_step, limit))
        scene = replace(scene, timing=replace(scene.timing, substep_count=count))
    plain = replace(scene, material=replace(scene.material, stiffening=None, relaxation=None))
    measured, linear = Simulation(load_anatomy(scene)), Simulation(load_anatomy(plain))
    force_most = arguments.force or scene.limits.hard_force
    rng = np.random.default_rng(arguments.seed)
    substeps = presses = faults = own = 0
    peaks: list[float] = []
    with tqdm(total=arguments.substeps, unit="substep", mininterval=2.0) as bar:
        while substeps < arguments.substeps:
            press = draw(rng, measured.anatomy, force_most)
            steps, peak = execute(measured, press, press.force)
            presses += 1
            peaks.append(peak)
            substeps += steps * measured.substep_count
            bar.update(steps * measured.substep_count)
            if measured.fault:
                faults += 1
                _, reached = execute(linear, press, peak)
                mine = not linear.fault
                own += mine
                print(
                    f"press {presses} at {1e3 * press.speed:.0f} mm/s, {peak:.3f} N: {measured.fault}; linear tissue: "
                    f"{linear.fault or f'no fault up to {reached:.3f} N'}",
                    flush=True,
                )
    print(f"substeps_in_haptic_step {measured.substep_count} 1\npresses {presses} 1\nsubsteps {substeps} 1")
    print(f"force_peak/median {np.median(peaks):.3f} N")
    print(f"force_peak/largest {max(peaks):.3f} N\nfaults {faults} 1\nfaults/own {own} 1")
    sys.exit(1 if own else 0)


if __name__ == "__main__":
    main()
