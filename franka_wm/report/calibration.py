"""Does a value mean what it says: predicted values in bins against the returns that followed."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from franka_wm.errors import UserError
from franka_wm.report.figure import finish_axes, new_figure
from franka_wm.report.style import BLUE, GREY, LIGHT, Theme

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def calibration_bins(predicted: ArrayLike, true: ArrayLike, *, bins: int = 10) -> dict[str, list[float]]:
    """Means in bins of equal numbers of predictions, and the middle 50 % of the true values in each.

    Bins of equal size in number, not in width: none is empty, and each mean rests on as many values.

    Args:
        predicted, true: (N,) the value of a state, and the return that followed it.
        bins: at most; fewer where there are fewer predictions.

    Returns:
        `predicted`, `true`, `low`, `high`, `count`: one value for each bin, by rising prediction.

    Raises:
        UserError: numbers differ, none, or not finite.
    """
    guess, fact = (np.asarray(v, dtype=np.float64).reshape(-1) for v in (predicted, true))
    if guess.shape != fact.shape or guess.size == 0 or bins < 1:
        raise UserError(
            f"{guess.size} predicted and {fact.size} true values in {bins} bins; as many of both, at least one, "
            "are needed, in at least one bin."
        )
    if not (np.isfinite(guess).all() and np.isfinite(fact).all()):
        raise UserError("values are not all finite; a calibration of the rest would mislead.")
    order = np.argsort(guess, kind="stable")
    out: dict[str, list[float]] = {name: [] for name in ("predicted", "true", "low", "high", "count")}
    for part in np.array_split(order, min(bins, guess.size)):
        low, high = np.quantile(fact[part], (0.25, 0.75))
        row = (guess[part].mean(), fact[part].mean(), low, high, part.size)
        for name, value in zip(out, row, strict=True):
            out[name].append(float(value))
    return out


def calibration_figure(
    bins: Mapping[str, Sequence[float]],
    *,
    title: str = "value against the return that followed",
    theme: Theme = LIGHT,
) -> "Figure":
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
    finish_axes(axes, x="predicted", y="true", title=title, theme=theme)
    return figure
