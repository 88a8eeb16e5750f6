"""A slab of tissue between two arms."""

from dataclasses import replace

import numpy as np

from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.model import Port, SceneInstrument
from tests.coupling.slab import slab_scene

# 90 mm from each other, outside on the free side.
PORTS = (Port((-0.025, 0.14, 0.06), (0.28, -0.87, -0.40)), Port((0.065, 0.14, 0.06), (-0.28, -0.87, -0.40)))
# Around the slab's edge; before it.
LEFT, RIGHT = np.array([0.014, 0.016, 0.006]), np.array([0.034, 0.034, 0.006])


def pair_anatomy() -> Anatomy:
    scene = slab_scene("psm_retractor")
    instrument = SceneInstrument("psm_pair", 0.0035, scene.instrument.approach, scene.instrument.tip_direction)
    return load_anatomy(replace(scene, name="slab for two", instrument=instrument, port=None, ports=PORTS))
