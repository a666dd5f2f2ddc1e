"""Predicted values in bins, against the returns that followed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from franka_wm.errors import UserError


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
