"""Organs: compilation, supports and foundations, stable step, integration, measured quantities."""

from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.field_series import FieldSeries
from msdm_core.organ.fields import TissueFields, contact_points, tissue_fields
from msdm_core.organ.measure import (
    contact_energy,
    element_means,
    element_size,
    element_stiffness,
    element_strains,
    kinetic_energy,
    node_strains,
    potential_energy,
    support_forces,
    tissue_load,
)
from msdm_core.organ.motion import SIGNAL
from msdm_core.organ.stability import contact_node_area, scale_mass, stable_dt
from msdm_core.organ.state import blank_state
from msdm_core.organ.stepping import (
    NO_CONTACT,
    NO_SHAPES,
    advance,
    advance_or_raise,
    advance_organ,
    describe_fault,
    round_shapes,
    unyielding,
)
from msdm_core.organ.support import Support, SupportLaw

__all__ = [
    "NO_CONTACT",
    "NO_SHAPES",
    "SIGNAL",
    "FieldSeries",
    "OrganSpec",
    "Support",
    "SupportLaw",
    "TissueFields",
    "advance",
    "advance_or_raise",
    "advance_organ",
    "blank_state",
    "compile_organ",
    "contact_energy",
    "contact_node_area",
    "contact_points",
    "describe_fault",
    "element_means",
    "element_size",
    "element_stiffness",
    "element_strains",
    "kinetic_energy",
    "node_strains",
    "potential_energy",
    "rest_state",
    "round_shapes",
    "scale_mass",
    "stable_dt",
    "support_forces",
    "tissue_fields",
    "tissue_load",
    "unyielding",
]
