"""What `surgsim haptics` may be told."""

from dataclasses import dataclass
from pathlib import Path

# Of UDP; nobody else's by the list of IANA.
PORT = 47801


@dataclass(frozen=True)
class Haptics:
    """Let a haptic device hold the instrument in real time: a bridge on this machine over UDP, or a recorded file.

    docs/haptics.md tells what a bridge sends. Ctrl-C ends it; then it prints the rate, the lateness and the packets.
    """

    scene: str = "liver"
    """A shipped scene (see `surgsim scenes`) or a scene file of your own (TOML)."""
    port: int = PORT
    """That the bridge sends its poses to, on 127.0.0.1; 0 for a free one."""
    trajectory: Path | None = None
    """Instead of a bridge: a CSV file with columns time [s], x, y, z [m]."""
    device_damping: float | None = None
    """Of a device that pushes back [N s/m]; without it, the force is taken to be shown and not felt."""
    device_mass: float = 0.05
    """Of a device that pushes back, at its handle [kg]."""
    device_delay: float = 0.0
    """Of pose and force together, on their way [s]."""
    stiffness: float | None = None
    """Of the coupling [N/m]; default: what the device bears, or 500."""
    damping: float | None = None
    """Of the coupling [N s/m]; default: as docs/haptics.md says, or 0 where a stiffness is given."""
    force_largest: float = 3.0
    """[N], on the device and on the tip."""
    absolute: bool = False
    """The device's position is a place in the scene; otherwise its first one means where the tip starts."""
    seconds: float | None = None
    """How long; default: until Ctrl-C, or the end of the trajectory."""
    out: Path | None = None
    """Folder for telemetry.csv: time, target, tip, forces, depth and what was limited, each haptic step."""
