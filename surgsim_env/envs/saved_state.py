"""Saved states: all that the next step depends on, as bytes in numpy's own format without executable parts."""

import io
from collections.abc import Mapping

import numpy as np

from msdm_core.mesh.tet_mesh import TetMesh
from surgsim_env.coupling.simulation import Simulation, check_entries
from surgsim_env.scene.digest import scene_digest
from surgsim_env.scene.model import Scene
from surgsim_env.tasks.runtime import TaskRuntime

# Version of the format.
STATE_VERSION = 2


def state_maker(kind: str, scene: Scene, mesh: TetMesh) -> str:
    """Origin of a saved state, to be equal on loading: kind, scene, mesh, rates and version."""
    return (
        f"{kind} of scene {scene.name!r} ({mesh.node_count} nodes, {mesh.tet_count} tets, "
        f"{scene.timing.substep_count} substeps in {scene.timing.haptic_step:g} s, "
        f"digest {scene_digest(scene, mesh, size=4)}), version {STATE_VERSION}"
    )


def pack_state(maker: str, simulation: Simulation, runtime: TaskRuntime, own: Mapping[str, np.ndarray]) -> bytes:
    """The state of a simulation and its task, with an environment's own arrays."""
    arrays = {**simulation.get_state(), "made_by": np.array(maker), "task": np.array(runtime.get_state()), **own}
    if runtime.family is not None:
        arrays["member"] = np.array(str(runtime.task.anatomy.member))
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def restore_state(
    state: bytes, maker: str, simulation: Simulation, runtime: TaskRuntime, own: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Restore a simulation and its task from `pack_state`, to the bit, and return the environment's own arrays.

    Everything is read and checked before anything changes: a refused state leaves both as they were.

    Args:
        state: the bytes.
        maker: of the environment that they go to.
        simulation: of that environment.
        runtime: of that environment.
        own: examples of the environment's own arrays.

    Raises:
        ValueError: bytes that are no saved state, or one of another scene, mesh or version (names both); names the
            entry that is missing, unknown or of another shape.
    """
    arrays = _unpacked(state, maker)
    like = {**own, "made_by": np.array(""), "task": np.array("")}
    if runtime.family is not None:
        like["member"] = np.array("")
    given = {name: arrays.pop(name) for name in like if name in arrays}
    check_entries(given, like)
    text = str(given["task"])
    anatomy = runtime.task.anatomy if runtime.family is None else runtime.family.named(str(given["member"]))
    saved = runtime.read_state(text, anatomy)
    # The first change, which leaves all as it is if it is refused.
    simulation.set_state(saved["drawn"].compiled(anatomy), arrays)
    runtime.set_state(saved, anatomy)
    simulation.take_anatomy(anatomy)
    return given


def _unpacked(state: bytes, maker: str) -> dict[str, np.ndarray]:
    """The arrays of a saved state, whose entry `made_by` must be this maker."""
    try:
        with np.load(io.BytesIO(state), allow_pickle=False) as archive:
            arrays = dict(archive)
        made_by = str(arrays["made_by"])
    except Exception as error:
        # Damaged bytes raise any of a dozen kinds in zipfile and numpy, from KeyError to NotImplementedError.
        raise ValueError(f"not a saved state, as save_state gives it ({type(error).__name__}: {error})") from None
    if made_by != maker:
        raise ValueError(f"the state was saved by {made_by}, this is {maker}: use the same scene")
    return arrays
