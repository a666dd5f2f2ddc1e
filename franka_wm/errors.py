"""Errors that a user can mend. Entry points print them as one line, without a traceback."""


class FrankaError(Exception):
    """Any error that this package raises on purpose.

    The message is kept on one line, whatever was put into it.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class CaptureError(FrankaError, RuntimeError):
    """Work that cannot be captured as a CUDA graph."""


class UserError(FrankaError, ValueError):
    """Bad input: an option, a value, a file or a folder that cannot be used.

    The message says what is wrong, what is allowed, and what to do. Also a `ValueError`, so that code
    which uses the package as a library can catch it without knowing it.
    """
