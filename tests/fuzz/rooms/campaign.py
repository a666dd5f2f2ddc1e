"""Many cases of a room, one after another; what fails is made small, told apart and kept."""

from __future__ import annotations

import json
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings

from rooms.forked import Outcome, forked

CASES = Path(__file__).resolve().parents[1] / "cases"
AT_A_TIME = 50


def rooms() -> dict[str, type]:
    """By name."""
    from rooms.checkpoint import Checkpoint
    from rooms.config import Config
    from rooms.dataset import Dataset
    from rooms.mechanism import Mechanism
    from rooms.run_folder import RunFolder
    from rooms.scene import Scenes
    from rooms.urdf import Urdf

    return {one.name: one for one in (Config, Checkpoint, RunFolder, Dataset, Urdf, Scenes, Mechanism)}


def outcome(room: Any, case: dict[str, Any]) -> Outcome:
    """What becomes of a case. A fork of a process with threads may itself hang: only what hangs twice does."""
    for _ in range(2):
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            found = forked(lambda folder=folder: room.use(case, Path(folder)), seconds=room.seconds)
        if found.kind != "hang":
            break
    return found


def examples(room: Any, number: int, start: int) -> list[dict[str, Any]]:
    """So many cases by a seed."""
    found: list[dict[str, Any]] = []

    @seed(start)
    @settings(
        max_examples=number,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(room.cases)
    def draw(case: dict[str, Any]) -> None:
        found.append(case)

    draw()
    return found


def smaller(room: Any, case: dict[str, Any], where: str) -> dict[str, Any]:
    """The same failure with as few mutations as it takes."""
    for k in range(len(case["mutations"]) - 1, -1, -1):
        fewer = case | {"mutations": case["mutations"][:k] + case["mutations"][k + 1 :]}
        if fewer["mutations"] and outcome(room, fewer).where == where:
            case = fewer
    return case


def campaign(
    room: Any, *, minutes: float | None = None, number: int | None = None, start: int = 0, keep: bool = False
) -> tuple[Counter[str], dict[str, tuple[dict[str, Any], Outcome]]]:
    """Runs cases until the time or their number is spent.

    Returns:
        How many ended how, and the first case of each failure by its place.
    """
    ends = None if minutes is None else time.monotonic() + 60 * minutes
    counts: Counter[str] = Counter()
    failures: dict[str, tuple[dict[str, Any], Outcome]] = {}
    for case in _stream(room, number, start):
        if ends is not None and time.monotonic() > ends:
            break
        found = outcome(room, case)
        counts[found.kind] += 1
        if not found.good and found.where not in failures:
            case = smaller(room, case, found.where)
            failures[found.where] = case, found
            print(
                f"{room.name}: {found.kind} {found.where}\n  {json.dumps(case)[:600]}\n  {found.text}",
                flush=True,
            )
            if keep:
                save(room.name, found.where, case)
    return counts, failures


def short_run(name: str, number: int, folder: Path) -> None:
    """A room's cases by a fixed seed, and those that once failed; prints how they ended, as JSON in the last line."""
    room = rooms()[name](folder)
    counts, failures = campaign(room, number=number, start=1)
    bad = {}
    for path in kept(name):
        case = json.loads(path.read_text())
        found = outcome(room, case)
        if not found.good or (case.get("refused") and found.kind != "refused"):
            bad[path.name] = f"{found.kind}: {found.text}"
    print(
        json.dumps(
            {"counts": counts, "failures": {k: case for k, (case, _) in failures.items()}, "kept": bad}
        )
    )


def kept(name: str) -> list[Path]:
    """The cases that once failed."""
    return sorted((CASES / name).glob("*.json"))


def _stream(room: Any, number: int | None, start: int) -> Iterator[dict[str, Any]]:
    left = number
    while left is None or left > 0:
        portion = examples(room, AT_A_TIME if left is None else min(left, AT_A_TIME), start)
        yield from portion
        start += 1
        left = None if left is None else left - AT_A_TIME


def save(room: str, where: str, case: dict[str, Any]) -> Path:
    """Keeps a case as a file, which `test_rooms.py` runs from then on."""
    words = "".join(c if c.isalnum() else "_" for c in where)[:60]
    path = CASES / room / f"{words}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(case, indent=1) + "\n")
    return path


def clean(folder: Path) -> None:
    """Removes what a room made for itself."""
    shutil.rmtree(folder, ignore_errors=True)
