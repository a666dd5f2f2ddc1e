"""Tables of what ``franka-wm evaluate`` finds besides the outcome; that is of :mod:`franka_wm.report.table`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from franka_wm.evaluation.intervals import scaled
from franka_wm.evaluation.protocol import INTERVALS, Evaluation
from franka_wm.report.style import centimetres, policy_legend, policy_name
from franka_wm.report.table import Table, evaluation_tables, markdown

if TYPE_CHECKING:
    from rich.table import Table as RichTable


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


def evaluation_markdown(found: Evaluation) -> str:
    """The tables of the policies, and under them how they were measured."""
    parts = [markdown(table) for table in evaluation_tables(found.policies) if table.rows]
    parts += [f"{legend}\n"] if (legend := policy_legend(found.policies)) else []
    count = next(iter(found.policies.values()))["episodes"]
    seeds = ", ".join(map(str, found.seeds))
    worlds = f" of {found.worlds} worlds" if found.worlds else ""
    parts.append(
        f"{count} episodes per policy, the same for all, on held-out seeds ({seeds}){worlds}.\n{INTERVALS}\n"
    )
    return "\n".join(parts)


def interval(value: Mapping[str, float], scale: float = 1.0, digits: int = 2) -> str:
    """`mean (low – high)`."""
    mean, low, high = (scaled(value[name], scale, digits) for name in ("mean", "low", "high"))
    return f"{mean} ({low} – {high})"


def number(value: float | None, digits: int = 2) -> str:
    """A number, or a dash for what is not defined."""
    return "–" if value is None or math.isnan(value) else f"{value:z.{digits}f}"


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
    reaches = any("final_distance" in r for policies in results.values() for r in policies.values())
    if reaches:
        what, change, scale = ["final distance [cm]", "change [cm]"], ("final_distance", "change"), 100
        success = f"success at {centimetres(success_distance)} [%]"
    else:
        what, change, scale, success = ["return", "change"], ("return", "return_change"), 1, "success [%]"
    rows = []
    for shift, policies in results.items():
        for policy, r in policies.items():
            cells = ["" if r[name] is None else interval(r[name], scale) for name in change]
            ended = f"{r['verdict']} ({r['cut_short']} cut short)" if r.get("cut_short") else r["verdict"]
            rows.append([shift, policy_name(policy), *cells, interval(r["success"], 100, 0), ended.strip()])
    return Table(["shift", "policy", *what, success, "verdict"], rows)


def diagnostic_tables(results: Mapping[str, Any], config: Any) -> dict[str, Table]:
    """Title → table, of what there is in the results besides the policies."""
    tables = {}
    if "curves" in results.get("open_loop", {}):
        tables["Open loop: error of predicted latents"] = horizon_table(results["open_loop"])
    if results.get("probes"):
        tables["Probes"] = probe_table(results["probes"])
    found = findings(results)
    if found:
        tables["What else was found"] = Table(
            ["quantity", "value"], [[name, text] for name, text in found.items()]
        )
    if results.get("robustness"):
        few = results.get("protocol", {}).get("robustness note")
        tables["Robustness" + (f" ({few})" if few else "")] = robustness_table(
            results["robustness"], config.success_distance
        )
    return tables


def findings(results: Mapping[str, Any]) -> dict[str, str]:
    """Single numbers as text: ranks, calibration, planner, spectrum."""
    out: dict[str, str] = {}
    ahead, value, health = (results.get(name, {}) for name in ("open_loop", "calibration", "health"))
    if "not_measured" in ahead:
        out["open loop, not measured"] = ahead["not_measured"]
    if "rank_correlation" in ahead:
        out["rank correlation of latent cost and tool distance, within episodes"] = interval(
            ahead["rank_correlation"]
        )
        out["… across episodes"] = interval(ahead["rank_correlation_across_episodes"])
    if "decoder" in ahead:
        errors = ahead["decoder"]
        share = errors["error"] / max(errors["mean_image"], 1e-12)
        out["decoder's error / that of the mean image"] = number(share)
    if "not_measured" in value:
        out["value calibration, not measured"] = value["not_measured"]
    elif value:
        line = f"return = {number(value['slope'])} · value + {number(value['intercept'])}".replace(
            "+ -", "− "
        )
        out["value calibration (exact: 1, 0)"] = line
        out["… bias, value − return"] = number(value["bias"])
        out["… correlation"] = number(value["correlation"])
    out |= {
        name: interval(found, 1, 3) if isinstance(found, Mapping) else f"{found:.4g}"
        for name, found in health.items()
        if name != "warnings"
    }
    spectrum = results.get("spectrum", {})
    for name in ("rankme", "effective_rank", "feature_std", "mean_cosine", "dimensions"):
        if name in spectrum:
            out[f"latents: {name.replace('_', ' ')}"] = f"{spectrum[name]:.4g}"
    if spectrum:
        out["latents: collapse"] = spectrum["warning"] or "no sign of it"
    return out
