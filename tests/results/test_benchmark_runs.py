"""Benchmarks that start training read what it has logged."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

TOP = Path(__file__).resolve().parents[2]


def rows(out: Path, script: str, *words: str) -> list[dict[str, Any]]:
    command = [sys.executable, f"benchmarks/{script}.py", "--device", "cpu", "--out", str(out), *words]
    environment = os.environ | {"PYTHONPATH": str(TOP), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=TOP, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(out.read_text())["rows"]


@pytest.mark.slow
def test_speed_is_that_of_the_later_updates(tmp_path: Path) -> None:
    words = ("--scale", "smoke", "--cases", "TD-MPC2", "--gpus", "1", "--updates", "2000")
    (row,) = rows(tmp_path / "out", "scale", *words)
    assert row["updates/s"] > 0 and row["times one GPU"] == 1.0 and row["gradients [MB]"] > 0.01


@pytest.mark.slow
def test_updates_stand_beside_the_minute_at_which_they_were_made(tmp_path: Path) -> None:
    words = ("--minutes", "1.2", "--train", "env=reach_fixed", "scale=smoke")
    made = [row["updates"] for row in rows(tmp_path / "out", "memory", *words)]
    assert made[0] == 0 < made[-1] and made == sorted(made)  # it takes seconds until the first update
