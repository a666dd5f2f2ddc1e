"""How it went: the numbers at the top of a run's page and its section of results; how numbers are written there."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from franka_wm.evaluation.intervals import percent
from franka_wm.evaluation.results import SHOWN, Result
from franka_wm.report import style
from franka_wm.report.bars import bars_figure
from franka_wm.report.document import cards, chart, facts, folded, headed, paragraph, table, tiles, warning
from franka_wm.report.run import RunFiles
from franka_wm.report.table import Table, evaluation_tables, is_interval


def headline(run: RunFiles, warned: Sequence[str]) -> str:
    """Warnings, and the numbers one looks for first."""
    values: list[tuple[str, str, str]] = []
    shown = next((name for name in SHOWN if name in run.policies), None)
    if shown is not None:
        values += _outcome(run.policies[shown], style.policy_name(shown))
    for name, key, write in (
        ("environment steps", "env_steps", _count),
        ("updates", "updates", _count),
        ("training", "seconds", _duration),
    ):
        if key in run.counters:
            values.append((name, write(float(run.counters[key])), ""))
    return Markup().join(map(warning, warned)) + (tiles(values) if values else Markup())


def result(run: RunFiles) -> str:
    """Tables and bars of the first result; the others folded."""
    if not run.results:
        return ""
    shown, *others = run.results
    tables = paragraph(f"Measured by {shown.told}." if others else "")
    tables += _tables(shown, cards(_success_bars(shown.policies), _bars(shown.policies)))
    if run.timing:
        rows = [
            [style.policy_name(name), f"{1000 * one['seconds_per_decision']:.2f}", f"{one['worlds']:g}"]
            for name, one in run.timing.items()
        ]
        header = ["policy", "one decision for all worlds [ms]", "worlds"]
        tables += folded("Time per decision", table(Table(header, rows)))
    tables += _protocol(shown)
    for other in others:
        tables += folded(f"Also measured, by {other.told}", _tables(other) + _protocol(other))
    return tables


def _tables(found: Result, below: str = "") -> Markup:
    outcome, motion = evaluation_tables(found.policies)
    text = table(outcome) + paragraph(style.policy_legend(found.policies), "note") + below
    return text + headed("On the way", table(motion) if motion.rows else "")


def _protocol(found: Result) -> str:
    described = facts((name.replace("_", " "), plain(value)) for name, value in found.protocol.items())
    return folded("How it was evaluated", described)


def _success_bars(policies: Mapping[str, Mapping[str, Any]]) -> str:
    success = success_rates(policies)
    if not success:
        return ""
    distances = sorted({d for rates in success.values() for d in rates if d}, key=float, reverse=True)
    named = {style.policy_name(policy): rates for policy, rates in success.items()}
    near = {
        style.centimetres(distance): {
            name: rates[distance] for name, rates in named.items() if distance in rates
        }
        for distance in distances
    }
    groups = near or {name: {"": rates[""]} for name, rates in named.items()}
    colours = {style.policy_name(name): style.policy_colour(name) for name in policies}
    drawn = bars_figure(groups, label="successful episodes [%]", scale=100, limits=(0, 100), colours=colours)
    what = "this close to the goal" if near else "in success, as the task judges"
    return chart(
        drawn,
        "share of successful episodes of every policy",
        f"Share of episodes that ended {what}; whiskers are 95 % intervals.",
    )


def _bars(policies: Mapping[str, Mapping[str, Any]]) -> str:
    """Final distances; returns where there are none, for they say the same where there are."""
    for key, label, scale, note in (
        ("final_distance", "final distance to the goal [cm]", 100.0, "Shorter is better."),
        ("return", "return of an episode", 1.0, "Further to the right is better."),
    ):
        values = {
            style.policy_name(name): {"": one[key]} for name, one in policies.items() if _known(one.get(key))
        }
        if values:
            colours = {style.policy_name(name): style.policy_colour(name) for name in policies}
            return chart(
                bars_figure(values, label=label, scale=scale, colours=colours),
                f"{label} of every policy",
                note,
            )
    return ""


def _outcome(values: Mapping[str, Any], who: str) -> list[tuple[str, str, str]]:
    """Name, number and remark of what is looked for first: distance, or return, and success."""
    out = []
    distance, returned = values.get("final_distance") or {}, values.get("return") or {}
    if _known(distance):
        digits = 0 if distance["mean"] >= 0.1 else 2  # [m]; shown in cm
        mean, low, high = (f"{100 * distance[k]:.{digits}f}" for k in ("mean", "low", "high"))
        out.append(("final distance", f"{mean} cm", f"{low} – {high}, {who}"))
    elif _known(returned):
        mean, low, high = (f"{returned[k]:.2f}" for k in ("mean", "low", "high"))
        out.append(("return", mean, f"{low} – {high}, {who}"))
    rates = success_rates({who: values}).get(who, {})
    if rates:
        widest = max(rates, key=lambda d: float(d or 0))
        rate = rates[widest]
        out.append(
            (
                f"success at {style.centimetres(widest)}" if widest else "success",
                f"{percent(100 * rate['mean'])} %",
                f"{percent(100 * rate['low'])} – {percent(100 * rate['high'])}, {values.get('episodes', '?')} episodes",
            )
        )
    return out


def _known(value: Any) -> bool:
    return is_interval(value) and None not in value.values()


def success_rates(policies: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """policy -> distance [m] -> rate at the end of an episode, an interval; the task's own under an empty text."""
    out = {}
    for policy, values in policies.items():
        rates = values.get("success")
        rates = {"": rates} if is_interval(rates) else rates
        if isinstance(rates, Mapping):
            kept = {d: rate for d, rate in rates.items() if _known(rate)}
            if kept:
                out[policy] = kept
    return out


# -- texts -----------------------------------------------------------------------------------------------


def plain(value: Any) -> str:
    if is_interval(value):
        return f"{number(value['mean'])} ({number(value['low'])} – {number(value['high'])})"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return number(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {plain(one)}" for name, one in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(map(plain, value))
    return "–" if value is None else str(value)


def number(value: float | None) -> str:
    return f"{value:.4g}" if value is not None and math.isfinite(value) else "not finite"


def _count(number: float) -> str:
    for size, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= size:
            return f"{number / size:.3g}{suffix}"
    return f"{number:.0f}"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
