"""Several runs on one page: results side by side, curves over each other, and what was configured differently."""

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from franka_wm.errors import UserError
from franka_wm.evaluation.results import OTHERWISE, SHOWN, Result
from franka_wm.options import leaves
from franka_wm.report import style
from franka_wm.report.bars import bars_figure
from franka_wm.report.curves import panels, quantity, seeds_figure
from franka_wm.report.document import (
    Section,
    cards,
    chart,
    commands,
    document,
    folded,
    headed,
    paragraph,
    table,
)
from franka_wm.report.horizon import horizon_figure
from franka_wm.report.run import RunFiles, as_asked, but_for_the_seed, malformed
from franka_wm.report.sections import logged_name
from franka_wm.report.spectra import spectrum_figure
from franka_wm.report.table import Table, evaluation_tables, is_interval
from franka_wm.report.tasks import family_of, success_over_time, task_of, tasks_table

MISSING = "–"


def compare_page(runs: Sequence[RunFiles]) -> str:
    """The page of several runs as HTML.

    Raises:
        UserError: fewer than two runs.
    """
    if len(runs) < 2:
        raise UserError(
            f"compare needs at least two runs, got {len(runs)}: franka-wm compare outputs/RUN outputs/RUN"
        )
    with malformed(*(run.folder for run in runs)):
        named = dict(zip(unique_names(runs), runs, strict=True))
        different = differences({name: as_asked(run.config) for name, run in named.items()})
        groups = repetitions(named)
        parts = [
            Section("tasks", "Tasks and families", _tasks(groups)),
            Section("result", "Results", _results(named)),
            Section("curves", "Learning curves", _curves(groups)),
            Section("horizon", "Open loop", _horizons(named)),
            Section("latents", "Latent space", _spectra(named)),
            Section("config", "What differs", _differences(different, list(named))),
            Section("reproduce", "Reproduce", _reproduce(runs)),
        ]
    count = f"{len(runs)} runs" + (f" in {len(groups)} groups" if len(groups) < len(runs) else "")
    return document(
        "Runs compared",
        subtitle=f"{count}: {', '.join(named)}",
        sections=parts,
        below="Written by franka_wm.",
    )


def unique_names(runs: Sequence[RunFiles]) -> list[str]:
    """Names that tell the runs apart: as much of the end of each path as it takes.

    Raises:
        UserError: the same run twice.
    """
    paths = [run.folder.parts for run in runs]
    if len(set(paths)) < len(paths):
        raise UserError("the same run is given twice; give each folder once.")
    depth = 1
    while len({path[-depth:] for path in paths}) < len(paths):
        depth += 1
    return ["/".join(path[-depth:]) for path in paths]


def differences(configs: Mapping[str, Mapping[str, object]]) -> dict[str, dict[str, object]]:
    """Entries that are not the same in all runs.

    Args:
        configs: run -> configuration.

    Returns:
        entry -> run -> value; a run that lacks the entry is not there.
    """
    flat = {name: leaves(config) for name, config in configs.items()}
    entries = dict.fromkeys(entry for values in flat.values() for entry in values)
    out = {}
    for entry in entries:
        having = {name: values[entry] for name, values in flat.items() if entry in values}
        if all(value is None for value in having.values()):  # null is not given
            continue
        # As text: 1 and True and 1.0 are not the same in a configuration.
        if len(having) < len(flat) or len({json.dumps(v, default=str) for v in having.values()}) > 1:
            out[entry] = having
    return out


def repetitions(runs: Mapping[str, RunFiles]) -> dict[str, dict[str, RunFiles]]:
    """Runs grouped by configuration, each of another seed; a group is called by its run, or by the first of them."""
    groups: dict[str, dict[str, RunFiles]] = {}
    for name, run in runs.items():
        # Runs without a configuration are known to be the same as nothing.
        alike = but_for_the_seed(run.config) or name
        if run.elsewhere:  # of a run that may be here, too, or that was evaluated twice: not another run
            alike += " elsewhere"
        # The second run of a seed is in a second group: what was repeated, or measured twice, is no other seed.
        while run.seed is not None and any(one.seed == run.seed for one in groups.get(alike, {}).values()):
            alike += " again"
        groups.setdefault(alike, {})[name] = run
    return {next(iter(group)): group for group in groups.values()}


# -- sections --------------------------------------------------------------------------------------------


def _tasks(groups: Mapping[str, Mapping[str, RunFiles]]) -> str:
    found = tasks_table(groups)
    if found is None:
        return ""
    note = (
        "Success, or return, of the planner (of the policy where there is none): mean over runs that differ in their "
        "seed alone (lowest – highest)."
    )
    curves: dict[str, dict[str, list[list[dict[str, float]]]]] = {}
    for name, group in groups.items():
        for run in group.values():
            for task, key in success_over_time(run).items():
                rows = [{**row, "success": row[key]} for row in run.rows if key in row]
                curves.setdefault(task, {}).setdefault(f"{name} ({family_of(run)})", []).append(rows)
    drawn = []
    for task, lines in sorted(curves.items()):
        x = _axis([rows for runs in lines.values() for rows in runs])
        if x is not None:
            figure = seeds_figure(lines, "success", x=x, title=f"{task}: successful episodes [%]")
            drawn.append(chart(figure, f"success at {task} while training"))
    return table(found) + paragraph(note, "note") + cards(*drawn)


def _results(runs: Mapping[str, RunFiles]) -> str:
    policies = list(dict.fromkeys(policy for run in runs.values() for policy in run.policies))
    body, rest = Markup(), Markup()
    ends = [run.policies.get(name, {}).get("final_distance") for run in runs.values() for name in SHOWN]
    highs = [100.0 * end["high"] for end in ends if end and is_interval(end) and end["high"] is not None]
    longest = max(filter(math.isfinite, highs), default=0.0)
    for policy in sorted(policies, key=lambda name: SHOWN.index(name) if name in SHOWN else len(SHOWN)):
        having = {name: run.policies[policy] for name, run in runs.items() if policy in run.policies}
        if policy not in SHOWN:
            having = _once(having)
        tables = [
            table(Table(["run", *found.header[1:]], found.rows))
            for found in evaluation_tables(having)
            if found.rows
        ]
        text = headed(style.policy_name(policy), Markup().join(tables))
        if policy not in SHOWN:
            rest += text
            continue
        distances = {
            name: {"": values["final_distance"]}
            for name, values in having.items()
            if is_interval(values.get("final_distance"))
        }
        drawn = Markup()
        if distances:
            colours = dict.fromkeys(distances, style.policy_colour(policy))
            drawn = chart(
                bars_figure(
                    distances,
                    label="final distance to the goal [cm]",
                    scale=100,
                    limits=(0.0, 1.05 * longest) if longest > 0 else None,  # the same for all policies
                    colours=colours,
                ),
                f"final distance of {style.policy_name(policy)} in every run",
                "Shorter is better; whiskers are 95 % intervals over episodes.",
            )
        body += text + cards(drawn)
    return body + folded("Baselines", rest) + _measured(runs)


def _once(values: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Equal numbers once, after the names of all runs that have them: a baseline is the same on the same episodes."""
    names: dict[str, list[str]] = {}
    for name, numbers in values.items():
        names.setdefault(json.dumps(numbers, sort_keys=True, default=str), []).append(name)
    return {", ".join(same): values[same[0]] for same in names.values()}


def _told(result: Result) -> str:
    otherwise = result.protocol.get(OTHERWISE)
    return f"{result.told}, planned with {otherwise}" if otherwise else result.told


def _measured(runs: Mapping[str, RunFiles]) -> str:
    """By whom, where a run was measured more than once, or planned otherwise: shown is the first."""
    found = [one for run in runs.values() for one in run.results]
    if all(len(run.results) < 2 for run in runs.values()) and not any(
        OTHERWISE in one.protocol for one in found
    ):
        return ""
    rows = [
        [name, _told(run.results[0]), "; ".join(map(_told, run.results[1:])) or MISSING]
        for name, run in runs.items()
        if run.results
    ]
    return table(Table(["run", "measured by", "also measured by"], rows), kind="texts")


def _curves(groups: Mapping[str, Mapping[str, RunFiles]]) -> str:
    """Each task apart: a return or a loss of one says nothing beside that of another."""
    logged = {name: group for name, group in groups.items() if any(run.rows for run in group.values())}
    without = [name for group in groups.values() for name, run in group.items() if not run.rows]
    note = paragraph(f"Without curves, since nothing was logged: {', '.join(without)}." if without else "")
    x = _axis([run.rows for group in logged.values() for run in group.values() if run.rows])
    if x is None:
        return ""
    tasks: dict[str, dict[str, list[list[dict[str, float]]]]] = {}
    for name, group in logged.items():
        task = task_of(next(iter(group.values())))
        tasks.setdefault(task, {})[name] = [run.rows for run in group.values()]
    runs = [run for group in logged.values() for run in group.values()]
    told = {key for run in runs for key in success_over_time(run).values() if not key.endswith("/success")}
    drawn = []
    for task, rows in sorted(tasks.items()):
        drawn += _drawn(rows, x, task if len(tasks) > 1 else "", told)
    return note + cards(*drawn)


def _drawn(
    groups: Mapping[str, Sequence[Sequence[Mapping[str, float]]]], x: str, task: str, told: set[str]
) -> list[Markup]:
    """Charts of what the groups logged, but for the keys `told`; `task` is named where there are several."""
    logged = [row for runs in groups.values() for rows in runs for row in rows]
    found = {key for row in logged for key in row} - told
    many = any(len(runs) > 1 for runs in groups.values())
    bands = "Mean over runs that differ in their seed alone; bands from lowest to highest." if many else ""
    drawn = []
    for key in [_best(found, panel) for panel in panels(logged)] + ["loss"]:
        if key in found:
            who = "" if key.count("/") < 2 else f"Of {style.policy_name(key.split('/')[1])}. "
            title = f"{task}: {quantity(key.rsplit('/', 1)[-1])[0]}" if task else None
            of = f"{logged_name(key)[0]}, of all runs{f' of {task}' if task else ''}"
            figure = seeds_figure(groups, key, x=x, title=title)
            drawn.append(chart(figure, f"{of} while training", f"{who}{bands}".strip()))
    return drawn


def _axis(logs: Sequence[Sequence[Mapping[str, float]]]) -> str | None:
    """What the curves of all runs can be drawn against: environment steps, or updates where one of them makes none."""
    for key in ("env_steps", "updates") if logs else ():
        there = all(key in row for rows in logs for row in rows)
        if there and all(any(row[key] for row in rows) for rows in logs):
            return key
    return None


def _best(keys: set[str], quantity: str) -> str:
    """The evaluation of the planner if it was logged, else of another policy, else what was seen while collecting."""
    having = [key for key in keys if key.rsplit("/", 1)[-1] == quantity]
    order = [f"eval/{policy}/{quantity}" for policy in SHOWN]
    return min(
        having,
        key=lambda key: (order.index(key) if key in order else len(order), key.startswith("train"), key),
        default="",
    )


def _horizons(runs: Mapping[str, RunFiles]) -> str:
    curves, unit = {}, "error"
    for name, run in runs.items():
        found = run.extras.get("open_loop") or {}
        if found.get("curves", {}).get("model"):
            curves[name] = found["curves"]["model"]
            unit = found.get("unit", unit)
    lengths = {len(curve["mean"]) for curve in curves.values()}
    if not curves:
        return ""
    shortest = min(lengths)  # runs may have been looked at over other horizons
    cut = {
        name: {part: values[:shortest] for part, values in curve.items()} for name, curve in curves.items()
    }
    return cards(
        chart(
            horizon_figure(cut, unit=unit), "prediction error by steps ahead in every run", "Lower is better."
        )
    )


def _spectra(runs: Mapping[str, RunFiles]) -> str:
    spectra = {
        name: run.extras["spectrum"]["singular_values"]
        for name, run in runs.items()
        if (run.extras.get("spectrum") or {}).get("singular_values")
    }
    if not spectra:
        return ""
    return cards(chart(spectrum_figure(spectra), "singular values of the latents in every run"))


def _differences(different: Mapping[str, Mapping[str, object]], names: Sequence[str]) -> str:
    if not different:
        return paragraph("Nothing: the configurations are the same.")
    rows = [
        [entry, *(_text(values[name]) if name in values else MISSING for name in names)]
        for entry, values in different.items()
    ]
    return table(Table(["entry", *names], rows), kind="texts")


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _reproduce(runs: Sequence[RunFiles]) -> str:
    return commands([f"franka-wm compare {shlex.join(str(run.folder) for run in runs)}"])
