"""Several runs in one table: the mean over seeds, its interval, and the lowest and highest."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from franka_wm.errors import UserError
from franka_wm.evaluation.intervals import bootstrap_mean, scaled
from franka_wm.evaluation.results import Result, results
from franka_wm.report.style import centimetres
from franka_wm.untrusted import UntrustedFolder

ENOUGH = 3
"""Fewest runs whose mean gets an interval."""


def read_evaluation(run: str | Path) -> Result:
    """What was measured of a run: of several results that of the latest weights, of these the one with most episodes.

    Raises:
        UserError: There is none, or it cannot be read.
    """
    found = results(run)
    if not found:
        missing = "no evaluation.json" if Path(run).is_dir() else "no such folder"
        raise UserError(f"{run}: {missing}; give folders of runs that were finished")
    return found[0]


def runs_of(folder: str | Path) -> list[Path]:
    """The runs of a Hydra sweep (``train.py --multirun``), in the order in which they ran; else the folder itself.

    Raises:
        UserError: The sweep has no runs, or one that is a link out of it.
    """
    folder = Path(folder)
    if not (folder / "multirun.yaml").is_file():
        return [folder]
    runs = {path: path.name.split("-")[0] for path in folder.iterdir() if path.is_dir()}
    for path in runs:
        UntrustedFolder(folder).below(path.name)
    numbered = sorted((int(number), path) for path, number in runs.items() if number.isdecimal())
    if not numbered:
        raise UserError(f"{folder}: a sweep without runs; give folders of runs that were finished")
    return [path for _, path in numbered]


def evaluated(folder: str | Path, say: Callable[[str], object]) -> list[Path]:
    """The runs of a folder, see :func:`runs_of`. Of several, those without a result are named and left out."""
    runs = runs_of(folder)
    missing = [run for run in runs if len(runs) > 1 and not results(run)]
    if not 0 < len(missing) < len(runs):
        return runs
    names = ", ".join(run.name for run in missing)
    say(f"{len(missing)} of {len(runs)} runs have no result (yet; train.log says more): {names}\n")
    return [run for run in runs if run not in missing]


def cells_told(runs: int) -> str:
    """What the cells of :func:`seeds_table` hold of so many runs."""
    if runs < ENOUGH:
        return "mean over runs (lowest – highest run)"
    return "mean over runs (its bootstrap 95 % interval over seeds); below, lowest – highest run"


def seeds_table(evaluations: Sequence[Mapping[str, Any]]) -> str:
    """Markdown: one row per policy, `mean over runs (lowest – highest)` in every cell.

    From :data:`ENOUGH` runs on, `mean (low – high)` of a percentile bootstrap that draws runs, since the episodes of
    one run share its weights; a second row has the lowest and highest run.
    """
    policies = [p for p in evaluations[0] if all(p in e for e in evaluations)]
    columns = _columns(evaluations[0][policies[0]])
    lines = [
        "| policy | " + " | ".join(name for name, *_ in columns) + " |",
        "|---|" + "---:|" * len(columns),
    ]
    for policy in policies:
        cells, ranges = [], []
        for _, path, scale, digits in columns:
            values = [_mean(e[policy], path) for e in evaluations]
            mean, low, high, least, most = (
                scaled(x, scale, digits) for x in (*bootstrap_mean(values), min(values), max(values))
            )
            ranges.append(f"{least} – {most}")
            spread = f"{low} – {high}" if len(values) >= ENOUGH else ranges[-1]
            cells.append(mean + f" ({spread})" * (len(values) > 1))
        lines.append(f"| {policy} | " + " | ".join(cells) + " |")
        if len(evaluations) >= ENOUGH:
            lines.append("| | " + " | ".join(ranges) + " |")
    return "\n".join(lines)


def _columns(summary: Mapping[str, Any]) -> list[tuple[str, tuple[str, ...], float, int]]:
    """Title, path, factor to the title's unit and digits of what is shown of a summary.

    Distances, and success within them, where the task has them, else success as it judges, return, its own measures.
    """
    success = summary.get("success") or {}
    distance = [("final distance [cm]", ("final_distance",), 100.0, 2)] if "final_distance" in summary else []
    if distance and "mean" not in success:
        within = sorted(success, key=float, reverse=True)
        return [*distance, *((f"within {centimetres(d)} [%]", ("success", d), 100.0, 0) for d in within)]
    rates = [("success [%]", ("success",), 100.0, 0)] if success else []
    rates += [(f"{name} [%]", ("task_success", name), 100.0, 0) for name in summary.get("task_success") or {}]
    own = [(name, ("measures", name), 1.0, 3) for name in summary.get("measures") or {}]
    return [*distance, *rates, ("return", ("return",), 1.0, 2), *own]


def _mean(summary: Any, path: Sequence[str]) -> float:
    for name in path:
        summary = summary[name]
    return summary["mean"]
