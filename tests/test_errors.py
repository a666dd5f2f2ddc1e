"""What the machine refuses, told apart from mistakes."""

from __future__ import annotations

import errno

import pytest

from franka_wm.errors import UserError, machine_refused


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


@pytest.mark.parametrize("part", ["model", "planner"])
def test_what_fails_inside_a_constructor_of_ones_own_says_where(part: str, settled, monkeypatch) -> None:
    from franka_wm.training import build

    def make(*_: object, **given: object) -> None:
        len(given["episode_length" if part == "model" else "horizon"])  # type: ignore[arg-type]

    monkeypatch.setattr(build.models if part == "model" else build.registry, "make", make)
    run = settled("scale=smoke", "device=cpu")
    said = rf"^{part}=\w+: object of type 'int' has no len\(\) \({__file__}, line \d+\)$"
    with pytest.raises(UserError, match=said):
        if part == "model":
            build.make_model(run, build.Spaces.of_config(run.env.arm))
        else:
            build.make_planner(run, 7)
