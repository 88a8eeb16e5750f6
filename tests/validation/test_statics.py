"""The assembled stiffness against the linearised forces of the kernels."""

import numpy as np
import pytest

from msdm_core.organ.stability import apply_stiffness
from surgsim_apps.validation.dynamics import organs
from surgsim_apps.validation.statics import assemble_stiffness


@pytest.mark.parametrize("name", ["springs", "nu 0.45", "capsule and lesion"])
def test_the_assembled_matrix_has_every_term_of_the_kernels(name: str):
    """K u of an irregular displacement u."""
    model = organs()[name]
    displacement = np.sin(1.0 + 1.7 * np.arange(model.node_rest_position.size) ** 1.1).reshape(-1, 3)
    force = np.empty_like(displacement)
    apply_stiffness(model, displacement, force)
    own = assemble_stiffness(model) @ displacement.ravel()
    np.testing.assert_allclose(own, force.ravel(), rtol=0, atol=1e-9 * np.abs(own).max())
