"""Patches of taxels on an instrument: their places on its contact shapes, and the forces on them."""

import mujoco
import numpy as np

from msdm_core.arithmetic import dot, matmul, norm
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.tool_bodies import IndexArray, ToolBodies, frame_along
from surgsim_env.scene.model import PITCH_SHARE, Taxels


class TaxelPatches:
    """Patches of taxels of an instrument: one at its tip, or one on each pad of its jaw.

    A patch's axes are along a row, along a column and into the tool. On a box it lies in the middle of the side that
    faces outward, its rows along the longer border; on a ball or capsule around the outward direction, whose cap the
    cells cover like a plane seen from outside.

    Fields:
        taxels: description
        shapes: contact shape with each patch                                     (n_patch,)
        pitch: of each [m]                                                        (n_patch,)
    """

    def __init__(
        self, tools: ToolBodies, taxels: Taxels, tip_radius: float, shapes: IndexArray, normals: FloatArray
    ) -> None:
        """Put patches on contact shapes in their present pose, and give the tools' shapes their arrays.

        Args:
            tools: with these shapes.
            taxels: of each patch.
            tip_radius: of the scene [m], for the default pitch of round shapes.
            shapes: indices, (n_patch,).
            normals: out of the patches, (n_patch, 3).
        """
        self._tools, self.taxels, self.shapes = tools, taxels, shapes
        self._geoms = tools.geoms[shapes]
        model, data = tools.model, tools.data
        # Axes and middle of each patch in the frame of its geom, and the height of the surface above its middle [m].
        self._axes, self._middle, self._radius = np.zeros((len(normals), 3, 3)), np.zeros((len(normals), 3)), []
        self.pitch = np.full(len(normals), taxels.pitch or PITCH_SHARE * tip_radius)
        for patch, (geom, normal) in enumerate(zip(self._geoms, normals, strict=True)):
            own = matmul(data.geom_xmat[geom].reshape(3, 3).T, normal / norm(normal))
            size = model.geom_size[geom]
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
                side = int(np.argmax(np.abs(own)))
                long, short = sorted({0, 1, 2} - {side}, key=lambda axis: -float(size[axis]))
                inward = -np.sign(own[side]) * np.eye(3)[side]
                self._axes[patch] = np.eye(3)[long], np.cross(inward, np.eye(3)[long]), inward
                self._middle[patch] = -inward * size[side]
                if taxels.pitch is None:
                    self.pitch[patch] = 2.0 * min(size[long] / taxels.columns, size[short] / taxels.rows)
                self._radius.append(0.0)
            else:
                self._axes[patch] = frame_along(own).T
                self._radius.append(float(size[0]))
        count = taxels.rows * taxels.columns
        over = self._axes[:, :2] / self.pitch[:, None, None]
        tools.patch_local = np.concatenate([self._middle[:, None], over], axis=1)
        layout = [(shape, taxels.rows, taxels.columns, patch * count) for patch, shape in enumerate(self.shapes)]
        tools.shapes = tools.shapes._replace(
            patch_layout=np.array(layout, dtype=np.int32),
            patch_frame=np.zeros((len(layout), 3, 3)),
            taxel_force=np.zeros((len(layout) * count, 3)),
        )

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of `forces`."""
        return len(self.shapes), self.taxels.rows, self.taxels.columns, 3

    @property
    def axes(self) -> FloatArray:
        """Unit vectors along the rows, along the columns and into the tool, as rows, (n_patch, 3, 3)."""
        rotation = self._tools.data.geom_xmat[self._geoms].reshape(-1, 1, 3, 3)
        return dot(rotation, self._axes[:, :, None])

    @property
    def forces(self) -> FloatArray:
        """Mean force of the tissue on each taxel in the last haptic step, on its patch's axes [N].

        (n_patch, rows, columns, 3): shear along the row and along the column, and normal force, above 0 under pressure.
        """
        force = self._tools.shapes.taxel_force.reshape(self.shape)
        return dot(self.axes[:, None, None], force[:, :, :, None])

    @property
    def places(self) -> FloatArray:
        """Middle of each taxel on the surface of the tool [m], (n_patch, rows, columns, 3)."""
        _, rows, columns, _ = self.shape
        along = (np.arange(columns) - 0.5 * (columns - 1)) * self.pitch[:, None, None]
        across = (np.arange(rows)[:, None] - 0.5 * (rows - 1)) * self.pitch[:, None, None]
        squared = np.square(np.array(self._radius)[:, None, None]) - (along * along + across * across)
        along, across = np.broadcast_arrays(along, across)
        local = np.stack([along, across, -np.sqrt(np.maximum(squared, 0.0))], axis=-1)
        axes = self.axes
        position = self._tools.data.geom_xpos[self._geoms]
        middle = position + dot(self._tools.data.geom_xmat[self._geoms].reshape(-1, 3, 3), self._middle[:, None])
        return middle[:, None, None] + matmul(local, axes[:, None])
