"""Tables of an evaluation; they show what there is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from franka_wm.report.style import centimetres, policy_name
from franka_wm.report.table import Table

if TYPE_CHECKING:
    from rich.table import Table as RichTable

# {policy: summary}, as evaluation.json holds it.
type Policies = Mapping[str, Mapping[str, Any]]
# Title, path of the entry in a summary, factor to the title's unit, digits.
type Column = tuple[str, Sequence[str], float, int]


def terminal(table: Table, title: str | None = None) -> RichTable:
    """A table for a rich console."""
    from rich.markup import escape
    from rich.table import Table as RichTable

    rich = RichTable(title=title)
    rich.add_column(escape(table.header[0]))
    for name in table.header[1:]:
        rich.add_column(escape(name), justify="right")  # [cm] would be taken for a style
    for row in table.rows:
        rich.add_row(*map(escape, row))
    return rich


def interval(value: Mapping[str, float], scale: float = 1.0, digits: int = 2) -> str:
    """`mean (low – high)`."""
    mean, low, high = (f"{scale * value[name]:.{digits}f}" for name in ("mean", "low", "high"))
    return f"{mean} ({low} – {high})"


def number(value: float | None, digits: int = 2) -> str:
    """A number, or a dash for what is not defined."""
    return "–" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def outcome_table(policies: Policies) -> Table:
    """How episodes ended: distance, success, return; of other environments return and length."""
    distances = _distances(policies, "success")
    columns: list[Column] = [("final distance [cm]", ("final_distance",), 100, 2)]
    columns += [(f"success at {centimetres(d)} [%]", ("success", d), 100, 0) for d in distances]
    columns.append(("return", ("return",), 1, 2))
    if not distances:
        columns.append(("length [steps]", ("length",), 1, 1))
    return _table(policies, columns, count=True)


def motion_table(policies: Policies) -> Table:
    """How it went on the way: success at any step, the tool's path, smoothness. No rows where none was measured."""
    distances = _distances(policies, "success_once")
    columns: list[Column] = [
        (f"once at {centimetres(d)} [%]", ("success_once", d), 100, 0) for d in distances
    ]
    columns += [
        ("path [cm]", ("path_length",), 100, 1),
        ("change of action²", ("action_change",), 1, 3),
        ("jerk [m/s³]", ("jerk",), 1, 1),
    ]
    table = _table(policies, columns)
    return table if len(table.header) > 1 else Table(table.header, [])


def timing_table(seconds: Mapping[str, float], worlds: int) -> Table:
    """How long decisions take."""
    header = ["policy", f"decision of {worlds} worlds [ms]", "per world [µs]"]
    rows = [[policy_name(p), f"{1e3 * s:.2f}", f"{1e6 * s / worlds:.1f}"] for p, s in seconds.items()]
    return Table(header, rows)


def horizon_table(result: Mapping[str, Any], horizons: Sequence[int] = (1, 2, 3, 5, 10, 20)) -> Table:
    """Open-loop error by horizon, of :func:`~franka_wm.evaluation.open_loop.horizon_error`."""
    curve, steps = result["curves"]["model"], result["steps"]
    cells = [
        interval({name: curve[name][i] for name in ("mean", "low", "high")}, 1, 3)
        for i, h in enumerate(steps)
        if h in horizons
    ]
    header = ["steps ahead", *[str(h) for h in steps if h in horizons]]
    return Table(header, [["error / error of no change", *cells]])


def probe_table(results: Mapping[str, Mapping[str, Any]]) -> Table:
    """R² of the probes."""
    rows = [[name, number(r["ridge"]), number(r["neighbours"])] for name, r in results.items()]
    return Table(["R² of what is read off the latent", "ridge", "nearest neighbours"], rows)


def robustness_table(
    results: Mapping[str, Mapping[str, Mapping[str, Any]]], success_distance: float
) -> Table:
    """What breaks under which shift, of :func:`franka_wm.evaluation.robustness.robustness`."""
    success = f"success at {centimetres(success_distance)} [%]"
    header = ["shift", "policy", "final distance [cm]", "change [cm]", success, "verdict"]
    rows = []
    for shift, policies in results.items():
        for policy, r in policies.items():
            change = "" if r["change"] is None else interval(r["change"], 100)
            cells = [interval(r["final_distance"], 100), change, interval(r["success"], 100, 0)]
            rows.append([shift, policy_name(policy), *cells, r["verdict"]])
    return Table(header, rows)


def _distances(policies: Policies, name: str) -> list[str]:
    """Thresholds of a rate, largest first: the order in which they get harder."""
    found = {d for summary in policies.values() for d in summary.get(name, {})}
    return sorted(found, key=float, reverse=True)


def _find(summary: Any, path: Sequence[str]) -> Any:
    for step in path:
        summary = summary.get(step) if isinstance(summary, Mapping) else None
    return summary


def _table(policies: Policies, columns: Sequence[Column], *, count: bool = False) -> Table:
    used = [c for c in columns if any(_find(summary, c[1]) is not None for summary in policies.values())]
    rows = []
    for policy, summary in policies.items():
        found = [(_find(summary, path), scale, digits) for _, path, scale, digits in used]
        cells = ["–" if value is None else interval(value, scale, digits) for value, scale, digits in found]
        rows.append([policy_name(policy), *cells, *([str(summary["episodes"])] if count else [])])
    return Table(["policy", *[name for name, *_ in used], *(["episodes"] if count else [])], rows)
