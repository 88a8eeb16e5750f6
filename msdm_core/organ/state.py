"""Initial states of organs, from the sheet of fields."""

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.kernels.contact_kernels import PLACE_WIDTH, QUADRATURE_COUNT, ROW_WIDTH
from msdm_core.kernels.squeeze_kernels import STEEP_WIDTH
from msdm_core.kernels.structure_kernels import MODEL_FIELDS, STATE_FIELDS, Field, OrganModel, OrganState
from msdm_core.kernels.vector_kernels import aligned_zeros


def blank_state(model: OrganModel, *, shape_count: int = 0) -> OrganState:
    """The undeformed organ at rest, without contact, with contact memory for `shape_count` shapes."""
    state = zero_state(state_sizes(field_sizes(MODEL_FIELDS, model), shape_count))
    state.node_position[:] = model.node_rest_position
    state.ground_foundation[:] = model.foundation_position
    state.ground_support[:, 0] = model.support_position
    state.volume_ratio_smallest[:] = 1.0
    return state


def field_sizes(fields: Iterable[Field], arrays: Iterable[ArrayLike]) -> dict[int | str, int]:
    """Lengths of the arrays of fields, by name."""
    sizes = {}
    for field, array in zip(fields, arrays, strict=True):
        sizes |= zip(field.shape, np.shape(array), strict=True)
    return sizes


def state_sizes(sizes: Mapping[int | str, int], shape_count: int) -> dict[int | str, int]:
    """Lengths of a state's arrays, by name, from those of its model's."""
    point_count = sizes["n_surface"] * QUADRATURE_COUNT
    return {
        **sizes,
        "n_steep": sizes["n_spring"] if sizes["n_soft"] else 0,
        "n_shape": shape_count,
        "n_point": point_count,
        "n_row": shape_count * point_count,
        "row_width": ROW_WIDTH,
        "place_width": PLACE_WIDTH,
        "steep_width": STEEP_WIDTH,
    }


def zero_state(sizes: Mapping[int | str, int]) -> OrganState:
    """State of zeros, with lengths by name."""
    # Rows and pairs of an organ alone load as registers.
    return OrganState(
        **{
            field.name: (aligned_zeros if field.lanes in ("alone", "halves") else np.zeros)(
                field.lengths(sizes), field.dtype
            )
            for field in STATE_FIELDS
        }
    )
