"""Bars with intervals: success rates, probes, what breaks under which change."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from franka_wm.errors import UserError
from franka_wm.report import style
from franka_wm.report.figure import as_label, finish_axes, new_figure, shortened
from franka_wm.report.style import INK, LIGHT, PAPER, Theme

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

type Bar = float | Mapping[str, object] | None
"""A number, or an interval ``{"mean", "low", "high"}``."""


def bars_figure(
    values: Mapping[str, Mapping[str, Bar]],
    *,
    label: str = "",
    scale: float = 1.0,
    limits: tuple[float, float] | None = None,
    colours: Mapping[str, str] | None = None,
    theme: Theme = LIGHT,
) -> "Figure":
    """Lying bars in groups, with a whisker from low to high: names stay readable however long they are.

    Args:
        values: group (from top to bottom) -> series -> number or interval. What is missing, None or not finite
            leaves a gap.
        label: of the horizontal axis.
        scale: what all values are multiplied with, such as 100 for percent.
        limits: of the horizontal axis, after scaling. A bar that goes beyond has an arrow and its number there.
            Without them, and with one series, every bar has its number: the shortest can hardly be seen.
        colours: series, or group where there is one series only -> light colour; others take the palette in order.

    Raises:
        UserError: nothing to draw.
    """
    from matplotlib.patheffects import withStroke

    values = {
        name: {series: bar for series, bar in group.items() if _known(bar)} for name, group in values.items()
    }
    series = list(dict.fromkeys(name for group in values.values() for name in group))
    if not series:
        raise UserError("no bar to draw; give at least one group with one value.")
    thick = 0.8 / len(series)
    height = max(1.6, 0.9 + len(values) * max(0.26, 0.17 * len(series)))
    figure, (axes,) = new_figure(theme=theme, height=height)
    for index, name in enumerate(series):
        colour = (colours or {}).get(name, style.series_style(index)[0])
        each = [theme.colour((colours or {}).get(group, colour)) for group in values if name in values[group]]
        places = [
            k + (index - (len(series) - 1) / 2) * thick
            for k, group in enumerate(values.values())
            if name in group
        ]
        means, low, high = zip(
            *(_ends(group[name], scale) for group in values.values() if name in group), strict=True
        )
        axes.barh(places, means, height=0.9 * thick, color=each, label=as_label(name))
        for place, mean in zip(places, means, strict=True):
            _say_if_cut(axes, place, mean, limits, theme)
        if len(series) == 1 and limits is None:
            for place, mean, end in zip(places, means, high, strict=True):
                _say(axes, mean, (max(end, 0.0), place), theme)
            axes.margins(x=0.1)
        whiskers = [
            [mean - a for mean, a in zip(means, low, strict=True)],
            [b - mean for mean, b in zip(means, high, strict=True)],
        ]
        if any(map(any, whiskers)):
            drawn = axes.errorbar(
                means,
                places,
                xerr=whiskers,
                fmt="none",
                ecolor=theme.colour(INK),
                elinewidth=1.1,
                capsize=2,
            )
            for line in (*drawn.lines[1], *drawn.lines[2]):  # caps and bars stay visible on a dark bar
                line.set_path_effects([withStroke(linewidth=2.8, foreground=theme.colour(PAPER))])
    axes.set_yticks(range(len(values)), [as_label(name) for name in shortened(values)])
    axes.invert_yaxis()
    if limits is not None:
        axes.set_xlim(*limits)
    finish_axes(axes, x=label, theme=theme, legend=False, grid="x")
    if len(series) > 1:
        axes.legend(
            frameon=False,
            fontsize=8,
            labelcolor=theme.colour(INK),
            loc="lower center",
            bbox_to_anchor=(0.5, 1.0),
            ncols=min(3, len(series)),
        )
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    return figure


def _say(axes: "Axes", value: float, end: tuple[float, float], theme: Theme) -> None:
    """The number beside the end of its bar."""
    axes.annotate(
        f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}",
        end,
        xytext=(5, 0),
        textcoords="offset points",
        va="center",
        fontsize=8,
        color=theme.colour(INK),
    )


def _say_if_cut(
    axes: "Axes", place: float, value: float, limits: tuple[float, float] | None, theme: Theme
) -> None:
    """An arrow and the number at the end of the axis that a bar goes beyond."""
    if limits is None or limits[0] <= value <= limits[1]:
        return
    low = value < limits[0]
    axes.annotate(
        f"← {value:.3g}" if low else f"{value:.3g} →",
        (limits[0] if low else limits[1], place),
        xytext=(1 if low else -1, 0),
        textcoords="offset points",
        ha="left" if low else "right",
        va="center",
        fontsize=7,
        color=theme.colour(INK),
        bbox={"facecolor": theme.colour(PAPER), "edgecolor": "none", "pad": 0.8},
    )


def _known(bar: Bar) -> bool:
    """Whether there is something to draw."""
    parts = bar.values() if isinstance(bar, Mapping) else [bar]
    return all(isinstance(part, (int, float)) and math.isfinite(part) for part in parts)


def _ends(bar: Any, scale: float) -> tuple[float, float, float]:
    """Mean, low and high; a number is its own interval."""
    if isinstance(bar, Mapping):
        mean = float(bar["mean"])
        return scale * mean, scale * float(bar.get("low", mean)), scale * float(bar.get("high", mean))
    value = scale * float(bar)
    return value, value, value
