"""How long a row's runs took, on which machines, and what else ran there meanwhile."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from benchmarks.results.rows import Row
from benchmarks.results.state import Record

COUNTS = {1: "One CPU core", 2: "Two CPU cores"}
BESIDE_OTHERS = ", beside other work"


def seconds(record: Record) -> float:
    """Training, of both stages where there are two."""
    training = record["training"]
    return training["seconds"] + training.get("pretraining_seconds", 0)


def timed(records: Sequence[Record], *, beside: bool = False) -> Sequence[Record]:
    """The runs whose times count: those that had the GPU or the cores to themselves, if there are any.

    Args:
        records: of a row.
        beside: whether other work ran beside all of them: `Row.beside`.
    """
    alone = [] if beside else [record for record in records if record["machine"]["jobs"] == 1]
    return alone or records


def company(records: Sequence[Record], *, beside: bool = False) -> str:
    """What to say after the times of ``timed``: which of the runs these are, and what ran at the same time."""
    shown = timed(records, beside=beside)
    jobs = sorted({record["machine"]["jobs"] for record in shown})
    others = BESIDE_OTHERS if beside else ""
    if jobs == [1]:
        return others or (
            "" if len(shown) == len(records) else f" alone ({len(shown)} of {len(records)} runs)"
        )
    return f", {' – '.join(map(str, dict.fromkeys((jobs[0], jobs[-1]))))} at a time{others}"


def duration(*values: float) -> str:
    """``42 s`` or ``8.1 min``, with bounds if given."""
    minutes = values[0] >= 120
    first, *others = (f"{value / 60:.1f}" if minutes else f"{value:.0f}" for value in values)
    return (f"{first} ({' – '.join(others)})" if others else first) + (" min" if minutes else " s")


def machine(record: Record) -> str:
    """The machine of a run."""
    made = record["machine"]
    return made["gpu"] or f"{made['processor']}, {made['threads']} thread{'s' * (made['threads'] > 1)}"


def grouped(records: Sequence[Record], *, beside: bool = False) -> str:
    """Each machine once, with how many runs it had at a time; numbers of runs where these are not all the same."""
    kinds = Counter((machine(record), record["machine"]["jobs"]) for record in records)
    others = BESIDE_OTHERS if beside else ""
    if len(kinds) == 1:
        ((kind, jobs),) = kinds
        return kind + (f", {jobs} runs at a time" if jobs > 1 else "") + others
    alone = "at 1 a time" if beside else "alone"
    texts: dict[str, list[str]] = {}
    for (kind, jobs), runs in sorted(kinds.items()):
        said = texts.setdefault(kind, [])
        noun = "" if said else f" run{'s' * (runs > 1)}"
        said.append(f"{runs}{noun} " + (f"at {jobs} a time" if jobs > 1 else alone))
    return "; ".join(f"{kind}: {', '.join(said)}" for kind, said in texts.items()) + others


def cores(row: Row, records: Sequence[Record]) -> str:
    """The kind of machine: the section's, on a CPU with the cores that the runs used."""
    if row.section.threads is None:
        return row.section.title
    used = sorted({record["machine"]["threads"] for record in records})
    return " or ".join(COUNTS.get(threads, f"{threads} CPU cores") for threads in used)
