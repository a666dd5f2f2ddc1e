"""What is read off the runs of a row, and whether it is what was wanted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.results.rows import Row, is_bound
from benchmarks.results.state import Record
from benchmarks.results.times import company, duration, seconds, timed
from franka_wm.errors import UserError
from franka_wm.evaluation.intervals import percent


@dataclass(frozen=True)
class Metric:
    """A column: its title, where a policy's summary holds it, and how it is printed."""

    title: str
    find: Callable[[Mapping[str, Any]], Mapping[str, float]]
    factor: float
    digits: int

    def of(self, record: Record, policy: str, bound: str = "mean") -> float:
        return self.factor * self.find(record["policies"][policy])[bound]

    def show(self, *values: float) -> str:
        first, *others = (
            percent(value) if self.factor == 100 and not self.digits else f"{value:.{self.digits}f}"
            for value in values
        )
        return f"{first} ({' – '.join(others)})" if others else first


def _within(distance: str) -> Callable[[Mapping[str, Any]], Mapping[str, float]]:
    return lambda summary: summary["success"][distance]


DISTANCE = Metric("final distance [cm]", lambda summary: summary["final_distance"], 100, 2)
WITHIN = {
    cm: Metric(f"within {cm} cm [%]", _within(m), 100, 0)
    for cm, m in (("5", "0.05"), ("2.5", "0.025"), ("1", "0.01"))
}
SUCCESS = Metric("success [%]", lambda summary: summary["success"], 100, 0)
RETURN = Metric("return", lambda summary: summary["return"], 1, 0)


def columns(records: Sequence[Record]) -> list[Metric]:
    """Distances of the arm, success of tasks that say what it is, returns of other environments."""
    summaries = [summary for record in records for summary in record["policies"].values()]
    if all("final_distance" in summary for summary in summaries):
        return [DISTANCE, *WITHIN.values()]
    return [SUCCESS, RETURN] if all("success" in summary for summary in summaries) else [RETURN]


def mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def goals_met(row: Row, lines: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, bool]]:
    """For each goal of a benchmark: what, the worst of the lines that it names, and whether that is enough.

    Raises:
        UserError: A goal names no line, or a column that has no numbers.
    """
    found = []
    for goal in row.goals:
        bounds = {column: value for column, value in goal.items() if is_bound(value)}
        named = {column: value for column, value in goal.items() if column not in bounds}
        chosen = [line for line in lines if all(line.get(column) == value for column, value in named.items())]
        for column, bound in bounds.items():
            values = [line.get(column) for line in chosen]
            if not values or not all(isinstance(value, int | float) for value in values):
                raise UserError(f"row {row.name}: no line has {named} and a number in {column!r}")
            least, wanted = bound[0] == "≥", float(bound[1:])
            worst = min(values) if least else max(values)
            which = ", ".join(f"{name} {value}".strip() for name, value in named.items())
            told = f"{which}: {column} {bound[0]} {number(wanted)}".removeprefix(": ")
            found.append((told, number(worst), worst >= wanted if least else worst <= wanted))
    return found


def number(value: float) -> str:
    """As tables of benchmarks show it."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def verdicts(row: Row, records: Sequence[Record]) -> list[tuple[str, str, bool]]:
    """For each thing wanted: what, what was reached, and whether that is enough."""
    found = goals_met(row, records[0]["rows"]) if row.goals else []
    for name, wanted in row.wanted.items():
        policy = row.acting(records[0]["policies"])
        if name == "minutes":
            slowest = max(map(seconds, timed(records, beside=row.beside)))
            reached = duration(slowest) + company(records, beside=row.beside)
            found.append((f"≤ {wanted:g} min of training", reached, slowest <= 60 * wanted))
        elif name == "distance_cm":
            average = mean([DISTANCE.of(record, policy) for record in records])
            found.append((f"≤ {wanted:g} cm on average", f"{average:.2f} cm", average <= wanted))
        elif name == "return":
            average = mean([RETURN.of(record, policy) for record in records])
            found.append((f"return ≥ {wanted:g} on average", f"{average:.0f}", average >= wanted))
        elif name == "success":
            worst = min(SUCCESS.of(record, policy) for record in records)
            found.append((f"worst seed ≥ {wanted:g} %", f"{worst:.1f} %", worst >= wanted - 1e-9))
        elif name == "success_of":
            for task, least in wanted.items():
                worst = min(
                    100 * record["policies"][policy]["task_success"][task]["mean"] for record in records
                )
                found.append((f"worst seed ≥ {least:g} % of {task}", f"{worst:.1f} %", worst >= least - 1e-9))
        else:
            cm = name.removeprefix("within_").removesuffix("cm")
            worst = min(WITHIN[cm].of(record, policy) for record in records)
            found.append(
                (f"worst seed ≥ {wanted:g} % within {cm} cm", f"{worst:.1f} %", worst >= wanted - 1e-9)
            )
    there = records[0].get("policies", {})  # none of a benchmark
    if "policy" in there and row.acting(there) == "planner":
        found.append(_planner_against_policy(records))
    return found


def _planner_against_policy(records: Sequence[Record]) -> tuple[str, str, bool]:
    """Whether planning does harm on some seed: by distance, else success, else return.

    Harm is what lies beyond the 95 % interval of the policy's own episodes; less is named, and no harm.
    """
    metric = columns(records)[0]
    sign, bad, unit = {DISTANCE: (1, "high", " cm"), SUCCESS: (-1, "low", " %")}.get(metric, (-1, "low", ""))
    harmed, within = [], []
    for r in records:
        ours, alone, bound = (metric.of(r, *one) for one in (("planner",), ("policy",), ("policy", bad)))
        told = f"{r['seed']} ({metric.show(ours)}, policy {metric.show(alone)}{unit})"
        if sign * ours > sign * bound:
            harmed.append(told)
        elif sign * ours > sign * alone:
            within.append(told)
    reached = f"{len(records) - len(harmed)} of {len(records)} seeds"
    reached += f"; worse on {', '.join(harmed)}" if harmed else ""
    reached += f"; worse, but within the policy's interval, on {', '.join(within)}" if within else ""
    if metric is not RETURN:
        paid = sum(RETURN.of(r, "planner") >= RETURN.of(r, "policy") for r in records)
        reached += f"; its return is no lower on {paid}"
    return "planner no worse than policy, each seed", reached, not harmed
