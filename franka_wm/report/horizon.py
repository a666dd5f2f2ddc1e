"""How far ahead a model can be trusted: its error by horizon, beside that of predicting no change."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from franka_wm.errors import UserError
from franka_wm.report import style
from franka_wm.report.figure import as_label, finish_axes, new_figure
from franka_wm.report.style import LIGHT, Theme

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# name -> {"mean": (H,), "low": (H,), "high": (H,)}; the last two may be missing.
type HorizonCurves = Mapping[str, Mapping[str, Sequence[float | None]]]

NO_CHANGE = ("no_change", "no change", "copy")
"""Names of the baseline that predicts that nothing changes; drawn grey and dashed."""

FAR = 3.0
"""An interval that goes beyond so many times the highest line is cut: the lines would lie on zero."""


def horizon_figure(
    curves: HorizonCurves,
    *,
    steps: Sequence[float] | None = None,
    unit: str = "error",
    theme: Theme = LIGHT,
) -> "Figure":
    """Error against steps ahead, with intervals; the axis follows the lines where an interval goes far beyond them.

    Args:
        curves: by name; `mean` (H,) and, for a band, `low` and `high` (H,). None and what is not finite leave a gap.
        steps: (H,) steps ahead; 1 … H if None.
        unit: label of the vertical axis, which starts at zero.

    Raises:
        UserError: no curve, or lengths that differ.
    """
    if not curves:
        raise UserError("no horizon curve to draw; give at least one by name.")
    figure, (axes,) = new_figure(theme=theme)
    coloured = 0
    for name, curve in curves.items():
        places = list(steps) if steps is not None else list(range(1, len(curve["mean"]) + 1))
        for part in ("mean", "low", "high"):
            if part in curve and len(curve[part]) != len(places):
                raise UserError(
                    f"horizon curve {name!r} has {len(curve[part])} values of {part} for {len(places)} steps; "
                    "give one for each step."
                )
        baseline = name in NO_CHANGE
        colour = style.GREY if baseline else style.series_style(coloured)[0]
        coloured += not baseline
        drawn = theme.colour(colour)
        axes.plot(
            places,
            _numbers(curve["mean"]),
            color=drawn,
            linestyle="--" if baseline else "-",
            linewidth=1.8,
            marker="o" if len(places) <= 20 else None,
            markersize=3.5,
            label=as_label(name.replace("_", " ")),
        )
        if "low" in curve and "high" in curve:
            axes.fill_between(
                places, _numbers(curve["low"]), _numbers(curve["high"]), color=drawn, alpha=0.2, linewidth=0
            )
    highest, reach = (_highest(curves, part) for part in ("mean", "high"))
    cut = reach > FAR * highest > 0
    title = "open-loop error by horizon"
    if cut:
        title += f"\n(intervals are cut; they reach {reach:,.4g})"
    finish_axes(axes, x="steps ahead", y=as_label(unit), title=title, theme=theme)
    axes.set_ylim(bottom=0, top=1.5 * highest if cut else None)
    return figure


def _highest(curves: HorizonCurves, part: str) -> float:
    values = (y for curve in curves.values() for y in _numbers(curve.get(part, ())))
    return max(filter(math.isfinite, values), default=0.0)


def _numbers(values: Sequence[float | None]) -> list[float]:
    return [math.nan if y is None or not math.isfinite(y) else float(y) for y in values]
