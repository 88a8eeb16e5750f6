"""Compiled functions of the organ's substep, for an organ alone or vectorised in lanes."""

from msdm_core.kernels.contact_kernels import (
    QUADRATURE_BARYCENTRIC,
    QUADRATURE_COUNT,
    QUADRATURE_RISE,
    QUADRATURE_WEIGHT,
)
from msdm_core.kernels.element_kernels import SQUEEZED_RATIO
from msdm_core.kernels.part_kernels import repeat_parts
from msdm_core.kernels.structure_kernels import (
    FAULT_NONE,
    ContactLaw,
    ContactShapes,
    LaneState,
    OrganModel,
    OrganState,
    ToolResponse,
)
from msdm_core.kernels.substep_kernels import advance_substeps, evaluate_forces
from msdm_core.kernels.vector_kernels import GROUP, lane_counts, register_bits

__all__ = [
    "FAULT_NONE",
    "GROUP",
    "QUADRATURE_BARYCENTRIC",
    "QUADRATURE_COUNT",
    "QUADRATURE_RISE",
    "QUADRATURE_WEIGHT",
    "SQUEEZED_RATIO",
    "ContactLaw",
    "ContactShapes",
    "LaneState",
    "OrganModel",
    "OrganState",
    "ToolResponse",
    "advance_substeps",
    "evaluate_forces",
    "lane_counts",
    "register_bits",
    "repeat_parts",
]
