"""`surgsim materials`: the library of materials with the sources of their numbers."""

from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from msdm_core.material import Material
from surgsim_apps.cli.values import MaybeText
from surgsim_env.scene import list_materials, make_material


@dataclass(frozen=True)
class Materials:
    """List the materials for scenes ([material] name = "..."), with condition, interval and source."""

    name: MaybeText = None
    """Only this material: a name of the list, or the path of a material's TOML file."""

    def run(self, console: Console) -> int:
        """Print a table of the library, or everything about one material.

        Raises:
            ValueError: an unknown name, or a file in another format.
        """
        if self.name is not None:
            material = make_material(self.name)
            console.print(f"{material.name}: {material.description}", highlight=False, markup=False)
            facts = [f"{key}: {getattr(material, key)}" for key in ("condition", "interval", "source")]
            for fact in (law_text(material.material), *facts):
                console.print(f"  {fact}", highlight=False, markup=False)
            return 0
        table = Table("material", "what it is", "E [kPa]", "law")
        for name in list_materials():
            material = make_material(name)
            modulus = f"{material.material.youngs_modulus / 1000.0:.4g}"
            table.add_row(name, material.description, modulus, ", ".join(parts_of_law(material.material)) or "linear")
        console.print(table)
        console.print("surgsim materials --name NAME: source, condition and interval", highlight=False)
        return 0


def parts_of_law(material: Material) -> list[str]:
    """Parts of a material's law besides linear springs: "stiffening", "relaxation"."""
    return [part for part in ("stiffening", "relaxation") if getattr(material, part, None) is not None]


def law_text(material: Material) -> str:
    """The numbers of a material in one line."""
    parts = [
        f"E {material.youngs_modulus:g} Pa, density {material.density:g} kg/m^3, nu {material.poisson_ratio:g}",
        *(str(getattr(material, part)) for part in parts_of_law(material)),
    ]
    return ", ".join(parts)
