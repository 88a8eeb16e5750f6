"""Makes the instrument that a scene names: a Cartesian probe or grasper, one arm or two."""

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.arm.arm_instrument import ArmInstrument, is_arm
from surgsim_env.instruments.arm.pair import Pair
from surgsim_env.instruments.cartesian import Grasper, Probe, read_model
from surgsim_env.instruments.instrument import Instrument
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.load import pair_names


def make_instrument(anatomy: Anatomy, lower: FloatArray, upper: FloatArray) -> Instrument:
    """The instrument of an anatomy's scene, whose tip may move in the box from lower to upper [m].

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
