"""`surgsim` commands of agents, in this process."""

import contextlib
import io

from surgsim_apps.cli.main import main


def surgsim(*arguments: str) -> None:
    """Run a command; what it says as an error is raised as a ValueError."""
    output = io.StringIO()
    with contextlib.redirect_stderr(output):
        status = main(arguments)
    if status:
        raise ValueError(output.getvalue())
