"""The script of two arms: the left one folds a lobe back, the right one reaches under it and touches the target."""

from msdm_core.mesh import FloatArray
from surgsim_env.scripting.retract_oracle import retraction_steps
from surgsim_env.scripting.steps import MoveTo, Step
from surgsim_env.scripting.support_steps import PressSupport
from surgsim_env.scripting.wrapped_steps import MayEnd, OfArm
from surgsim_env.simulation import Simulation

# The left jaw grasps so far beside the target, away from the right arm [m].
ASIDE = -0.008
# The edge is folded back by this share of what a retraction may need: the right arm needs room, not the endoscope.
FOLD = 0.66
# A flap is lifted by this share of it: 17 mm. Less leaves the right arm no room beside the jaw.
LIFT = 0.7
# Places of the right tip on its way: before the lobe (from the target in x, from the free edge in y, height), then at
# its mouth (from the target in x and y, height), then over the target (free height) [m].
BEFORE, MOUTH, OVER = (0.010, 0.018, 0.022), (0.002, 0.012, 0.010), 0.0015
# The middle of what the target may be touched with [N].
TOUCH_FORCE = 0.6
REACHING_SPEED = 0.015


def bimanual_steps(simulation: Simulation, target: FloatArray, turning_size: int, tip_radius: float) -> list[Step]:
    """Fold the lobe back beside a target [m] (3,), all the way however much is seen, go under it, press on it.

    Args:
        simulation: at rest, with a pair of arms on the free side, the left jaw open.
        target: on the bed.
        turning_size: entries of an arm's turning.
        tip_radius: of the right tip [m].
    """
    edge = float(simulation.organ_model.node_rest_position[:, 1].max())
    x, y, z = target.tolist()
    over = (x, y, z + tip_radius + OVER)
    right = [
        MoveTo((x + BEFORE[0], edge + BEFORE[1], BEFORE[2]), tolerance=0.001, name="come to its mouth"),
        MoveTo((x + MOUTH[0], y + MOUTH[1], MOUTH[2]), REACHING_SPEED, 0.001, name="reach under"),
        MoveTo(over, REACHING_SPEED, name="stand over the target"),
        PressSupport(TOUCH_FORCE, over, name="touch it"),
    ]
    left = retraction_steps(simulation, target, turning_size, lambda _: False, aside=ASIDE, fold=FOLD, lift=LIFT)
    return [*(MayEnd(OfArm(step, "left")) for step in left), *(MayEnd(OfArm(step, "right")) for step in right)]
