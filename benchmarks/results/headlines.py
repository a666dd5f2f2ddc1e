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
from benchmarks.results.times import cores, duration, seconds, timed
from franka_wm.evaluation.intervals import percent

BEGIN, END = "<!-- headlines: written by `make results` -->", "<!-- end of headlines -->"

NOTES = {
    "¹": "¹ Measured before changes of the code.",
    "²": "² A setting was chosen after runs of these seeds.",
}


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
        took = duration(mean([seconds(record) for record in timing]))
        aged = kind == "stale" and confirmed(row, records, place) is None
        title = row.title + " ".join([*"¹" * aged, *"²" * row.chosen])
        found.append([title, cores(row, records), took, f"{percent(worst)} % {what}, {len(records)} seeds"])
    if not found:
        return ""
    titles = " ".join(title for title, *_ in found)
    notes = [note for mark, note in NOTES.items() if mark in titles]
    return "\n".join([table(["task", "machine", "training", "worst seed"], found), "", *notes, ""])
