"""Errors that a user can mend. Entry points print them as one line, without a traceback."""

LONGEST, LONGEST_LINE = 1000, 2500
"""Characters of a word and of a message: what a user, or a stranger's file, holds may be of any length."""


class FrankaError(Exception):
    """Any error that this package raises on purpose.

    The message is kept on one line that can be read, whatever was put into it.
    """

    def __init__(self, message: str) -> None:
        words = (word if len(word) <= LONGEST else f"{word[:LONGEST]}…" for word in message.split())
        line = " ".join(words)
        super().__init__(line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]}…")


class CaptureError(FrankaError, RuntimeError):
    """Work that cannot be captured as a CUDA graph."""


class UserError(FrankaError, ValueError):
    """Bad input: an option, a value, a file or a folder that cannot be used.

    The message says what is wrong, what is allowed, and what to do. Also a `ValueError`, so that code
    which uses the package as a library can catch it without knowing it.
    """
