"""What scripts share as commands: wrong input and missing packages end them with one line; classes are named."""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

OUR_PACKAGES = ("agents", "benchmarks", "msdm_core", "surgsim_env", "tests")


@contextmanager
def one_line_errors(script: str, *extras: str) -> Iterator[None]:
    """End a script with one line and exit status 2 where a package of an extra is missing or an input is wrong.

    Put it around the imports that need extras, and around `main()`. Where the file is imported, errors are raised.

    Args:
        script: its `__name__`.
        extras: of pyproject.toml, all that it needs.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if script != "__main__" or not extras or missing in OUR_PACKAGES:
            raise
        _end(f"{missing} is not installed: pip install 'surgsim[{','.join(extras)}]'")
    except (ValueError, OSError) as error:
        if script != "__main__":
            raise
        _end(" ".join(str(error).split()))


def named_class(text: str, option: str) -> Any:
    """The class (or any function that makes an agent) of MODULE:CLASS.

    Importing the module runs its code.

    Args:
        text: MODULE:CLASS.
        option: where it was given, for messages.

    Raises:
        ValueError: another text, or no such module or class.
    """
    module, _, name = text.partition(":")
    if not (module and name):
        raise ValueError(f"{option} is {text!r}; the rule is MODULE:CLASS")
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise
        raise ValueError(
            f"{option} {text}: there is no module {error.name!r} on Python's path: run from its folder, or add that to "
            "PYTHONPATH"
        ) from None
    if not callable(getattr(found, name, None)):
        raise ValueError(f"{option} {text}: {found.__file__ or module} has no class {name!r}")
    return getattr(found, name)


def _end(line: str) -> None:
    print(f"{Path(sys.argv[0]).stem}: error: {line}", file=sys.stderr)
    raise SystemExit(2) from None
