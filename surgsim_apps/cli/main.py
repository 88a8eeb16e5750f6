"""Commands of `surgsim`, with their exit status, errors and warnings."""

import io
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from inspect import getdoc

import gymnasium.error
import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

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
from surgsim_apps.palpate.results import surgsim_version
from surgsim_apps.reports.output_folder import interrupts
from surgsim_env.scene import require_known

# Commands by purpose, each with an example.
GROUPS = {
    "Press and retract an organ": {
        Palpate: "surgsim palpate --scene liver",
        Retract: "surgsim retract --bimanual",
        View: "surgsim view --scene liver",
        Haptics: "surgsim haptics --scene liver --motion calm",
    },
    "Scenes and materials": {
        Scenes: "surgsim scenes",
        Materials: "surgsim materials --name liver_linear",
        Organ: "surgsim organ scan.nrrd --labels liver=1,lesion=2 --out liver.vtu",
        Identify: "surgsim identify presses.csv --thickness 12mm",
    },
    "Robot arms": {
        Arm: "surgsim arm check robot.urdf",
        Arms: "surgsim arms --left psm_grasper --right psm_palpator",
    },
    "Agents": {
        Evaluate: "surgsim evaluate --agent gp_ucb --scene phantom --level standard",
        Maps: "surgsim maps --scene liver_family --split test",
    },
    "Checks": {
        Doctor: "surgsim doctor",
        Validate: "surgsim validate --quick",
        Bench: "surgsim bench --quick",
    },
}
EXAMPLES = {kind.__name__.lower(): (kind, example) for group in GROUPS.values() for kind, example in group.items()}
# Options with one spelling each, and no text that stands for a missing value.
TYRO = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)


class Output(Console):
    """Standard output; without a reader, as after `| head`, a command goes on and writes its files."""

    def on_broken_pipe(self) -> None:
        """Print no more."""
        self.quiet = True
        _print_nowhere()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; exit status 0, 1 (a row not met, no success), 2 (invalid input), 130 (Ctrl-C, SIGTERM)."""
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")
    elif isinstance(sys.stdout, io.TextIOWrapper):
        # As stderr does with letters that an encoding lacks.
        sys.stdout.reconfigure(errors="backslashreplace")
    return exit_status(lambda: _run(sys.argv[1:] if arguments is None else arguments))


def exit_status(run: Callable[[], int | None]) -> int:
    """Run a program; its exit status, as of `main`, after an error or an end in a line."""
    try:
        status = run()
        try:
            sys.stdout.flush()
        except BrokenPipeError:
            _print_nowhere()
        return status or 0
    except KeyboardInterrupt:
        print("surgsim: stopped", file=sys.stderr)
        return 130
    # Invalid input (MeshError and OrganError are ValueErrors) is reported in one line without a traceback.
    except OSError as error:
        text = str(error) if error.filename is None else f"{error.filename}: {error.strerror}"
    except (ValueError, gymnasium.error.Error) as error:
        text = str(error)
    except (OverflowError, MemoryError) as error:
        text = f"a number or a file is too large for this computer ({error})"
    print(f"surgsim: error: {' '.join(text.split())}", file=sys.stderr)
    return 2


def _run(arguments: Sequence[str]) -> int:
    console = Output()
    name, *options = arguments or ["help"]
    if name in ("help", "--help", "-h"):
        if not options:
            _list_commands(console)
            return 0
        name, options = options[0], ["--help"]
    if name == "--version":
        console.print(f"surgsim {surgsim_version()}", highlight=False)
        return 0
    if name.startswith("-"):
        raise ValueError(f"{name} comes before a command: give the command first, as in surgsim palpate --scene liver")
    require_known("command", name, EXAMPLES)
    kind, example = EXAMPLES[name]
    description = f"{getdoc(kind)}\n\nExample: {example}"
    # tyro ends after --help, or after its message about the options.
    try:
        command = tyro.cli(kind, prog=f"surgsim {name}", args=options, description=description, config=TYRO)
    except SystemExit as ended:
        return 2 if ended.code else 0
    except BrokenPipeError:
        return 0
    with warnings.catch_warnings(), interrupts():
        warnings.showwarning = _show_warning
        return command.run(console)


def _list_commands(console: Console) -> None:
    """Print the commands by group, with a sentence and an example each."""
    console.print("usage: surgsim COMMAND [OPTIONS]; surgsim COMMAND --help; surgsim --version", markup=False)
    for group, commands in GROUPS.items():
        table = Table.grid(padding=(0, 2))
        table.add_column(no_wrap=True, min_width=9)
        for kind, example in commands.items():
            sentence = (kind.__doc__ or "").partition("\n")[0]
            table.add_row(kind.__name__.lower(), Text.assemble(sentence, "\n", (example, "cyan")))
        console.print(Text(f"\n{group}", "bold"))
        console.print(table)


def _show_warning(message: Warning | str, *_: object) -> None:
    print(f"surgsim: warning: {' '.join(str(message).split())}", file=sys.stderr)


def _print_nowhere() -> None:
    """Standard output without a reader, so that the interpreter's last flush succeeds."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
