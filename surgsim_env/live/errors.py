"""What stops a live session that began with sound input."""


class LiveError(OSError):
    """The session cannot begin or go on: its physics died, its memory is broken, its server cannot be guarded.

    An `OSError`, so that the command line says it in one line.
    """
