"""Materials of tissues by their names, each with its source."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from msdm_core.errors import MeshError
from msdm_core.material import Material
from surgsim_env.scene import make_material

# A common textbook value for soft organs [kg/m^3], not checked against a source.
DENSITY = 1060.0
# Chosen: nearly incompressible.
POISSON_RATIO = 0.45


@dataclass(frozen=True)
class TissueMaterial:
    """A region's material and the source of its modulus."""

    material: Material
    source: str


# Material of the library with the relaxation of ORGANS.
RELAXING = "pig_liver_ex_vivo_relaxing"
# Young's moduli of healthy tissue at equilibrium [Pa], and true for tissue that relaxes.
ORGANS: Mapping[str, tuple[float, bool, str]] = {
    "liver": (
        2140.0,
        True,
        "elastography measures the immediate modulus, 3.1 times as large: normal liver 6.63 +- 1.65 kPa "
        "(doi 10.1177/8756479317733713)",
    ),
    "kidney": (
        8000.0,
        False,
        "chosen below the 10.2 kPa that elastography takes for the limit of health (PMC10403462)",
    ),
    "stomach": (5000.0, False, "chosen, filled with tissue; no source was looked up"),
    "spleen": (2140.0, True, "chosen as the liver's, with its relaxation; no source was looked up"),
}
# Ratio of a lesion's modulus to that of the organ around it.
LESIONS: Mapping[str, tuple[float, str]] = {
    "adenoma": (1.9, "1.91 +- 1.70 times the liver by elastography (PMID 26299323)"),
    "fnh": (7.9, "7.94 +- 6.43 times the liver by elastography (PMID 26299323)"),
    "lesion": (8.0, "chosen: HCC 51 kPa and metastases 50 kPa in liver of 6.6 kPa (doi 10.1177/8756479317733713)"),
}
KIDNEY_LESION = (4.0, "chosen: strain index of renal cell carcinoma 4.04 +- 0.72 (PMID 26880174)")
GIVEN = "given on the command line"
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_ .-]{0,39}")
LESION_WORD = re.compile(r"lesion|tumou?r|metastas|carcinoma|hcc|nodule|mass|cancer|adenoma|fnh", re.IGNORECASE)


def check_name(name: str, option: str) -> str:
    """The name of a region as given.

    Raises:
        MeshError: characters that mesh files, TOML and HTML do not all take, with the option and the rule.
    """
    if not NAME.fullmatch(name) or name != name.strip():
        raise MeshError(
            f"{option}: {name!r} cannot be a region's name; use letters, digits, blanks and _ . - (at most 40)"
        )
    return name


def is_lesion(name: str) -> bool:
    """True for the name of a lesion."""
    return LESION_WORD.search(name) is not None


def without_number(name: str) -> str:
    """A region's name without the number of its part: "lesion" for "lesion 2"."""
    return re.sub(r" \d+$", "", name)


def organ_material(name: str, youngs_modulus: float | None = None) -> TissueMaterial:
    """Material of an organ by its name, such as "left kidney", or with a given modulus [Pa]; else the liver's."""
    unknown = *ORGANS["liver"][:2], f"the liver's: nothing is known of {name!r} here (--youngs-modulus)"
    modulus, relaxes, source = _known(name) or unknown
    if youngs_modulus is not None:
        modulus, source = youngs_modulus, GIVEN
    relaxation = make_material(RELAXING).material.relaxation if relaxes else None
    return TissueMaterial(Material(modulus, DENSITY, POISSON_RATIO, relaxation=relaxation), source)


def _known(name: str) -> tuple[float, bool, str] | None:
    """Entry of the first organ in a name."""
    return next((entry for word, entry in ORGANS.items() if word in name.lower()), None)


def region_material(name: str, organ_name: str, organ: Material, moduli: Mapping[str, float]) -> TissueMaterial:
    """Material of a region inside an organ.

    Args:
        name: of the region.
        organ_name: of the organ around it.
        organ: material of that organ.
        moduli: given on the command line, by the region's name with or without its number [Pa].
    """
    modulus = moduli.get(name, moduli.get(without_number(name)))
    if modulus is not None:
        source = GIVEN
    elif is_lesion(name):
        ratio, source = KIDNEY_LESION if "kidney" in organ_name.lower() else LESIONS["lesion"]
        for word, entry in LESIONS.items():
            if word in name.lower() and word != "lesion":
                ratio, source = entry
        modulus, source = ratio * organ.youngs_modulus, f"{ratio:g} x the organ's; {source}"
    elif _known(name):
        return organ_material(name)
    else:
        modulus = organ.youngs_modulus
        source = f"that of the organ around it: nothing is known of {name!r} here (--modulus)"
    return TissueMaterial(replace(organ, youngs_modulus=modulus), source)
