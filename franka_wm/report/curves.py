"""Learning curves: final distance to the goal, success rate, return, losses; one run, or several seeds with bands."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from franka_wm.errors import UserError
from franka_wm.report import style
from franka_wm.report.figure import (
    as_label,
    check_format,
    finish_axes,
    new_figure,
    save_figure,
    shortened,
)
from franka_wm.report.style import LIGHT, Theme

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

type Rows = Sequence[Mapping[str, float]]

X_LABELS = {"env_steps": "environment steps", "updates": "updates", "time_s": "time [s]"}

# What a logged quantity is called, and what it is multiplied with to be in that unit.
QUANTITIES = {
    "final_distance": ("final distance to the goal [cm]", 100.0),
    "success": ("successful episodes [%]", 100.0),
    "return": ("return of an episode", 1.0),
}
TASK = "success_"
"""How keys of one task's success begin, where several are learned at once."""


def quantity(leaf: str) -> tuple[str, float]:
    """What a logged quantity is called, and what it is multiplied with; a task's own measures as they are."""
    if leaf.startswith(TASK):
        return f"successful episodes of {leaf.removeprefix(TASK).replace('_', ' ')} [%]", 100.0
    name = leaf.replace("_", " ")
    return QUANTITIES.get(leaf, (name.removesuffix(" m") + " [m]" if leaf.endswith("_m") else name, 1.0))


def panels(rows: Rows) -> list[str]:
    """What `panel_figure` draws of these rows: quantities, a task's own measures among them, losses, gradients."""
    evaluated = {_leaf(key) for row in rows for key in row if key.startswith("eval/")}
    return [*QUANTITIES, *sorted(evaluated - QUANTITIES.keys()), "losses", "gradients"]


def axis(rows: Rows) -> str | None:
    """What rows are drawn against: environment steps, or updates where training makes none; None for no rows."""
    return next((key for key in ("env_steps", "updates") if any(row.get(key) for row in rows)), None)


def plot_learning_curves(
    rows: Rows,
    path: str | Path,
    *,
    x: str = "env_steps",
    success_distance: float | None = 0.05,
) -> Path:
    """Draw the logged rows of a run into one figure: distance, or return where there is none, success rate, losses.

    A row holds what was logged at one moment; rows need not hold the same keys. Drawn are `…/final_distance`
    [m] or `…/return`, `…/success` [0 … 1] (`eval/planner/…`, `eval/policy/…`, `train/…`) and every `loss_…` or
    `…/loss_…`. Values that are not finite leave a gap. Success has no panel where no row has it; another panel without
    data says so.

    Args:
        rows: in any order.
        path: ends in .png, .pdf or .svg; its folder is made.
        x: the key of the horizontal axis; rows without it are not drawn.
        success_distance: marked in the distance panel [m]; None for no mark.

    Returns:
        `path`.

    Raises:
        UserError: no row has the key `x`, another file ending, or the file cannot be written.
    """
    check_format(path)
    placed = _placed(rows, x)
    first = "final_distance" if _keys(placed, "final_distance") or not _keys(placed, "return") else "return"
    # Not every simulator tells success; every run has losses and one of the others.
    quantities = [first, "success"] if _keys(placed, "success") else [first]
    figure, axes = new_figure(columns=len(quantities) + 1, width=4.0, height=3.8, sharex=True)
    for one, quantity in zip(axes[:-1], quantities, strict=True):
        _draw_quantity(one, placed, x, quantity, success_distance)
    _draw_values(axes[-1], placed, x, _loss_keys(placed), "losses")
    return save_figure(figure, path)


def panel_figure(
    rows: Rows,
    panel: str,
    *,
    x: str = "env_steps",
    success_distance: float | None = 0.05,
) -> "Figure | None":
    """One of `panels` of a run as a figure of its own; None where no row holds anything for it.

    All panels of the same rows have the same horizontal axis.

    Raises:
        UserError: no row has the key `x`.
    """
    placed = _placed(rows, x)
    values = {
        "losses": (_loss_keys(placed), "losses"),
        "gradients": (_gradient_keys(placed), "gradient norm before clipping, latent norm"),
    }
    keys, title = values.get(panel, (_keys(placed, panel), ""))
    if not keys:
        return None
    figure, (axes,) = new_figure()
    if panel in values:
        _draw_values(axes, placed, x, keys, title)
    else:
        _draw_quantity(axes, placed, x, panel, success_distance)
    _share_x(axes, [placed], x)
    return figure


def seed_bands(
    runs: Sequence[Rows], key: str, *, x: str = "env_steps", points: int = 200
) -> dict[str, NDArray]:
    """One logged quantity of several runs on common places of the horizontal axis.

    Runs log at different moments; between two of them a run is taken to change linearly. Only the stretch that
    all runs cover is given, so that the mean is over the same runs everywhere.

    Args:
        runs: rows of each run; those without `key` are left out.
        points: places on the axis.

    Returns:
        `x`, `mean`, `low`, `high` (points,): mean, lowest and highest run. Empty arrays where no run has `key`
        or the runs do not overlap.
    """
    curves = []
    for rows in runs:
        xs, ys = _points([row for row in rows if x in row], x, key, 1.0)
        finite = [(a, b) for a, b in sorted(zip(xs, ys, strict=True)) if math.isfinite(b)]
        if finite:
            curves.append(np.array(finite, dtype=float).T)
    if not curves:
        return {name: np.empty(0) for name in ("x", "mean", "low", "high")}
    start, stop = max(c[0, 0] for c in curves), min(c[0, -1] for c in curves)
    if start > stop:
        return {name: np.empty(0) for name in ("x", "mean", "low", "high")}
    # A single common place is one point, not many of the same.
    grid = np.linspace(start, stop, points) if stop > start else np.array([start])
    values = np.stack([np.interp(grid, *curve) for curve in curves])
    return {"x": grid, "mean": values.mean(0), "low": values.min(0), "high": values.max(0)}


def seeds_figure(
    groups: Mapping[str, Sequence[Rows]],
    key: str,
    *,
    x: str = "env_steps",
    theme: Theme = LIGHT,
    title: str | None = None,
) -> "Figure":
    """A logged quantity of groups of runs: the mean over a group's runs, and a band from lowest to highest.

    All quantities of the same groups have the same horizontal axis.

    Args:
        groups: label -> rows of each of its runs (seeds). A group of one run is a line without a band.
        key: such as ``eval/policy/final_distance``; the last part decides name and unit (`quantity`).
    """
    figure, (axes,) = new_figure(theme=theme)
    leaf = _leaf(key)
    label, scale = quantity(leaf)
    for index, (name, runs) in enumerate(zip(shortened(groups), groups.values(), strict=True)):
        band = seed_bands(runs, key, x=x)
        if not band["x"].size:
            continue
        light, dashes = style.series_style(index)
        colour = theme.colour(light)
        having = sum(any(key in row for row in rows) for rows in runs)
        text = f"{name} ({having} runs)" if having > 1 else name
        marker = "o" if band["x"].size == 1 else None
        axes.plot(
            band["x"],
            scale * band["mean"],
            color=colour,
            linestyle=dashes,
            linewidth=1.8,
            label=as_label(text),
            marker=marker,
        )
        if having > 1:
            axes.fill_between(
                band["x"], scale * band["low"], scale * band["high"], color=colour, alpha=0.2, linewidth=0
            )
    _finish(axes, x, title or label, theme, leaf)
    _share_x(axes, [rows for runs in groups.values() for rows in runs], x)
    return figure


# -- drawing ---------------------------------------------------------------------------------------------


def _draw_quantity(axes: "Axes", rows: Rows, x: str, leaf: str, success_distance: float | None) -> None:
    title, scale = quantity(leaf)
    keys = _keys(rows, leaf)
    for key in keys:
        _draw_policy(axes, rows, x, key, scale)
    if success_distance is not None and leaf == "final_distance" and keys:
        label = f"success: {style.centimetres(success_distance)}"
        axes.axhline(100 * success_distance, color=style.GREY, linestyle=":", linewidth=1, label=label)
    _finish(axes, x, title, LIGHT, leaf)


def _draw_values(axes: "Axes", rows: Rows, x: str, keys: Sequence[str], title: str) -> None:
    values = []
    for index, key in enumerate(keys):
        colour, dashes = style.series_style(index)
        xs, ys = _points(rows, x, key, 1)
        values += [y for y in ys if not math.isnan(y)]
        axes.plot(
            xs,
            ys,
            color=colour,
            linestyle=dashes,
            linewidth=1.2,
            label=as_label(_short(key)),
            marker="o" if len(xs) == 1 else None,
            markersize=3.5,
        )
    _finish(axes, x, title, LIGHT)
    if values and min(values) > 0:
        axes.set_yscale("log")
    elif any(values):
        # Some losses (a policy's) are negative; the scale is linear only around zero, up to a power of ten.
        linear_to = 10.0 ** (math.floor(math.log10(max(map(abs, values)))) - 2)
        axes.set_yscale("symlog", linthresh=linear_to)


def _draw_policy(axes: "Axes", rows: Rows, x: str, key: str, scale: float) -> None:
    policy = key.split("/")[-2] if "/" in key else "train"
    xs, ys = _points(rows, x, key, scale)
    training = policy == "train"
    axes.plot(
        xs,
        ys,
        color=style.policy_colour(policy),
        linewidth=1.0 if training else 1.8,
        zorder=2 if training else 3,
        marker="o" if len(xs) <= 40 else None,
        markersize=3.5,
        label=as_label(style.policy_name(policy)),
    )


def _finish(axes: "Axes", x: str, title: str, theme: Theme, leaf: str = "") -> None:
    """Labels, and the vertical range of distances and rates."""
    from matplotlib.ticker import EngFormatter, MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(5))
    if x != "time_s":
        axes.xaxis.set_major_formatter(EngFormatter())  # 40 k, 1.5 M
    finish_axes(axes, x=X_LABELS.get(x, x), title=title, theme=theme)
    if leaf == "final_distance":
        axes.set_ylim(bottom=0)
    elif leaf == "success" or leaf.startswith(TASK):
        axes.set_ylim(-3, 103)


def _share_x(axes: "Axes", runs: Sequence[Rows], x: str) -> None:
    """The range of the horizontal axis from 0 to the last row of any run, whatever this panel holds of it."""
    last = max((row[x] for rows in runs for row in rows if x in row), default=0)
    if last > 0:
        axes.set_xlim(-0.02 * last, 1.04 * last)


# -- rows ------------------------------------------------------------------------------------------------


def _placed(rows: Rows, x: str) -> list[Mapping[str, float]]:
    placed = sorted((row for row in rows if x in row), key=lambda row: row[x])
    if not placed:
        raise UserError(f"no logged row has {x!r} to draw against; log it, or choose another with x=.")
    return placed


def _leaf(key: str) -> str:
    return key.rsplit("/", 1)[-1]


def _short(key: str) -> str:
    """``train/loss_value`` → ``value``; ``validation/loss_value`` → ``value, validation``; see `_loss_keys`."""
    leaf = _leaf(key)
    if leaf.startswith("grad_norm"):
        return f"gradient, {leaf[9:].strip('_')}" if leaf[9:].strip("_") else "gradient"
    name = leaf[4:].strip("_") or "loss" if leaf.startswith("loss") else leaf.replace("_", " ")
    return f"{name}, validation" if key.startswith("validation/") else name


def _keys(rows: Rows, leaf: str) -> list[str]:
    """The keys `…/leaf`, training last, so that the evaluations get the top of the legend."""
    found = {key for row in rows for key in row if _leaf(key) == leaf}
    return sorted(found, key=lambda key: (key.startswith("train"), key))


def _loss_keys(rows: Rows) -> list[str]:
    return sorted({key for row in rows for key in row if _leaf(key).startswith("loss")})


def _gradient_keys(rows: Rows) -> list[str]:
    found = {key for row in rows for key in row}
    return sorted(k for k in found if _leaf(k).startswith("grad_norm") or _leaf(k) == "latent_norm")


def _points(rows: Rows, x: str, key: str, scale: float) -> tuple[list[float], list[float]]:
    """The rows that hold `key`, as coordinates; a value that is not finite is NaN, which leaves a gap."""
    present = [row for row in rows if row.get(key) is not None]
    ys = [scale * row[key] if math.isfinite(row[key]) else math.nan for row in present]
    return [row[x] for row in present], ys
