"""What `surgsim view` may be told."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class View:
    """Serve a scene live to a browser: press the organ with mouse, keys or gamepad, a thousand steps a second.

    Prints the address to open. Other machines cannot connect unless --allow-remote says so. docs/live.md tells more.
    """

    scene: str | None = None
    """A shipped scene (see `surgsim scenes`) or a scene file of your own (TOML); default: liver, lobe for two arms."""
    instrument: str | None = None
    """An arm or a TOML file (docs/arms.md); default: the scene's own."""
    bimanual: bool = False
    """Two arms: a jaw that lifts, a ball that touches."""
    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = 8080
    """0 takes a free one."""
    allow_remote: bool = False
    """Let other machines connect to --host; nothing is encrypted."""
    replay: Path | None = None
    """A recording (CSV) to play first."""
    out: Path = Path("runs/live")
    """Folder for recordings."""
    plain: bool = False
    """No shadows and no reflections from the start; a browser without a graphics card asks for that itself."""
    seconds: float | None = None
    """Stop after this time."""
    measure: bool = False
    """Press with a client of the page's protocol; print rate and lateness at the end (with --seconds)."""
