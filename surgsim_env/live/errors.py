"""Errors of a live session after its input was accepted."""


class LiveError(OSError):
    """The session cannot start or continue: its physics ended, its memory is inconsistent, its server is unprotected.

    An `OSError`, which the command line prints as one line.
    """
