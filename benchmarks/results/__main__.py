"""The command line; see the package's docstring."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import benchmarks.results
from benchmarks.results import confirm, headlines, plots, records, render, running
from benchmarks.results.rows import Row, choose, load_rows
from benchmarks.results.state import state, unmeasured
from franka_wm.console import terminal_log
from franka_wm.errors import FrankaError
from franka_wm.files import atomic_write
from franka_wm.source import ROOT

SHOWN = 3
"""Of the files that changed since a row was measured."""


README = ROOT / "README.md"


def overview(rows: Mapping[str, Row], place: Path) -> str:
    """A line for each row: its state, how many seeds it has, and why it is not fresh."""
    lines, width = [], max(map(len, rows)) + 2
    for name, row in rows.items():
        found = records.read(row, place)
        kind, reasons = state(row, found)
        declared = len(row.seeds)
        have = f"{declared - len(unmeasured(row, found))}/{declared}" if row.seeds else f"{len(found)}/1"
        judged = [] if kind in ("missing", "mixed") else render.verdicts(row, found)
        if kind == "stale" and (same := confirm.confirmed(row, found, place)):
            kind = "confirmed"
            reasons = [f"{render.changed_told(reasons)} changed, nothing else: {same['date']}"]
        if len(reasons) > SHOWN:
            reasons = [*reasons[:SHOWN], f"{len(reasons) - SHOWN} more, see docs/results.md"]
        more = [
            *reasons,
            *(f"missed: {wanted}, is {reached}" for wanted, reached, enough in judged if not enough),
        ]
        lines.append(f"{name:{width}}{kind:11}{have:7}{'; '.join(more)}".rstrip())
    return "\n".join(lines)


def to_measure(row: Row, seeds: Sequence[int], place: Path) -> list[int]:
    """Those of a row's seeds that today's code has not measured; all where that leaves a row of mixed packages."""
    found = records.read(row, place)
    fresh = {record["seed"] for record in found if state(row, [record])[0] in ("fresh", "part")}
    missing = [seed for seed in seeds if seed not in fresh]
    return missing or [seed for seed in seeds if state(row, found)[0] == "mixed"]


def is_fresh(row: Row, place: Path) -> bool:
    """Whether today's code has measured all of the row."""
    return state(row, records.read(row, place))[0] == "fresh"


def with_results(readme: str, rows: Mapping[str, Row], place: Path) -> str:
    """README with its two parts of results."""
    first = render.with_tables(readme, headlines.headlines(rows, place), headlines.BEGIN, headlines.END)
    return render.with_tables(first, render.readme_tables(rows, place))


def write_pages(rows: Mapping[str, Row], place: Path) -> None:
    """docs/results.md, its pictures and README's tables."""
    for row in rows.values():
        if row.plot and (found := records.read(row, place)):
            plots.write(row, found[0], place)
    for path, text in (
        (ROOT / "docs" / "results.md", render.page(rows, place)),
        (README, with_results(README.read_text(), rows, place)),
    ):
        with atomic_write(path) as temporary:
            temporary.write_text(text)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.results",
        description=benchmarks.results.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    verbs = parser.add_subparsers(dest="verb")
    verbs.add_parser(
        "list",
        help="which rows are fresh, begun (part), stale, confirmed (stale, but a short run gives the same), missing",
    )
    verbs.add_parser("render", help="write docs/results.md and README's tables")
    one = verbs.add_parser("run", help="run the seeds of rows")
    one.add_argument("rows", nargs="+", metavar="row")
    one.add_argument("--seeds", type=int, nargs="+", help="default: those of each row")
    one.add_argument("--missing", action="store_true", help="only seeds that today's code has not measured")
    one.add_argument("--minutes", type=float, help="no run begins later; those that run are waited for")
    one.add_argument("--jobs", type=int, default=1, help="runs at a time, on each device")
    one.add_argument(
        "--beside",
        type=int,
        default=0,
        help="other runs on the same GPU meanwhile, counted in the row's 'N at a time'",
    )
    one.add_argument("--device", nargs="+", default=[], help="of a row on a GPU: cuda:0 cuda:1 …")
    one.add_argument("--threads", type=int, help="of each run; default: the row's, on a GPU torch's choice")
    one.add_argument(
        "--extra",
        nargs="+",
        default=[],
        metavar="ARG",
        help="of train.py, that change no number but times: evaluation.video_episodes=0 logger=none",
    )
    one.add_argument("--out", type=Path, default=Path("outputs/results"), help="folder for the runs' folders")
    two = verbs.add_parser("collect", help="take a row's numbers from folders of finished runs")
    two.add_argument("row")
    two.add_argument("runs", type=Path, nargs="+", help="folders; of a benchmark, the file of its --out")
    two.add_argument("--jobs", type=int, required=True, help="how many runs shared the GPU or the cores")
    three = verbs.add_parser(
        "confirm", help="whether today's code does the same as the measured one, bit for bit"
    )
    three.add_argument("rows", nargs="+")
    for verb in (one, two):
        verb.add_argument("--commit", help="of the code, where there is no repository")
    for verb in verbs.choices.values():
        verb.add_argument("--results", type=Path, default=records.PLACE, help="folder of the rows' files")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Exit status: 0, or 1 if something failed."""
    chosen = parse(arguments)
    failed: list[str] = []
    try:
        rows = load_rows()
        if chosen.verb == "run":
            machine = running.Machine(
                jobs=chosen.jobs,
                beside=chosen.beside,
                devices=chosen.device,
                threads=chosen.threads,
                commit=chosen.commit,
                extra=chosen.extra,
            )
            work = [(row, chosen.seeds or row.seeds) for row in (choose(rows, name) for name in chosen.rows)]
            for row, seeds in work:
                for seed in seeds:
                    records.check_seed(row, seed, "--seeds")
            if chosen.missing:
                work = [
                    (row, left)
                    for row, seeds in work
                    if (left := to_measure(row, seeds, chosen.results))
                    or (row.script is not None and not is_fresh(row, chosen.results))
                ]
            failed = running.run(
                work, machine, out=chosen.out.absolute(), place=chosen.results, minutes=chosen.minutes
            )
        elif chosen.verb == "collect":
            row = choose(rows, chosen.row)
            for path in chosen.runs:
                if row.script is not None:
                    record = records.record_benchmark(row, path, jobs=chosen.jobs, commit=chosen.commit)
                else:
                    record = records.record_run(row, path, jobs=chosen.jobs, commit=chosen.commit)
                print(records.write(record, chosen.results))
        elif chosen.verb == "confirm":
            for name in chosen.rows:
                try:
                    print(confirm.confirm(choose(rows, name), chosen.results), flush=True)
                except FrankaError as error:
                    failed.append(str(error))
        elif chosen.verb == "render":
            records.prune(chosen.results)
            write_pages(rows, chosen.results)
        else:
            print(overview(rows, chosen.results if chosen.verb else records.PLACE))
    except FrankaError as error:
        failed.append(str(error))
    for line in failed:
        print(f"error: {line}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    with terminal_log():  # a closed pipe, `… | head`, ends quietly
        sys.exit(main())
