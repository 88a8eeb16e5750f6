"""`surgsim scenes`: the shipped scenes."""

from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from surgsim_env.scene import list_scenes, make_scene


@dataclass(frozen=True)
class Scenes:
    """List the shipped scenes."""

    def run(self, console: Console) -> int:
        """Print a table of the scenes."""
        table = Table("scene", "what it is")
        for name in list_scenes():
            table.add_row(name, make_scene(name).description)
        console.print(table)
        return 0
