"""The learning curves of a run: final distance to the goal, success rate, losses."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from franka_wm.errors import UserError
from franka_wm.report import style, written_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FORMATS = ("pdf", "png", "svg")
_X_LABELS = {"env_steps": "environment steps", "updates": "updates", "time_s": "time [s]"}


def plot_learning_curves(
    rows: Sequence[Mapping[str, float]],
    path: str | Path,
    *,
    x: str = "env_steps",
    success_distance: float | None = 0.05,
    title: str | None = None,
) -> Path:
    """Draw the logged rows of a run into one figure: distance, success rate, losses.

    A row holds what was logged at one moment; rows need not hold the same keys. Drawn are `…/final_distance`
    [m], `…/success` [0 … 1] (`eval/planner/…`, `eval/policy/…`, `train/…`) and every `loss_…` or `…/loss_…`.
    Values that are not finite leave a gap. A panel without data says so.

    Args:
        rows: in any order.
        path: ends in .png, .pdf or .svg; its folder is made.
        x: the key of the horizontal axis; rows without it are not drawn.
        success_distance: marked in the distance panel [m]; None for no mark.
        title: above the panels.

    Returns:
        `path`.

    Raises:
        UserError: no row has the key `x`, another file ending, or the file cannot be written.
    """
    path = Path(path)
    kind = path.suffix.removeprefix(".").lower()
    if kind not in _FORMATS:
        raise UserError(f"cannot draw {path.name}: the file must end in .{', .'.join(_FORMATS)}.")
    placed = sorted((row for row in rows if x in row), key=lambda row: row[x])
    if not placed:
        raise UserError(f"no logged row has {x!r} to draw against; log it, or choose another with x=.")

    # Figure itself, not pyplot: no global state, no window, whatever backend the user has set.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.8), layout="constrained")
    distance, success, losses = figure.subplots(1, 3, sharex=True)

    if success_distance is not None:
        label = f"success: {style.centimetres(success_distance)}"
        distance.axhline(100 * success_distance, color=style.GREY, linestyle=":", linewidth=1, label=label)
    for key in _keys(placed, "final_distance"):
        _draw_policy(distance, placed, x, key, scale=100)
    for key in _keys(placed, "success"):
        _draw_policy(success, placed, x, key, scale=100)
    loss_keys = sorted({key for row in placed for key in row if _leaf(key).startswith("loss")})
    for index, key in enumerate(loss_keys):
        colour = style.PALETTE[index % len(style.PALETTE)]
        dashes = ("-", "--", ":")[index // len(style.PALETTE) % 3]
        xs, ys = _points(placed, x, key, 1)
        losses.plot(
            xs, ys, color=colour, linestyle=dashes, linewidth=1.2, label=_leaf(key)[4:].strip("_") or key
        )

    _finish(distance, x, "final distance to the goal [cm]", has_data=bool(_keys(placed, "final_distance")))
    distance.set_ylim(bottom=0)
    _finish(success, x, "successful episodes [%]", has_data=bool(_keys(placed, "success")))
    success.set_ylim(-3, 103)
    _finish(losses, x, "losses", has_data=bool(loss_keys))
    values = [v for key in loss_keys for v in _points(placed, x, key, 1)[1] if not math.isnan(v)]
    if values and min(values) > 0:
        losses.set_yscale("log")
    elif any(values):
        # Some losses (a policy's) are negative; the scale is linear only around zero, up to a power of ten.
        linear_to = 10.0 ** (math.floor(math.log10(max(map(abs, values)))) - 2)
        losses.set_yscale("symlog", linthresh=linear_to)
    if title:
        figure.suptitle(title, fontsize=11)
    with written_whole(path) as temporary:
        figure.savefig(temporary, format=kind, dpi=150)
    return path


def _leaf(key: str) -> str:
    return key.rsplit("/", 1)[-1]


def _keys(rows: Sequence[Mapping[str, float]], leaf: str) -> list[str]:
    """The keys `…/leaf`, training last, so that the evaluations get the top of the legend."""
    found = {key for row in rows for key in row if _leaf(key) == leaf}
    return sorted(found, key=lambda key: (key.startswith("train"), key))


def _points(
    rows: Sequence[Mapping[str, float]], x: str, key: str, scale: float
) -> tuple[list[float], list[float]]:
    """The rows that hold `key`, as coordinates; a value that is not finite is NaN, which leaves a gap."""
    present = [row for row in rows if row.get(key) is not None]
    ys = [scale * row[key] if math.isfinite(row[key]) else math.nan for row in present]
    return [row[x] for row in present], ys


def _draw_policy(axes: "Axes", rows: Sequence[Mapping[str, float]], x: str, key: str, scale: float) -> None:
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
        label=style.policy_name(policy),
    )


def _finish(axes: "Axes", x: str, label: str, *, has_data: bool) -> None:
    from matplotlib.ticker import EngFormatter, MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(EngFormatter())  # 40 k, 1.5 M
    axes.set_xlabel(_X_LABELS.get(x, x))
    axes.set_title(label, fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, linewidth=0.6)
    if has_data:
        axes.legend(frameon=False, fontsize=8)
    else:
        axes.text(0.5, 0.5, "nothing logged", transform=axes.transAxes, ha="center", color=style.GREY)
