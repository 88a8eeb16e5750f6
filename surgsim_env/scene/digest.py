"""Identity of an episode's inputs: the version of the physics, and digests of organs and scenes.

A stored map, a saved state and a score must agree with it.
"""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from msdm_core.mesh.tet_mesh import TetMesh
from surgsim_env.scene.load import pair_names
from surgsim_env.scene.model import Scene

# Increase it with each intended change of results; the hashes of tests/test_unchanged.py change with it.
PHYSICS_VERSION = 3


def content_digest(*parts: object, size: int = 12) -> str:
    """BLAKE2b of parts, one after the other: of an array its bytes, else the `repr`.

    Args:
        parts: any number.
        size: bytes of the digest, two hexadecimal digits each.
    """
    digest = hashlib.blake2b(digest_size=size)
    for part in parts:
        digest.update(np.ascontiguousarray(part).data if isinstance(part, np.ndarray) else repr(part).encode())
    return digest.hexdigest()


def scene_digest(scene: Scene, mesh: TetMesh, *, size: int = 12) -> str:
    """Digest of a scene and its mesh, independent of the folders of its file and its instrument's."""
    names = pair_names(scene.instrument.model) or (scene.instrument.model,)
    instrument = replace(scene.instrument, model=" + ".join(Path(name).name for name in names))
    return content_digest(mesh.points, mesh.tets, replace(scene, folder=Path(), instrument=instrument), size=size)
