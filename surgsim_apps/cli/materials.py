"""`surgsim materials`: the library of materials and where their numbers come from."""

from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from msdm_core.material import Material
from surgsim_apps.cli.values import MaybeText
from surgsim_env.scene import list_materials, make_material


@dataclass(frozen=True)
class Materials:
    """List the materials that a scene can name ([material] name = "..."), with condition, interval and source."""

    name: MaybeText = None
    """Only this material: a name of the list, or the path of a material's TOML file."""

    def run(self, console: Console) -> int:
        """Print a table of the library, or all that is known of one material.

        Raises:
            ValueError: an unknown name, or a file that breaks the format.
        """
        if self.name is not None:
            found = make_material(self.name)
            console.print(f"{found.name}: {found.description}", highlight=False, markup=False)
            for what in (law_text(found.material), *(f"{key}: {getattr(found, key)}" for key in _TOLD)):
                console.print(f"  {what}", highlight=False, markup=False)
            return 0
        table = Table("material", "what it is", "E [kPa]", "law")
        for name in list_materials():
            found = make_material(name)
            modulus = f"{found.material.youngs_modulus / 1000.0:.4g}"
            table.add_row(name, found.description, modulus, ", ".join(parts_of_law(found.material)) or "linear")
        console.print(table)
        console.print("surgsim materials --name NAME: source, condition and interval", highlight=False)
        return 0


_TOLD = ("condition", "interval", "source")


def parts_of_law(material: Material) -> list[str]:
    """What a material's law has besides linear springs: "stiffening", "relaxation"."""
    return [part for part in ("stiffening", "relaxation") if getattr(material, part, None) is not None]


def law_text(material: Material) -> str:
    """The numbers of a material in one line."""
    parts = [
        f"E {material.youngs_modulus:g} Pa, density {material.density:g} kg/m^3, nu {material.poisson_ratio:g}",
        *(str(getattr(material, part)) for part in parts_of_law(material)),
    ]
    return ", ".join(parts)
