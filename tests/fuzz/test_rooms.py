"""A short run of every fuzz room, by a fixed seed, and the cases that once failed. Long runs: `make fuzz`."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from forks import spare
from rooms.campaign import short_run

NUMBER = {
    "config": 40,
    "urdf": 40,
    "scene": 40,
    "mechanism": 40,
    "dataset": 25,
    "checkpoint": 25,
    "run_folder": 12,
}
"""Cases of the short run: a bit more than a minute in all on two cores."""

SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("dataset", "checkpoint", "run_folder")]
ROOMS = ["config", "urdf", "scene", "mechanism", *SLOW]


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, Any]]:
    """How each room's cases ended, in a fork in which no other test has run: some of them train."""
    known: dict[str, Any] = {}

    def run(name: str) -> dict[str, Any]:
        if name not in known:
            place = tmp_path_factory.mktemp(name)
            done = spare().fork(partial(short_run, name, NUMBER[name], place), place, seconds=900)
            assert done.returncode == 0, done.stderr
            known[name] = json.loads(done.stdout.splitlines()[-1])
        return known[name]

    return run


@pytest.mark.parametrize("name", ROOMS)
def test_whatever_is_changed_ends_well_or_in_one_line(name: str, ended: Callable[[str], Any]) -> None:
    counts, failures = ended(name)["counts"], ended(name)["failures"]
    assert not failures, "\n".join(f"{where}: {json.dumps(case)[:500]}" for where, case in failures.items())
    assert counts["refused"] > NUMBER[name] // 5, counts


@pytest.mark.parametrize("name", ROOMS)
def test_what_once_failed(name: str, ended: Callable[[str], Any]) -> None:
    bad = ended(name)["kept"]
    assert not bad, "\n".join(f"{name}: {text}" for name, text in bad.items())


def test_the_long_run_begins() -> None:
    """`python tests/fuzz`, whose path pytest does not set."""
    done = subprocess.run(
        [sys.executable, str(Path(__file__).parent), "--help"], capture_output=True, text=True
    )
    assert done.returncode == 0 and "run_folder" in done.stdout, done.stderr


def test_a_fork_tells_hangs_memory_and_tracebacks_apart() -> None:
    import time

    from franka_wm.errors import UserError
    from rooms.forked import forked

    def refused() -> None:
        raise UserError("no")

    def memory() -> None:
        bytearray(8 * 2**30)

    kinds = {
        "done": forked(lambda: None).kind,
        "refused": forked(refused).kind,
        "hang": forked(lambda: time.sleep(9), seconds=0.5).kind,
        "traceback": forked(memory, gigabytes=1.0).kind,
        "crash": forked(lambda: __import__("os").abort()).kind,
    }
    assert list(kinds) == list(kinds.values())
