"""Several runs in one table: the mean over seeds, and the lowest and highest."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from franka_wm.errors import UserError
from franka_wm.report.run import but_for_the_seed, read_config

COLUMNS = (
    ("return", lambda r: r["return"]["mean"], 2),
    ("final distance [cm]", lambda r: 100 * r["final_distance"]["mean"], 2),
    ("within 5 cm [%]", lambda r: 100 * r["success"]["0.05"]["mean"], 0),
    ("within 2.5 cm [%]", lambda r: 100 * r["success"]["0.025"]["mean"], 0),
    ("within 1 cm [%]", lambda r: 100 * r["success"]["0.01"]["mean"], 0),
)


def read_evaluation(run: str | Path) -> dict[str, Any]:
    """The ``evaluation.json`` of a run's folder.

    Raises:
        UserError: There is none, or it is not one.
    """
    path = Path(run) / "evaluation.json"
    try:
        found = json.loads(path.read_text())
        return found.get("policies", found)  # as training leaves it, or as `franka-wm evaluate` does
    except FileNotFoundError as error:
        raise UserError(f"{run}: no evaluation.json; give folders of runs that were finished") from error
    except (OSError, json.JSONDecodeError) as error:
        raise UserError(
            f"{path}: cannot be read ({error}); give folders of runs that were finished"
        ) from error


def runs_of(folder: str | Path) -> list[Path]:
    """The runs of a Hydra sweep (``train.py --multirun``), in the order in which they ran; else the folder itself.

    Raises:
        UserError: The sweep has no runs.
    """
    folder = Path(folder)
    if not (folder / "multirun.yaml").is_file():
        return [folder]
    runs = {path: path.name.split("-")[0] for path in folder.iterdir() if path.is_dir()}
    numbered = sorted((int(number), path) for path, number in runs.items() if number.isdecimal())
    if not numbered:
        raise UserError(f"{folder}: a sweep without runs; give folders of runs that were finished")
    return [path for _, path in numbered]


def seeds_table(evaluations: Sequence[Mapping[str, Any]]) -> str:
    """Markdown: one row per policy, `mean over runs (lowest – highest)` in every cell."""
    policies = [p for p in evaluations[0] if all(p in e for e in evaluations)]
    # Other environments than the arm have returns alone; of the arm, distances say more.
    reaches = all("final_distance" in e[p] for e in evaluations for p in policies)
    columns = COLUMNS[1:] if reaches else COLUMNS[:1]
    lines = [
        "| policy | " + " | ".join(name for name, _, _ in columns) + " |",
        "|---|" + "---:|" * len(columns),
    ]
    for policy in policies:
        cells = []
        for _, value, digits in columns:
            values = [value(e[policy]) for e in evaluations]
            low, high = min(values), max(values)
            mean = f"{sum(values) / len(values):.{digits}f}"
            cells.append(mean if len(values) == 1 else f"{mean} ({low:.{digits}f} – {high:.{digits}f})")
        lines.append(f"| {policy} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def summary(arguments: list[str]) -> None:
    """``franka-wm summary RUN RUN …`` or ``franka-wm summary SWEEP``: runs of different seeds in one table.

    Runs that differ in more than their seed get a table for each configuration.
    """
    if not arguments or arguments[0].startswith("-"):
        raise UserError(
            "summary needs folders of runs: franka-wm summary outputs/RUN outputs/RUN …, or multirun/SWEEP"
        )
    groups: dict[str, dict[Path, dict[str, Any]]] = {}
    for folder in arguments:
        for run in runs_of(folder):
            groups.setdefault(but_for_the_seed(read_config(run)), {})[run] = read_evaluation(run)
    for group in groups.values():
        evaluations = list(group.values())
        first = next(iter(evaluations[0].values()))
        runs = f"{len(evaluations)} run{'s' * (len(evaluations) > 1)}"
        if len(groups) > 1:
            runs += f" ({', '.join(run.name for run in group)})"
        print(f"{runs} of {first['episodes']} episodes each: mean over runs (lowest – highest run)\n")
        print(seeds_table(evaluations))
        if len(groups) > 1:
            print()
