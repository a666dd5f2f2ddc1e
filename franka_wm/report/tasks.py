"""Tasks by families of models: how often the runs of each family succeed at each task."""

from __future__ import annotations

from collections.abc import Mapping

from franka_wm.evaluation.results import SHOWN, loggable
from franka_wm.report import style
from franka_wm.report.curves import TASK
from franka_wm.report.outcome import success_rates
from franka_wm.report.run import RunFiles
from franka_wm.report.table import Table, is_interval

MISSING, MULTITASK = "–", "multitask"


def tasks_table(groups: Mapping[str, Mapping[str, RunFiles]]) -> Table | None:
    """One row for each task, one column for each family; None where all runs share both.

    A cell is the mean over a group of runs, and their lowest and highest; where several groups share a cell each has
    its own, after its name: they differ in more than their seed. Shown is the success of the planner, or of the policy
    where no planner was measured; the return where a task does not say what success is. Of several distances the
    largest counts. A run of several tasks at once has a cell for each, in a column of its own beside that of runs of
    one task.

    Args:
        groups: name -> runs that differ in their seed alone.
    """
    cells: dict[str, dict[str, dict[str, list[tuple[str, float]]]]] = {}
    for name, group in groups.items():
        for run in group.values():
            found = _outcome(run)
            for task, one in (_by_task(run) or ({} if found is None else {task_of(run): found})).items():
                cells.setdefault(task, {}).setdefault(family_of(run), {}).setdefault(name, []).append(one)
    families = sorted({family for row in cells.values() for family in row})
    if len(cells) < 2 and len(families) < 2:
        return None
    rows = [
        [task, *(_cell(row[family]) if family in row else MISSING for family in families)]
        for task, row in sorted(cells.items())
    ]
    return Table(["task", *families], rows)


def task_of(run: RunFiles) -> str:
    """The task that was typed, else the preset, else the configuration's task; of other libraries with its domain.

    A preset that is called otherwise than its task, or whose task an experiment changed, stands behind it.
    """
    env = run.config.get("env")
    env = env if isinstance(env, Mapping) else {}
    domain, task = env.get("name"), env.get("task")
    if not env and run.results:  # a folder of results alone
        return str(run.results[0].protocol.get("task", MISSING))
    if domain:
        return f"{domain} {task}" if task else str(domain)
    if task and any(one.lstrip("+").startswith("env.task=") for one in run.overrides):
        return str(task)
    if typed := [one.removeprefix("env=") for one in run.overrides if one.startswith("env=")]:
        return typed[-1]
    if run.preset and task and str(task) not in run.preset.split("_"):
        return f"{task} ({run.preset})"
    return run.preset or str(task or MISSING)


def family_of(run: RunFiles) -> str:
    """The name of its model, whether it learned several tasks at once, and how it planned if not as in training."""
    model, told = run.config.get("model"), run.results[0].protocol if run.results else {}
    name = model.get("name") if isinstance(model, Mapping) else told.get("model")  # of results alone
    parts = [name or MISSING, *([MULTITASK] if _by_task(run) else ())]
    return ", ".join(map(str, [*parts, *([run.otherwise] if run.otherwise else ())]))


def success_over_time(run: RunFiles) -> dict[str, str]:
    """Task -> the key under which its success while training was logged, of the policy that is shown first."""
    logged = {key for row in run.rows for key in row}
    ends = {f"{TASK}{loggable(task)}": task for task in _by_task(run)} or {"success": task_of(run)}
    return {
        task: key
        for end, task in ends.items()
        if (key := next((k for name in SHOWN if (k := f"eval/{name}/{end}") in logged), None))
    }


def _by_task(run: RunFiles) -> dict[str, tuple[str, float]]:
    """How well a run of several tasks at once does each; none for a run of one."""
    policy = next((name for name in SHOWN if name in run.policies), None)
    rates = {} if policy is None else run.policies[policy].get("task_success")
    if not isinstance(rates, Mapping):
        return {}
    return {str(task): ("%", 100.0 * rate["mean"]) for task, rate in rates.items() if is_interval(rate)}


def _outcome(run: RunFiles) -> tuple[str, float] | None:
    """What is measured, and how well it went; None where nothing was."""
    policy = next((name for name in SHOWN if name in run.policies), None)
    if policy is None:
        return None
    rates = success_rates(run.policies).get(policy, {})
    if rates:
        distance = max(rates, key=lambda d: float(d or 0.0))
        within = f" within {style.centimetres(distance)}" if distance else ""
        return f"%{within}", 100.0 * rates[distance]["mean"]
    returned = run.policies[policy].get("return") or {}
    return ("return", returned["mean"]) if is_interval(returned) else None


def _cell(groups: Mapping[str, list[tuple[str, float]]]) -> str:
    told = {name: _mean(found) for name, found in groups.items()}
    return (
        "; ".join(f"{name}: {one}" for name, one in told.items())
        if len(told) > 1
        else next(iter(told.values()))
    )


def _mean(found: list[tuple[str, float]]) -> str:
    units = sorted({unit for unit, _ in found})
    if len(units) > 1:
        return f"measured as {' and '.join(units)}"
    values = [value for _, value in found]
    digits = 0 if units[0].startswith("%") else 1
    mean = f"{sum(values) / len(values):.{digits}f}"
    spread = (
        f" ({min(values):.{digits}f} – {max(values):.{digits}f}, {len(values)} runs)"
        if len(values) > 1
        else ""
    )
    return f"{mean} %{spread}{units[0][1:]}" if units[0].startswith("%") else f"return {mean}{spread}"
