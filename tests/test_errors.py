"""What the machine refuses, told apart from mistakes."""

from __future__ import annotations

import errno

import pytest

from franka_wm.errors import machine_refused


def caused(error: Exception, by: Exception) -> Exception:
    error.__cause__ = by
    return error


MAPPED = "warp.so: failed to map segment from shared object"


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "the disk is full"),
        (MemoryError(), "out of memory"),
        (ImportError(f"PLEASE READ THIS\n{MAPPED}"), f"({MAPPED})"),
        (caused(RuntimeError("Failed to load the shared library"), OSError(MAPPED)), f"({MAPPED})"),
        (OSError(errno.ENAMETOOLONG, "File name too long"), "choose a shorter one"),
        (OSError(errno.ELOOP, "Too many levels"), "leads to itself"),
        (RuntimeError("Symlink loop from '/x'"), "leads to itself; remove it (Symlink loop from '/x')"),
        (SystemError("error return without exception set"), "out of memory"),
        (ImportError("No module named 'x'"), None),
        (caused(RuntimeError("a mistake"), ValueError("out of memory, it says")), None),
        (ValueError("out of memory"), None),
    ],
)
def test_only_what_the_machine_refuses(error: Exception, says: str | None) -> None:
    found = machine_refused(error)
    assert found is None if says is None else says in str(found)
