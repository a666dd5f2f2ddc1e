"""Benchmarks that start training read what it has logged."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from forks import script, spare

TOP = Path(__file__).resolve().parents[2]


def rows(out: Path, name: str, *words: str) -> list[dict[str, Any]]:
    """In a fork; what it starts is a process of its own."""
    work = script(TOP / "benchmarks" / f"{name}.py", "--device", "cpu", "--out", str(out), *words)
    done = spare().fork(work, TOP)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(out.read_text())["rows"]


@pytest.mark.slow
def test_speed_is_that_of_the_later_updates(tmp_path: Path) -> None:
    words = ("--scale", "smoke", "--cases", "TD-MPC2", "--gpus", "1", "--updates", "1000")
    (row,) = rows(tmp_path / "out", "scale", *words)
    assert row["updates/s"] > 0 and row["times one GPU"] == 1.0 and row["gradients [MB]"] > 0.01


def test_updates_stand_beside_the_minute_at_which_they_were_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of four minutes went into the start; evaluations are logged as well, and have no loss."""
    monkeypatch.syspath_prepend(str(TOP / "benchmarks"))
    memory = import_module("memory")
    seen = [{"minutes": minute} for minute in (1.0, 2.0, 3.0, 4.0)]
    logged = [
        {"loss": 1.0, "time_s": 30.0 * k, "updates": 10 * k, "env_steps": 100 * k} for k in (1, 2, 3, 4)
    ]
    memory.beside(seen, [*logged, {"return": 1.0, "time_s": 120.0, "updates": 40, "env_steps": 400}], 4.0)
    assert [row["updates"] for row in seen] == [0, 0, 20, 40]
    assert [row["env steps"] for row in seen] == [0, 0, 200, 400]
    assert all(row["finite"] and row["broken worlds"] == 0 for row in seen)
