"""Progress of a command's steps on a console: a line for each step with its time, and a bar where its parts count."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

__all__ = ["StepProgress"]

# rich is imported where it is used: environments import this module, and rich takes a tenth of a second.
if TYPE_CHECKING:
    from rich.console import Console


class StepProgress:
    """Shows each step of a command while it runs; without a console nothing.

    On a terminal each step has a line with its time, which moves from its begin on; elsewhere its name is printed.
    """

    def __init__(self, console: "Console | None" = None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        self._console = console
        self._lines = Progress(
            SpinnerColumn(finished_text=" "),
            TextColumn("{task.description:<28}"),
            BarColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console or Console(quiet=True),
        )
        self._shown = ExitStack()

    @classmethod
    def on_stderr(cls) -> "StepProgress":
        """Progress that leaves what a program prints alone."""
        from rich.console import Console

        return cls(Console(stderr=True))

    def __enter__(self) -> "StepProgress":
        if self._console is not None and self._console.is_terminal:
            self._shown.enter_context(self._lines)
        return self

    def __exit__(self, *_: object) -> None:
        self._shown.close()

    def say(self, text: str) -> None:
        """Print a line of the command's own."""
        if self._console is not None:
            self._console.print(text, highlight=False, soft_wrap=True)

    @contextmanager
    def step(self, name: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
        """A step of a number of parts, None if they are not counted; what is given back says how many more are done."""
        if self._console is not None and not self._console.is_terminal:
            self._console.print(f"{name} ...", highlight=False, soft_wrap=True)
        task = self._lines.add_task(name, total=total)
        yield lambda count: self._lines.advance(task, count)
        done = total or 1
        self._lines.update(task, total=done, completed=done)
