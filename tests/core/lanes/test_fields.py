"""The sheet of fields against the classes, and against the arrays of an organ with all parts and of one with none."""

from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

from msdm_core.kernels.structure_kernels import (
    KEPT_NAMES,
    LAYOUTS,
    MODEL_FIELDS,
    STATE_FIELDS,
    Field,
    OrganModel,
    OrganState,
)
from msdm_core.lanes.lanes import get_lane, put_lane
from msdm_core.material.regions import Damping, Material
from msdm_core.material.tissue_law import Relaxation, Stiffening
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.foundation import Foundation
from msdm_core.organ.motion import Motion
from msdm_core.organ.state import field_sizes, state_sizes
from msdm_core.organ.support import Support
from tests.core.lanes.abreast import rest_lanes

SHAPES = 2
TABLES = {OrganModel: MODEL_FIELDS, OrganState: STATE_FIELDS}


def organ(*, parts: bool) -> OrganModel:
    """A small block, with or without supports, foundations, motions and laws of its springs."""
    mesh = box_mesh((0.02, 0.02, 0.01), (2, 2, 1))
    low = np.flatnonzero(mesh.points[:, 2] == 0.0)
    tissue = Material(5000.0, 1060.0, 0.45)
    if not parts:
        return compile_organ(OrganSpec(mesh, tissue, damping=Damping(0.0)))
    law = Stiffening(0.05, 0.2, 20.0), Relaxation((0.3,), (0.1,))
    return compile_organ(
        OrganSpec(
            mesh,
            Material(5000.0, 1060.0, 0.45, *law),
            anchors=low[:2],
            supports=(Support("floor", "plane"),),
            foundations=(Foundation("below", low[4:], 1e6, 0.0),),
            motions=(Motion("breath", (0.0, 0.0, 0.001)),),
        )
    )


@pytest.mark.parametrize("kind", TABLES)
def test_the_classes_have_the_fields_of_the_sheet_in_its_order(kind: type):
    hints = get_type_hints(kind)
    assert list(hints) == [field.name for field in TABLES[kind]]
    for field in TABLES[kind]:
        hint = hints[field.name]
        element = hint if not field.shape else get_args(get_args(hint)[1])[0]
        assert np.dtype(element) == field.dtype, field.name
        assert field.lanes in LAYOUTS


@pytest.mark.parametrize("parts", [False, True])
def test_the_arrays_of_an_organ_have_the_shapes_and_types_of_the_sheet(parts: bool):
    model = organ(parts=parts)
    state = rest_state(model, shape_count=SHAPES)
    sizes = state_sizes(field_sizes(MODEL_FIELDS, model), SHAPES)

    def check(field: Field, value: Any) -> None:
        assert np.shape(value) == field.lengths(sizes), field.name
        assert np.asarray(value).dtype == field.dtype, field.name

    for table, values in ((MODEL_FIELDS, model), (STATE_FIELDS, state)):
        for field, value in zip(table, values, strict=True):
            check(field, value)
    if parts:
        assert all(sizes.values())


@pytest.mark.parametrize("parts", [False, True])
def test_a_lane_gives_back_the_state_put_into_it(parts: bool):
    model = organ(parts=parts)
    lanes, put = rest_lanes([model] * 3, shape_count=SHAPES), rest_state(model, shape_count=SHAPES)
    for number, array in enumerate(put):
        array[...] = number + np.arange(array.size).reshape(array.shape) % 50
    put_lane(lanes, 1, put)
    for name, before, after in zip(OrganState._fields, put, get_lane(lanes, 1)):
        assert after.shape == before.shape and after.dtype == before.dtype
        if name in KEPT_NAMES:
            np.testing.assert_array_equal(after, before, err_msg=name)
