"""Time series of an organ's fields for ParaView: a vtu file at each time, and a pvd file that lists them.

Each vtu file holds tets and, as a second block, the surface triangles; a cell has nan in the fields of the other block.
"""

from pathlib import Path

import numpy as np

from msdm_core.kernels.structure_kernels import OrganModel, OrganState
from msdm_core.organ.fields import TissueFields

SERIES_SUFFIX = ".pvd"
_HEAD = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'


def frame_name(stem: str, number: int) -> str:
    """Name of the vtu file of a frame, by the stem of its series."""
    return f"{stem}_{number:04d}.vtu"


class FieldSeries:
    """Series of an organ's fields in files; ParaView opens `path` after each `add`."""

    def __init__(self, path: str | Path, model: OrganModel) -> None:
        """Begin a series without frames; nothing is written.

        Args:
            path: of the pvd file, in an existing folder; its frames get names with its stem beside it.
            model: the organ.

        Raises:
            ValueError: a suffix other than .pvd.
        """
        self.path, self.model = Path(path), model
        if self.path.suffix.lower() != SERIES_SUFFIX:
            raise ValueError(f"{path}: the suffix must be {SERIES_SUFFIX}; its frames are vtu files beside it")
        self._times: list[float] = []

    def add(self, time: float, state: OrganState, fields: TissueFields) -> None:
        """Write the frame of a time, and list it.

        Args:
            time: after that of the last frame [s].
            state: of the organ; positions are the frame's points [m].
            fields: of this state.

        Raises:
            ValueError: a time that is not after the last one.
        """
        import meshio

        if self._times and not time > self._times[-1]:
            raise ValueError(f"{self.path}: a frame at {time:g} s must be after the last one at {self._times[-1]:g} s")
        model = self.model
        tets, triangles = np.array(model.tet_nodes), np.array(model.surface_triangles)
        no_tet, no_triangle = np.full(len(tets), np.nan), np.full((len(triangles), 3), np.nan)
        frame = meshio.Mesh(
            state.node_position.copy(),
            [("tetra", tets), ("triangle", triangles)],
            point_data={
                "displacement": state.node_position - model.node_rest_position,
                "von_mises": fields.von_mises,
                "principal_stress": np.ascontiguousarray(fields.principal_stress),
                "energy_density": fields.energy_density,
            },
            cell_data={
                "principal_stretch": [np.ascontiguousarray(fields.principal_stretch), no_triangle],
                "pressure": [no_tet, fields.pressure],
                "shear": [np.repeat(no_tet[:, None], 3, axis=1), fields.shear],
            },
        )
        meshio.vtu.write(str(self.path.with_name(frame_name(self.path.stem, len(self._times)))), frame)
        self._times.append(time)
        rows = [
            f'<DataSet timestep="{time!r}" file="{frame_name(self.path.stem, number)}"/>\n'
            for number, time in enumerate(map(float, self._times))
        ]
        self.path.write_text(f"{_HEAD}{''.join(rows)}</Collection>\n</VTKFile>\n", encoding="utf-8")
