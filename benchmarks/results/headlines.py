"""What README says first: of a few rows, the worst seed and how long it learned."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks.results.confirm import confirmed
from benchmarks.results.metrics import SUCCESS, WITHIN, columns, mean
from benchmarks.results.records import PLACE, read
from benchmarks.results.render import table
from benchmarks.results.rows import Row
from benchmarks.results.state import state, unmeasured
from benchmarks.results.times import company, cores, duration, seconds, timed

BEGIN, END = "<!-- headlines: written by `make results` -->", "<!-- end of headlines -->"


def headlines(rows: Mapping[str, Row], place: Path = PLACE) -> str:
    """A table of the rows with `headline` whose every seed was measured; marked as README's other tables."""
    found = []
    for row in rows.values():
        records = read(row, place) if row.headline else []
        kind, _ = state(row, records)
        if kind in ("missing", "mixed") or unmeasured(row, records):
            continue
        policy = row.acting(records[0]["policies"])
        measure, what = (SUCCESS, "success") if SUCCESS in columns(records) else (WITHIN["5"], "within 5 cm")
        worst = min(measure.of(record, policy) for record in records)
        timing = timed(records, beside=row.beside)
        took = duration(mean([seconds(record) for record in timing])) + company(records, beside=row.beside)
        aged = kind == "stale" and confirmed(row, records, place) is None
        title = row.title + " ".join([*"¹" * aged, *"²" * row.chosen])
        found.append([title, cores(row, records), took, f"{worst:.0f} % {what}, {len(records)} seeds"])
    return table(["task", "machine", "training", "worst seed"], found) + "\n" if found else ""
