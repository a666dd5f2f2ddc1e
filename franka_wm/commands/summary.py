"""``franka-wm summary``: runs of several seeds in one table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from franka_wm.commands.arguments import verb
from franka_wm.errors import UserError
from franka_wm.options import leaves

if TYPE_CHECKING:
    from franka_wm.evaluation.results import Result


MOST_NAMED = 3
"""Options by which a table tells its runs from those of the others."""


@verb("summary")
@click.argument("folders", nargs=-1, required=True, metavar="RUN …|SWEEP")
def summary(folders: tuple[str, ...]) -> None:
    """Show runs of several seeds in one table.

    Runs that differ in more than their seed get a table for each configuration. Of several of one seed, as where a run
    was repeated or evaluated elsewhere, that of later weights counts, and the others are named. Of a sweep, runs that
    have not been evaluated yet, or failed, are named and left out.
    """
    from franka_wm.report.run import but_for_the_seed, malformed, read_config, without_the_seed
    from franka_wm.report.seeds import evaluated, read_evaluation

    groups: dict[str, dict[Path, Result]] = {}
    configs: dict[str, dict[str, object]] = {}
    seen: set[Path] = set()
    for folder in folders:
        for run in evaluated(folder, print):
            if run.resolve() in seen:
                raise UserError(f"summary: {run} is given twice; each run counts once")
            seen.add(run.resolve())
            with malformed(run):
                found = read_evaluation(run)
                # Folders of results alone have no configuration, and what acted may not be what the run has.
                acted = [
                    str(found.protocol.get(name)) for name in ("task", "model", "planner", "planned with")
                ]
                config = read_config(run)
                alike = "\n".join([but_for_the_seed(config), *acted])
                groups.setdefault(alike, {})[run] = found
                configs.setdefault(alike, leaves(without_the_seed(config, config.get("seed"))))
    for alike, every in groups.items():
        with malformed(*every):
            group = _one_of_each_seed(every)
            text = table(group, apart=_own(configs, alike) if len(groups) > 1 else None)
        print(text)


def _one_of_each_seed(group: Mapping[Path, Result]) -> dict[Path, Result]:
    """The run of later weights, then of more episodes, of those with the same seed; the others are named."""
    from franka_wm.report.run import read_config

    best: dict[object, Path] = {}
    for run in sorted(group, key=lambda run: (group[run].updates or 0, group[run].episodes), reverse=True):
        seed = read_config(run).get("seed", group[run].protocol.get("seed"))
        kept = best.setdefault(run if seed is None else seed, run)
        if kept != run:
            print(f"left out: {run}, of seed {seed} as {kept}, which counts")
    return {run: one for run, one in group.items() if run in best.values()}


def _own(configs: Mapping[str, Mapping[str, object]], one: str) -> str:
    """What one of several configurations has that not all have, in a few words."""
    mine = configs[one]
    own = [
        f"{name}={value}"
        for name, value in mine.items()
        if any(str(other.get(name)) != str(value) for other in configs.values())
    ]
    return ", ".join(own[:MOST_NAMED]) + (f" and {len(own) - MOST_NAMED} more" * (len(own) > MOST_NAMED))


def table(group: Mapping[Path, Result], *, apart: str | None) -> str:
    """The table of runs that differ in their seed alone.

    Args:
        group: the runs.
        apart: What their configuration has that those of other tables have not; ``None``: there is one table.
    """
    from franka_wm.report.seeds import cells_told, seeds_table

    found = list(group.values())
    counts = sorted({one.episodes for one in found})
    runs = f"{len(found)} run{'s' * (len(found) > 1)}"
    if apart is not None:
        runs += f" ({', '.join(run.name for run in group)}{apart and f': {apart}'})"
    episodes = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    by = sorted({str(one.protocol.get("by", one.path)) for one in found})
    return (
        f"{runs} of {episodes} episodes each: {cells_told(len(found))}\n"
        f"measured by {' and '.join(by)}; of a run measured twice, its later weights, of these what rests on more "
        f"episodes\n{_apart(found)}\n"
        + seeds_table([one.policies for one in found])
        + "\n" * (apart is not None)
    )


def _apart(found: Sequence[Result]) -> str:
    """A line for each of what should be the same in all runs of one mean, and is not."""
    lines = ""
    for name, what in (("updates", "updates"), ("franka_wm", "versions of franka_wm")):
        values = list(dict.fromkeys(str(one.protocol.get(name, "unknown")) for one in found))
        if len(values) > 1:
            lines += f"note: the runs are of different {what}: {', '.join(values)}\n"
    return lines
