"""A long run: `python tests/fuzz --minutes 60`. Failures become files in tests/fuzz/cases, which the tests run."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))

from rooms.campaign import campaign, rooms


def main() -> int:
    """Every room for its share of the time; 1 if one of them has found something."""
    parser = argparse.ArgumentParser(prog="tests/fuzz", description=__doc__)
    parser.add_argument("rooms", nargs="*", choices=[*rooms(), []], help="all, if none is named")
    parser.add_argument("--minutes", type=float, default=60.0, help="for all rooms together")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="by the clock, if none is given")
    parser.add_argument("--dry", action="store_true", help="keep no files")
    asked = parser.parse_args()
    chosen = asked.rooms or list(rooms())
    bad = 0
    for name in chosen:
        with tempfile.TemporaryDirectory(prefix="fuzz-room-") as folder:
            counts, failures = campaign(
                rooms()[name](Path(folder)),
                minutes=asked.minutes / len(chosen),
                start=asked.seed * 100_000,
                keep=not asked.dry,
            )
        total = sum(counts.values())
        told = ", ".join(f"{count} {kind}" for kind, count in counts.most_common())
        print(
            f"== {name}: {total} cases (seed {asked.seed}): {told}; {len(failures)} different failures",
            flush=True,
        )
        bad += len(failures)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
