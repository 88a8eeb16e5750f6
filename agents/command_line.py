"""What scripts share as commands: wrong input and missing packages end them with one line."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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


def _end(line: str) -> None:
    print(f"{Path(sys.argv[0]).stem}: error: {line}", file=sys.stderr)
    raise SystemExit(2) from None
