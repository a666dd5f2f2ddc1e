"""Errors that a user can mend. Entry points print them as one line, without a traceback."""

import errno
import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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


@contextmanager
def trying(what: str, *but: type[Exception]) -> Iterator[None]:
    """Around a call of the user's own code: what goes wrong in it ends in one line that says where.

    Args:
        what: is called, in words.
        but: errors that pass.

    Raises:
        UserError: `what` fails, by which error, and in which line.
    """
    try:
        yield
    except (FrankaError, MemoryError, *but):
        raise
    except (Exception, SystemExit) as error:
        raise UserError(f"{what} fails: {where(error)}; mend it") from error


def where(error: BaseException) -> str:
    """Kind and first line of an error, and the last line of the user's own that led to it."""
    reason = (str(error).strip() or "no reason given").splitlines()[0]
    return f"{type(error).__name__}: {reason}{place(error)}"


def place(error: BaseException) -> str:
    """`` (FILE, line N)`` of the last line of the user's own that led to an error; empty where there is none."""
    others = (
        str(Path(__file__).parent),
        sysconfig.get_paths()["purelib"],
        sysconfig.get_paths()["stdlib"],
        "<",
    )
    frames = traceback.extract_tb(error.__traceback__)
    own = [one for one in frames if not one.filename.startswith(others)]
    # A SyntaxError says it itself.
    said = own and not isinstance(error, SyntaxError)
    return f" ({own[-1].filename}, line {own[-1].lineno})" if said else ""


_LOOP = "a link leads to itself; remove it"
_REFUSED = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "a file may not become so large here",
    errno.EROFS: "the disk is read-only",
    errno.EACCES: "a file may not be written",
    errno.EMFILE: "too many open files (ulimit -n)",
    errno.ENFILE: "too many open files on this machine",
    errno.ENOMEM: "out of memory",
    errno.ENAMETOOLONG: "a name is longer than the file system allows; choose a shorter one",
    errno.ELOOP: _LOOP,
}
_NO_MEMORY = (
    "can't allocate memory",
    "cannot allocate memory",
    "out of memory",
    "Failed to allocate",
    "failed to map segment",  # of a library: torch's, Warp's
    "cannot map zero-fill pages",
    "error return without exception set",  # Python's compiler, without memory
)
REFUSALS = (OSError, MemoryError, RuntimeError, ImportError, SystemError)
"""What `machine_refused` tells apart."""


def machine_refused(error: BaseException) -> str | None:
    """In one line, what the machine had no more of; `None` for any other error."""
    reason = _REFUSED.get(error.errno or 0) if isinstance(error, OSError) else None
    said = str(error).strip().splitlines()
    if isinstance(error, RuntimeError) and str(error).startswith(
        "Symlink loop"
    ):  # Python 3.12's Path.resolve
        reason = _LOOP
    for one in (error, error.__cause__):  # of a library that cannot be loaded, only the cause says why
        lines = [line for line in str(one).splitlines() if any(words in line for words in _NO_MEMORY)]
        if isinstance(one, MemoryError) or (isinstance(one, REFUSALS) and lines):
            reason = (
                "out of memory; allow more (ulimit -v), or use fewer worlds (collector.num_envs, evaluation.episodes) "
                "or a smaller batch"
            )
            said = lines or str(one).strip().splitlines()
    if reason is None:
        return None
    return str(
        FrankaError(f"{reason} ({said[0] if said else type(error).__name__}); what was saved before is whole")
    )
