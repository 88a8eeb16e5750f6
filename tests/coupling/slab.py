"""A slab of tissue held at its back, thin enough for a jaw, and the instruments that grasp it."""

from dataclasses import replace
from functools import cache

import numpy as np

from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import Anchor, BlockMesh, Box, MeshSource, Port, Scene, SceneInstrument

SIZE = (0.040, 0.024, 0.012)
# The middle of the jaw's hold: 8 mm behind the free edge y = 24 mm, at half height.
HOLD = np.array([0.020, 0.016, 0.006])
PORTS = {"grasper.xml": None, "psm_retractor": Port((0.02, 0.13, 0.05), (0.0, -0.93, -0.37))}


def slab_scene(model: str) -> Scene:
    """The phantom's tissue as a slab, and an instrument that comes to its edge along -y with a level jaw."""
    width, _, height = SIZE
    wall = Box((-0.001, -0.001, -0.001), (width + 0.001, 1e-4, height + 0.001))
    phantom, lobe = make_scene("phantom"), make_scene("lobe")
    return replace(
        phantom,
        name="slab",
        mesh=MeshSource(block=BlockMesh(SIZE, (10, 6, 3), top_nodes=False)),
        anchors=(Anchor("wall", box=wall),),
        # As stiff as fingers of 8 g bear: 16 x 14 mm of a pad at the phantom's need 13 g.
        contact=lobe.contact,
        timing=replace(phantom.timing, substep_count=5),
        palpation=replace(phantom.palpation, face_margin=0.0),
        instrument=SceneInstrument(model, 0.008, approach=(0.0, -1.0, -0.3), tip_direction=(0.0, -1.0, 0.0)),
        port=PORTS[model],
    )


@cache
def slab(model: str) -> Anatomy:
    """The slab's anatomy with an instrument's model."""
    return load_anatomy(slab_scene(model))
