"""Time series of an organ's fields for ParaView: a vtu file at each time, and a pvd file that lists them.

Each vtu file holds tets and, as a second block, the surface triangles; a cell has nan in the fields of the other block.
"""

from pathlib import Path

import numpy as np

from msdm_core.kernels.structure_kernels import OrganModel, OrganState
from msdm_core.organ.fields import TissueFields

_HEAD = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
_TAIL = "</Collection>\n</VTKFile>\n"


class FieldSeries:
    """Series of an organ's fields in files; ParaView opens `path` after each `add`."""

    def __init__(self, path: str | Path, model: OrganModel) -> None:
        """Begin a series without frames; nothing is written.

        Args:
            path: of the pvd file, in an existing folder; its frames are files STEM_0000.vtu and so on beside it.
            model: the organ.

        Raises:
            ValueError: a suffix other than .pvd.
        """
        self.path, self.model = Path(path), model
        if self.path.suffix != ".pvd":
            raise ValueError(f"{path}: the suffix must be .pvd; the frames are vtu files beside it")
        self._rows: list[str] = []

    def add(self, time: float, state: OrganState, fields: TissueFields) -> None:
        """Write the frame of a time, and list it.

        Args:
            time: of the frame [s].
            state: of the organ; positions are the frame's points [m].
            fields: of this state.
        """
        import meshio

        tets, triangles = np.array(self.model.tet_nodes), np.array(self.model.surface_triangles)
        no_tet, no_triangle = (np.full((len(cells), 3), np.nan) for cells in (tets, triangles))
        frame = meshio.Mesh(
            state.node_position,
            [("tetra", tets), ("triangle", triangles)],
            point_data={
                "displacement": state.node_position - self.model.node_rest_position,
                "von_mises": fields.von_mises,
                "principal_stress": np.ascontiguousarray(fields.principal_stress),
                "energy_density": fields.energy_density,
            },
            cell_data={
                "principal_stretch": [np.ascontiguousarray(fields.principal_stretch), no_triangle],
                "pressure": [no_tet[:, 0], fields.pressure],
                "shear": [no_tet, fields.shear],
            },
        )
        name = f"{self.path.stem}_{len(self._rows):04d}.vtu"
        meshio.vtu.write(str(self.path.with_name(name)), frame)
        self._rows.append(f'<DataSet timestep="{time:.9g}" file="{name}"/>\n')
        self.path.write_text(_HEAD + "".join(self._rows) + _TAIL, encoding="utf-8")
