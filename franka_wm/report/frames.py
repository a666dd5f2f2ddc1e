"""Frames beside each other: rollouts, imagined against real, and what a mask hides. RGB uint8 throughout."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from franka_wm.errors import UserError
from franka_wm.report.figure import new_figure
from franka_wm.report.style import INK, LIGHT, Theme

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def strip_figure(rows: Mapping[str, Tensor], *, columns: int = 8, theme: Theme = LIGHT) -> "Figure":
    """A contact sheet: one row of frames for each rollout, evenly taken from first to last.

    Args:
        rows: label -> (T, H, W, 3) uint8; all of one shape.
        columns: frames of each row, at most T.

    Raises:
        UserError: no row, or shapes that differ.
    """
    videos = list(rows.values())
    _check(videos)
    length, height, width, _ = videos[0].shape
    columns = max(1, min(columns, length))
    taken = [round(k * (length - 1) / max(1, columns - 1)) for k in range(columns)]
    figure, panels = new_figure(
        rows=len(videos), columns=columns, width=1.1 * width / height, height=1.1, theme=theme
    )
    for row, (label, video) in enumerate(rows.items()):
        for column, k in enumerate(taken):
            axes = panels[row * columns + column]
            axes.imshow(video[k].cpu().numpy(), interpolation="nearest")
            axes.set_axis_off()
            if row == 0:
                axes.set_title(f"t = {k}", fontsize=8, color=theme.colour(INK))
            if column == 0:
                axes.text(
                    -0.06,
                    0.5,
                    label,
                    transform=axes.transAxes,
                    rotation=90,
                    ha="right",
                    va="center",
                    fontsize=9,
                    color=theme.colour(INK),
                )
    return figure


def hide_patches(frame: Tensor, hidden: Tensor, *, keep: float = 0.12, shade: int = 128) -> Tensor:
    """A frame with the patches that a mask hides veiled, so that one sees what is hidden, too.

    Args:
        frame: (H, W, 3) uint8.
        hidden: (rows, columns) bool, or a flat vector of a square grid; True where the mask hides. H and W must be
            multiples of rows and columns.
        keep: share of the image that shines through.
        shade: of the veil, 0 … 255.

    Returns:
        A new frame of the same shape.

    Raises:
        UserError: shapes that do not fit.
    """
    if hidden.ndim == 1:
        side = round(hidden.numel() ** 0.5)
        if side * side != hidden.numel():
            raise UserError(
                f"a flat mask of {hidden.numel()} patches is no square grid; give (rows, columns)."
            )
        hidden = hidden.reshape(side, side)
    if frame.ndim != 3 or frame.shape[-1] != 3 or frame.dtype != torch.uint8 or hidden.ndim != 2:
        raise UserError(
            f"frame is {tuple(frame.shape)} {frame.dtype}, mask {tuple(hidden.shape)}; (H, W, 3) uint8 and "
            "(rows, columns) are needed."
        )
    height, width, _ = frame.shape
    rows, columns = hidden.shape
    if height % rows or width % columns:
        raise UserError(f"{rows} × {columns} patches do not divide a frame of {height} × {width} px.")
    cover = hidden.to(frame.device).float()[None, None]
    cover = interpolate(cover, size=(height, width), mode="nearest")[0, 0, :, :, None]
    veiled = keep * frame.float() + (1 - keep) * shade
    return torch.where(cover > 0.5, veiled, frame.float()).round().to(torch.uint8)


def mask_figure(frame: Tensor, masks: Mapping[str, Tensor], *, theme: Theme = LIGHT) -> "Figure":
    """A frame, and beside it what each mask leaves of it.

    Args:
        frame: (H, W, 3) uint8.
        masks: label -> mask as `hide_patches` takes it.

    Raises:
        UserError: no mask, or shapes that do not fit.
    """
    if not masks:
        raise UserError("no mask to draw; give at least one by name.")
    images = {"frame": frame} | {name: hide_patches(frame, mask) for name, mask in masks.items()}
    figure, panels = new_figure(columns=len(images), width=1.6, height=1.8, theme=theme)
    for axes, (name, image) in zip(panels, images.items(), strict=True):
        axes.imshow(image.cpu().numpy(), interpolation="nearest")
        axes.set_axis_off()
        axes.set_title(name, fontsize=9, color=theme.colour(INK))
    return figure


def _check(videos: Sequence[Tensor]) -> None:
    if not videos:
        raise UserError("no frames to lay beside each other; give at least one video.")
    for video in videos:
        if video.ndim != 4 or video.shape[-1] != 3 or video.dtype != torch.uint8 or 0 in video.shape:
            raise UserError(f"frames are {tuple(video.shape)} {video.dtype}; (T, H, W, 3) uint8 is needed.")
        if video.shape != videos[0].shape:
            raise UserError(
                f"frames of {tuple(video.shape)} cannot lie beside {tuple(videos[0].shape)}; cut or scale them first."
            )
