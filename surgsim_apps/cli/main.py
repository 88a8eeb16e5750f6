"""Commands of `surgsim`, with their exit status, errors and warnings."""

import sys
import warnings
from collections.abc import Sequence

import tyro
from rich.console import Console

from surgsim_apps.cli.arm import Arm
from surgsim_apps.cli.arms import Arms
from surgsim_apps.cli.bench import Bench
from surgsim_apps.cli.doctor import Doctor
from surgsim_apps.cli.evaluate import Evaluate
from surgsim_apps.cli.haptics import Haptics
from surgsim_apps.cli.identify import Identify
from surgsim_apps.cli.maps import Maps
from surgsim_apps.cli.materials import Materials
from surgsim_apps.cli.organ import Organ
from surgsim_apps.cli.palpate import Palpate
from surgsim_apps.cli.retract import Retract
from surgsim_apps.cli.scenes import Scenes
from surgsim_apps.cli.validate import Validate
from surgsim_apps.cli.view import View
from surgsim_apps.reports.output_folder import interrupts

Command = (
    Palpate
    | Retract
    | Organ
    | Scenes
    | Maps
    | Materials
    | Arm
    | Arms
    | Identify
    | Evaluate
    | Validate
    | Bench
    | Haptics
    | View
    | Doctor
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; exit status 0, 1 (a row not met, no success), 2 (invalid input), 130 (Ctrl-C, SIGTERM)."""
    try:
        command = tyro.cli(
            Command, prog="surgsim", args=arguments, description=__doc__, config=(tyro.conf.OmitArgPrefixes,)
        )
    # After --help, or after tyro's message about the options.
    except SystemExit as ended:
        return 2 if ended.code else 0
    try:
        with warnings.catch_warnings(), interrupts():
            warnings.showwarning = _show_warning
            return command.run(Console())
    except KeyboardInterrupt:
        print("surgsim: stopped", file=sys.stderr)
        return 130
    # Invalid input (MeshError and OrganError are ValueErrors) is reported in one line without a traceback.
    except (ValueError, OSError) as error:
        print(f"surgsim: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def _show_warning(message: Warning | str, *_: object) -> None:
    print(f"surgsim: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
