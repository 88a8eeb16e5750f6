"""An environment's saved state as bytes: arrays by name, and the mark of what they belong to."""

import io
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from surgsim_env.simulation import Simulation


def packed(arrays: dict[str, np.ndarray]) -> bytes:
    """Arrays in numpy's own format; nothing in it is executed."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def unpacked(state: bytes, *, made_by: str) -> dict[str, np.ndarray]:
    """The arrays of `packed`, whose entry `made_by` must be this one.

    Raises:
        ValueError: bytes that are no saved state, or one that another environment made (names both).
    """
    try:
        with np.load(io.BytesIO(state), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        maker = str(arrays["made_by"])
    except (ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"not a saved state of this kind of environment: {error}") from None
    if maker != made_by:
        raise ValueError(f"the state was saved by {maker}, this is {made_by}: use the same scene")
    return arrays


def fingerprint(kind: str, simulation: Simulation) -> str:
    """What a saved state must agree with: the kind of environment, its scene and mesh, the rates."""
    scene, mesh = simulation.anatomy.scene, simulation.anatomy.mesh
    digest = zlib.crc32(mesh.tets.tobytes(), zlib.crc32(mesh.points.tobytes()))
    digest = zlib.crc32(repr(replace(scene, folder=Path())).encode(), digest)
    return (
        f"{kind} of scene {scene.name!r} ({mesh.node_count} nodes, {mesh.tet_count} tets, "
        f"{scene.timing.substep_count} substeps in {scene.timing.haptic_step:g} s, digest {digest:08x})"
    )


def check_entries(arrays: dict[str, np.ndarray], shapes: dict[str, tuple[int, ...]]) -> None:
    """Refuse an archive that lacks an entry or has one of another shape."""
    for name, shape in shapes.items():
        if name not in arrays or arrays[name].shape != shape:
            found = arrays[name].shape if name in arrays else "nothing"
            raise ValueError(f"not a saved state of this environment: {name} has shape {shape}, found {found}")
