"""What a latent space looks like: its singular values, and its points seen along its two main directions."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from franka_wm.errors import UserError
from franka_wm.report import style
from franka_wm.report.figure import as_label, finish_axes, new_figure, shortened
from franka_wm.report.style import GREY, INK, LIGHT, Theme

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SMALLEST = 1e-6
"""Relative singular values below it are drawn here: a log scale has no zero."""


def spectrum_figure(
    spectra: Mapping[str, Sequence[float]],
    *,
    marks: Mapping[str, float] | None = None,
    theme: Theme = LIGHT,
) -> "Figure":
    """Singular values by rank, relative to the largest, on a log scale.

    A collapsed latent space falls off at once; one that uses all its dimensions stays flat.

    Args:
        spectra: name -> singular values in any order, none negative.
        marks: name -> a rank (effective rank, RankMe) to mark with an upright line.

    Raises:
        UserError: nothing to draw, or a negative value.
    """
    figure, (axes,) = new_figure(theme=theme)
    if not spectra:
        raise UserError("no singular values to draw; give at least one list by name.")
    for index, (name, values) in enumerate(zip(shortened(spectra), spectra.values(), strict=True)):
        ordered = np.sort(np.asarray(values, dtype=np.float64))[::-1]
        if ordered.size == 0 or ordered[-1] < 0 or not np.isfinite(ordered).all():
            raise UserError(f"singular values of {name!r} must be finite, not negative, at least one.")
        relative = ordered / ordered[0] if ordered[0] > 0 else ordered
        colour, dashes = style.series_style(index)
        axes.plot(
            np.arange(1, ordered.size + 1),
            relative.clip(SMALLEST),
            color=theme.colour(colour),
            linestyle=dashes,
            linewidth=1.8,
            marker="o" if ordered.size <= 64 else None,
            markersize=3,
            label=as_label(name),
        )
    for name, rank in (marks or {}).items():
        axes.axvline(
            rank, color=theme.colour(GREY), linestyle=":", linewidth=1.2, label=as_label(f"{name} {rank:.1f}")
        )
    axes.set_yscale("log")
    title = "singular values of the latents"
    finish_axes(axes, x="rank", y="relative to the largest", title=title, theme=theme)
    return figure


def latent_figure(
    points: ArrayLike,
    quantity: ArrayLike,
    *,
    label: str,
    explained: Sequence[float] | None = None,
    theme: Theme = LIGHT,
) -> "Figure":
    """Points of `principal_components`, coloured by a quantity such as the distance to the goal.

    Args:
        points: (N, 2).
        quantity: (N,) colour, on the map cividis, which colour-blind readers see the same; without its ends, which
            vanish on a dark and on a light ground.
        label: the quantity's name and unit.
        explained: (2,) share of the variance of both directions, for the labels.

    Raises:
        UserError: numbers of points and colours differ.
    """
    places, colours = np.asarray(points, dtype=np.float64), np.asarray(quantity, dtype=np.float64).reshape(-1)
    if places.ndim != 2 or places.shape[1] != 2 or places.shape[0] != colours.size:
        raise UserError(
            f"points have shape {places.shape} and the quantity {colours.shape}; (N, 2) and (N,) are needed."
        )
    figure, (axes,) = new_figure(theme=theme)
    # As an image: thousands of vector points would make a page slow.
    drawn: Any = axes.scatter(*places.T, c=colours, cmap=_colour_map(), s=7, linewidths=0, rasterized=True)
    bar = figure.colorbar(drawn, ax=axes)
    bar.set_label(as_label(label), color=theme.colour(INK), fontsize=9)
    bar.ax.tick_params(colors=theme.colour(INK), labelsize=8)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    shares = ["", ""] if explained is None else [f" ({100 * share:.0f} %)" for share in explained]
    title = "latents along their main directions"
    finish_axes(axes, x=f"first{shares[0]}", y=f"second{shares[1]}", title=title, theme=theme, grid="")
    axes.set_xticks([])
    axes.set_yticks([])
    return figure


def _colour_map() -> Any:
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    return ListedColormap(colormaps["cividis"](np.linspace(0.2, 0.95, 256)))
