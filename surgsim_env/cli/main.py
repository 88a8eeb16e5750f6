"""Commands of `surgsim`: how they are chosen, and how their errors and warnings are told."""

import contextlib
import io
import re
import sys
import warnings
from collections.abc import Sequence

import tyro
from rich.console import Console

from surgsim_env.cli.arm import Arm
from surgsim_env.cli.arms import Arms
from surgsim_env.cli.bench import Bench
from surgsim_env.cli.doctor import Doctor
from surgsim_env.cli.evaluate import Evaluate
from surgsim_env.cli.haptics import Haptics
from surgsim_env.cli.identify import Identify
from surgsim_env.cli.maps import Maps
from surgsim_env.cli.materials import Materials
from surgsim_env.cli.organ import Organ
from surgsim_env.cli.palpate import Palpate
from surgsim_env.cli.retract import Retract
from surgsim_env.cli.scenes import Scenes
from surgsim_env.cli.validate import Validate
from surgsim_env.cli.view import View

# Options whose value is a list of numbers, which may begin with a minus.
NUMBER_LISTS = ("--lesion", "--anchors", "--approach", "--around", "--trocar")

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
    """Run the command line; exit status 0, 1 (a row not met, no success), 2 (invalid input, one line), 130 (Ctrl-C)."""
    given = _joined(list(sys.argv[1:] if arguments is None else arguments))
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            command = tyro.cli(
                Command, prog="surgsim", args=given, description=__doc__, config=(tyro.conf.OmitArgPrefixes,)
            )
    except SystemExit as ended:
        if ended.code:
            print(f"surgsim: error: {_first_part(said.getvalue())} (see surgsim --help)", file=sys.stderr)
        return 2 if ended.code else 0
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            return command.run(Console())
    except KeyboardInterrupt:
        print("surgsim: stopped", file=sys.stderr)
        return 130
    # Invalid input (MeshError and OrganError are ValueErrors) is reported in one line without a traceback.
    except (ValueError, OSError) as error:
        print(f"surgsim: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def _joined(arguments: list[str]) -> list[str]:
    """`--lesion -0.1,0,...` as `--lesion=-0.1,0,...`: older tyro parses a minus as an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in NUMBER_LISTS and re.match(r"-[\d.]", argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _first_part(box: str) -> str:
    """The text of a tyro error box above its first rule, in one line."""
    lines = [line.strip("│ ") for line in box.splitlines() if line.startswith("│")]
    rules = [number for number, line in enumerate(lines) if line and set(line) == {"─"}]
    return " ".join(lines[: rules[0]] if rules else lines) or " ".join(box.split())


def _show_warning(message: Warning | str, *_: object) -> None:
    print(f"surgsim: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
