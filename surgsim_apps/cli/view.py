"""`surgsim view`: a scene live in a browser."""

import math
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from surgsim_apps.cli.values import AnyPath, MaybeNumber, MaybeScene, MaybeText, missing_packages
from surgsim_apps.reports.output_folder import output_folder
from surgsim_env.scene import Scene, make_scene, with_instrument, with_motion

# The scene with ports for two arms, and its arms.
BIMANUAL_SCENE, BIMANUAL_INSTRUMENT = "lobe", "psm_pair"


@dataclass(frozen=True)
class View:
    """Serve a scene live to a browser: press the organ with mouse, keys or gamepad, a thousand steps a second.

    Prints the address to open on this machine; other machines use an SSH tunnel. An organ too slow for that rate gets
    coarser cells, with their force error printed. See docs/live.md.
    """

    scene: MaybeScene = None
    """A shipped scene (see `surgsim scenes`) or a scene file of your own (TOML); default: liver, lobe for two arms."""
    instrument: MaybeText = None
    """An arm or a TOML file (docs/arms.md); default: the scene's own."""
    bimanual: bool = False
    """Two arms: a jaw to lift, a ball to touch."""
    motion: MaybeText = None
    """Breathing of the patient: calm, free, or none (holds still); default: the scene's."""
    port: int = 8080
    """Port of 127.0.0.1 to listen on, or the next free one; 0 for any free one."""
    out: AnyPath = Path("runs/live")
    """Folder for recordings."""
    seconds: MaybeNumber = None
    """Stop after this time [s]."""

    def run(self, console: Console) -> int:
        """Serve until interrupted, or for some seconds.

        Raises:
            ValueError: an invalid scene, instrument or option, or no viser.
            LiveError: the physics died, or an unknown version of viser.
        """
        with missing_packages("view", "live"):
            import viser  # noqa: F401
        from surgsim_apps.live.live_organ import live_anatomy
        from surgsim_apps.live.organ_choice import lesion_kinds
        from surgsim_apps.live.page import Page, Tabs
        from surgsim_apps.live.session import Session

        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0.0):
            raise ValueError(f"--seconds is {self.seconds}; it must be finite and above 0")
        if not 0 <= self.port <= 65535:
            raise ValueError(f"--port is {self.port}; it must be from 0 (any free one) to 65535")
        scene, instrument = self.scene, self.instrument
        # An empty text is no default: it is refused as a name.
        if scene is None:
            scene = BIMANUAL_SCENE if self.bimanual else "liver"
        if instrument is None and self.bimanual:
            instrument = BIMANUAL_INSTRUMENT
        opened = (str(scene), instrument)
        chosen, tabs, end = self._load(*opened), None, math.inf
        # A folder that cannot be written is refused before a recording is lost.
        with output_folder(self.out):
            pass
        try:
            while True:
                session = Session(live_anatomy(chosen, lesion_kinds(chosen)[0], console))
                try:
                    session.wait()
                    begins, tabs = tabs is None, tabs or Tabs(self.port)
                    page = Page(session, tabs, self.out, opened, self._load)
                    if begins:
                        console.print(f"open {tabs.server.address}", highlight=False, soft_wrap=True)
                        end = math.inf if self.seconds is None else time.monotonic() + self.seconds
                    try:
                        page.run(lambda end=end: time.monotonic() >= end)
                    finally:
                        # At any end: Ctrl-C, or death of the physics.
                        if written := page.end_recording():
                            console.print(written, highlight=False, soft_wrap=True)
                    if page.wanted is None:
                        return 0
                    page.clear()
                    opened, chosen = page.wanted
                finally:
                    session.close()
        finally:
            if tabs is not None:
                tabs.server.stop()

    def _load(self, scene: str, instrument: str | None) -> Scene:
        return with_motion(with_instrument(make_scene(scene), instrument), self.motion)
