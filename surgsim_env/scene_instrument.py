"""Which instrument a scene names: a Cartesian probe or grasper, an arm or two."""

from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy
from surgsim_env.arms.arm_instrument import ArmInstrument, is_arm
from surgsim_env.arms.pair import Pair
from surgsim_env.grasper import Grasper
from surgsim_env.instrument import Instrument, Probe, read_model
from surgsim_env.scenes import pair_names


def make_instrument(anatomy: Anatomy, lower: FloatArray, upper: FloatArray) -> Instrument:
    """The instrument of an anatomy's scene, its tip at home in a box [m].

    Raises:
        ValueError: an unknown model; an arm that is wrongly described or does not reach the palpable face.
    """
    scene = anatomy.scene
    if pair_names(scene.instrument.model) is not None:
        return Pair(anatomy, lower, upper)
    if is_arm(scene.instrument.model):
        return ArmInstrument(anatomy, lower, upper)
    made = Grasper if read_model(scene.instrument.model).body("jaw") is not None else Probe
    return made(scene, lower, upper)
