"""The instrument on the page: its geoms, posed from frames, and its dragging by the mouse."""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.rendering.instrument_geoms import geom_colour

# The page's scene is in decimetres: viser's cameras and handles are made for scenes of some metres.
SCALE = 10.0
# Smaller changes are not sent [m].
STILL = 2e-6

_KIND = {
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")): name for name in ("SPHERE", "CAPSULE", "CYLINDER", "BOX", "MESH")
}


class InstrumentView:
    """Nodes of a viser scene for geoms of an instrument's model."""

    def __init__(self, scene: Any, model: mujoco.MjModel, geoms: list[int], arm_count: int) -> None:
        """Add a node for each geom.

        Args:
            scene: viser's.
            model: the instrument's.
            geoms: which of its geoms are drawn.
            arm_count: 1, or 2: then the names of the second arm's bodies begin with "right_".
        """
        self.nodes, self.arms = [], []
        self._shown: NDArray[np.float32] | None = None
        for place, geom in enumerate(geoms):
            node = _add(scene, f"/instrument/{place}", model, geom)
            self.nodes.append(node)
            body = model.body(int(model.geom_bodyid[geom])).name
            fixed = int(model.geom_bodyid[geom]) == 0
            self.arms.append(None if fixed else int(arm_count > 1 and body.startswith("right_")))

    def follow(self, position: NDArray[np.float32], rotation: NDArray[np.float32]) -> None:
        """Move the nodes to positions [m], (n_geom, 3), and rotation matrices, (n_geom, 9)."""
        quaternion, moved = np.zeros(4), self._moved(position, rotation)
        for node, place, turn, has_moved in zip(self.nodes, position, rotation, moved, strict=True):
            if not has_moved:
                continue
            mujoco.mju_mat2Quat(quaternion, turn.astype(np.float64))
            node.position, node.wxyz = place * SCALE, quaternion.copy()

    def _moved(self, position: NDArray[np.float32], rotation: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which geoms have moved since they were last sent, (n_geom,)."""
        now = np.concatenate([position, rotation], axis=1)
        moved = np.ones(len(now), dtype=bool) if self._shown is None else np.abs(now - self._shown).max(axis=1) > STILL
        self._shown = now if self._shown is None else np.where(moved[:, None], now, self._shown)
        return moved

    def on_drag(self, moved: Callable[[int, str, FloatArray], None]) -> list[str]:
        """Call `moved` with an arm, the phase of a drag and the pointer's position [m]; returns the nodes' names."""
        names = []
        for node, arm in zip(self.nodes, self.arms, strict=True):
            if arm is None:
                continue
            node.on_drag("left")(_caller(moved, arm))
            names.append(node.name)
        return names


def _caller(moved: Callable[[int, str, FloatArray], None], arm: int) -> Callable[[Any], Any]:
    async def call(event: Any) -> None:
        moved(arm, event.phase, np.asarray(event.end_position, dtype=np.float64) / SCALE)

    return call


def _add(scene: Any, name: str, model: mujoco.MjModel, geom: int) -> Any:
    import trimesh

    kind, size = _KIND[int(model.geom_type[geom])], model.geom_size[geom] * SCALE
    red, green, blue, _ = (round(255 * float(part)) for part in geom_colour(model, geom))
    colour = (red, green, blue)
    if kind == "SPHERE":
        return scene.add_icosphere(name, radius=float(size[0]), color=colour, subdivisions=3)
    if kind == "BOX":
        return scene.add_box(name, dimensions=tuple((2.0 * size).tolist()), color=colour)
    if kind == "CYLINDER":
        return scene.add_cylinder(
            name, radius=float(size[0]), height=float(2.0 * size[1]), color=colour, radial_segments=24
        )
    if kind == "CAPSULE":
        made = trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=[20, 20])
        made.apply_translation(-made.bounds.mean(axis=0))
        vertices, faces = made.vertices, made.faces
    else:
        mesh = int(model.geom_dataid[geom])
        vertices = _rows(model.mesh_vert, model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]) * SCALE
        faces = _rows(model.mesh_face, model.mesh_faceadr[mesh], model.mesh_facenum[mesh])
    return scene.add_mesh_simple(name, np.asarray(vertices, np.float32), np.asarray(faces, np.uint32), color=colour)


def _rows(array: NDArray[Any], first: Any, count: Any) -> NDArray[Any]:
    return array[int(first) : int(first) + int(count)]
