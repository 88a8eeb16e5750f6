"""Scripts that know the truth and do each task right: what an environment can be expected to allow."""

from collections.abc import Callable

import gymnasium as gym
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy
from surgsim_env.env import BimanualRetractEnv, PalpateEnv, RetractEnv
from surgsim_env.scripting.bimanual_oracle import bimanual_steps
from surgsim_env.scripting.retract_oracle import retraction_steps
from surgsim_env.scripting.steps import AwaitEnd, Declare, Hold, MoveTo, PressUntil, Step

# The oracle presses with this share of the soft force limit.
GENTLE_SHARE = 0.4
# Between the tip ball and the tissue while it moves sideways, and where a press begins [m].
TRAVEL_GAP = 0.004
# A lobe is carried no farther once enough of the target was seen for so many control steps.
SEEN_STEPS = 5
# Tissue this far beside the ball's way counts as under it [m].
CORRIDOR = 0.004


def oracle_script(env: gym.Env) -> list[Step]:
    """The script that does the task of this episode, from where the environment is now; reset it first.

    Raises:
        ValueError: nothing was reset yet, or no oracle is known for the environment.
    """
    inner = env.unwrapped
    for kind, oracle in ORACLES.items():
        if isinstance(inner, kind):
            return oracle(inner)
    known = ", ".join(kind.__name__ for kind in ORACLES)
    raise ValueError(f"no oracle is known for {type(inner).__name__}; there is one for {known}")


def palpate_oracle(env: PalpateEnv) -> list[Step]:
    """Rise, go over the lesion, press gently along the surface's normal, hold and declare."""
    lesion, simulation = env.task.lesion, env.simulation
    if lesion is None or lesion.centre is None:
        raise ValueError("the oracle looks for the lesion of an episode, and none has begun: call env.reset(seed=...)")
    anatomy = simulation.anatomy
    scene, approach = anatomy.scene, anatomy.face.approach
    site, normal = anatomy.face.project(lesion.centre)
    start = simulation.instrument.tip_position
    above = site + normal * (scene.instrument.tip_radius + TRAVEL_GAP)
    height = _travel_height(anatomy, start, above)
    force = GENTLE_SHARE * scene.limits.soft_force
    return [
        MoveTo(_at_height(start, approach, height), timeout=10.0, name="rise"),
        MoveTo(_at_height(above, approach, height), timeout=20.0, name="go over"),
        MoveTo(tuple(above.tolist()), timeout=10.0, name="come down"),
        PressUntil(force, 2.0 * scene.palpation.press_depth, direction=tuple((-normal).tolist()), name="press"),
        Hold(0.1, name="hold"),
        Declare(name="declare"),
    ]


def retract_oracle(env: RetractEnv) -> list[Step]:
    """Grasp the free edge beside the target, fold the lobe back and wait for success."""
    target = env.task.target
    if target is None:
        raise ValueError("the oracle uncovers the target of an episode, and none has begun: call env.reset(seed=...)")
    return [
        *retraction_steps(
            env.simulation, target.centre, env.task.turning_size, lambda _: env.task.goal_count >= SEEN_STEPS
        ),
        AwaitEnd(10.0, name="keep it open"),
    ]


def bimanual_oracle(env: BimanualRetractEnv) -> list[Step]:
    """Fold the lobe back with the left arm, reach under it with the right one and press on the target."""
    task, radius = env.task, env.simulation.anatomy.scene.instrument.tip_radius
    if task.target is None:
        raise ValueError("the oracle touches the target of an episode, and none has begun: call env.reset(seed=...)")
    return bimanual_steps(env.simulation, task.target.centre, task.turning_size, radius)


# An oracle for each environment.
ORACLES: dict[type, Callable[..., list[Step]]] = {
    PalpateEnv: palpate_oracle,
    RetractEnv: retract_oracle,
    BimanualRetractEnv: bimanual_oracle,
}


def _travel_height(anatomy: Anatomy, start: FloatArray, end: FloatArray) -> float:
    """Height against the approach [m] at which the tip ball passes over all tissue between two places."""
    upward, radius = -anatomy.face.approach, anatomy.scene.instrument.tip_radius
    points = anatomy.mesh.points[anatomy.mesh.boundary_nodes]
    span = _level(end - start, upward)
    level = _level(points - start, upward)
    share = np.clip(level @ span / max(float(span @ span), 1e-12), 0.0, 1.0)
    near = np.linalg.norm(level - share[:, None] * span, axis=1) <= radius + CORRIDOR
    tissue = float((points[near] @ upward).max(initial=-np.inf)) + radius + TRAVEL_GAP
    return max(tissue, float(start @ upward), float(end @ upward))


def _level(vectors: FloatArray, upward: FloatArray) -> FloatArray:
    """Vectors without their share along a unit direction."""
    return vectors - (vectors @ upward)[..., None] * upward


def _at_height(place: FloatArray, approach: FloatArray, height: float) -> tuple[float, float, float]:
    x, y, z = (place - approach * (height + float(place @ approach))).tolist()
    return x, y, z
