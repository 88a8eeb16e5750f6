"""Series of fields: files that meshio reads back, listed with their times."""

from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest

from msdm_core.organ import FieldSeries, advance, tissue_fields
from tests.core.organ.test_fields import BALL, DOWN, LAW, STILL, pressed_block


def test_series_holds_positions_and_fields_to_the_bit(tmp_path: Path):
    model, state, shapes = pressed_block(BALL, 0.008, 1, (DOWN, STILL))
    series, kept = FieldSeries(tmp_path / "press.pvd", model), []
    for time in (0.1, 0.1001):
        fields = tissue_fields(model, state, shapes, LAW, 1e-4)
        series.add(time, state, fields)
        kept.append((state.node_position.copy(), fields))
        advance(model, state, dt=1e-4, shapes=shapes, contact=LAW)
    listed = ElementTree.parse(series.path).getroot().findall("./Collection/DataSet")
    assert [float(frame.attrib["timestep"]) for frame in listed] == [0.1, 0.1001]
    for frame, (position, fields) in zip(listed, kept, strict=True):
        read = meshio.read(tmp_path / frame.attrib["file"])
        np.testing.assert_array_equal(read.points, position)
        assert [block.type for block in read.cells] == ["tetra", "triangle"]
        np.testing.assert_array_equal(read.cells[0].data, model.tet_nodes)
        np.testing.assert_array_equal(read.cells[1].data, model.surface_triangles)
        np.testing.assert_array_equal(read.point_data["displacement"], position - model.node_rest_position)
        for name in ("von_mises", "principal_stress", "energy_density"):
            np.testing.assert_array_equal(read.point_data[name], getattr(fields, name))
        for name, block in (("principal_stretch", 0), ("pressure", 1), ("shear", 1)):
            np.testing.assert_array_equal(read.cell_data[name][block], getattr(fields, name))
            assert np.isnan(read.cell_data[name][1 - block]).all()
    assert not np.array_equal(*(position for position, _ in kept))


def test_series_refuses_another_suffix(tmp_path: Path):
    model, _, _ = pressed_block(BALL, 0.008, 1, ())
    with pytest.raises(ValueError, match=r"press\.vtu: the suffix must be \.pvd"):
        FieldSeries(tmp_path / "press.vtu", model)
