"""A short run of every fuzz room, by a fixed seed, and the cases that once failed. Long runs: `make fuzz`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rooms.campaign import CASES, campaign, outcome, rooms

NUMBER = {"config": 60, "urdf": 60, "scene": 60, "dataset": 40, "checkpoint": 40, "run_folder": 20}
"""Cases of the short run: two minutes in all on two cores."""

SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("dataset", "checkpoint", "run_folder")]
ROOMS = ["config", "urdf", "scene", *SLOW]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Makes each room once."""
    made: dict[str, Any] = {}

    def make(name: str) -> Any:
        if name not in made:
            made[name] = rooms()[name](tmp_path_factory.mktemp(name))
        return made[name]

    return make


def kept(name: str) -> list[Path]:
    """The cases that once failed."""
    return sorted((CASES / name).glob("*.json"))


@pytest.mark.parametrize("name", ROOMS)
def test_whatever_is_changed_ends_well_or_in_one_line(name: str, room: Any) -> None:
    counts, failures = campaign(room(name), number=NUMBER[name], start=1)
    assert not failures, "\n".join(
        f"{where}: {json.dumps(case)[:500]}" for where, (case, _) in failures.items()
    )
    assert counts["refused"] > NUMBER[name] // 5, counts


@pytest.mark.parametrize("name", ROOMS)
def test_what_once_failed(name: str, room: Any) -> None:
    bad = {}
    for path in kept(name):
        case = json.loads(path.read_text())
        found = outcome(room(name), case)
        if not found.good or (case.get("refused") and found.kind != "refused"):
            bad[path.name] = f"{found.kind}: {found.text}"
    assert not bad, "\n".join(f"{name}: {text}" for name, text in bad.items())


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
