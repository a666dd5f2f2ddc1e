"""Does a value mean what it says: predicted values in bins against the returns that followed."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from franka_wm.errors import UserError
from franka_wm.report.figure import finish_axes, new_figure
from franka_wm.report.style import BLUE, GREY, LIGHT, Theme

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def calibration_figure(bins: Mapping[str, Sequence[float]], *, theme: Theme = LIGHT) -> "Figure":
    """What `calibration_bins` gives, beside the line on which a perfect value lies.

    Raises:
        UserError: `predicted` or `true` is missing or empty, or their lengths differ.
    """
    predicted, true = bins.get("predicted", ()), bins.get("true", ())
    if not predicted or len(predicted) != len(true):
        raise UserError("calibration needs `predicted` and `true`, as many of both, at least one.")
    figure, (axes,) = new_figure(theme=theme)
    ends = [min(*predicted, *true), max(*predicted, *true)]
    axes.plot(ends, ends, color=theme.colour(GREY), linestyle="--", linewidth=1.2, label="perfect")
    colour = theme.colour(BLUE)
    if "low" in bins and "high" in bins:
        axes.fill_between(
            predicted, bins["low"], bins["high"], color=colour, alpha=0.2, linewidth=0, label="middle 50 %"
        )
    axes.plot(predicted, true, color=colour, marker="o", markersize=4, linewidth=1.6, label="this value")
    title = "value against the return that followed"
    finish_axes(axes, x="predicted", y="true", title=title, theme=theme)
    return figure
