"""Small tools around rendering: where a camera looks, and fewer pixels from many."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from franka_wm.errors import UserError
from franka_wm.options import check_whole

Vector = Sequence[float]


def supersample(frame: torch.Tensor, factor: int) -> torch.Tensor:
    """Averages blocks of ``factor``² pixels: the box filter.

    Args:
        frame: (..., 3, H·factor, W·factor), of any floating type, or uint8.
        factor: Pixels per pixel along each side, ≥ 1.

    Returns:
        (..., 3, H, W) of the same type; uint8 is rounded to nearest.

    Raises:
        UserError: If the sides are no multiples of ``factor``.
    """
    check_whole("factor", factor)
    if frame.dim() < 3 or frame.shape[-2] % factor or frame.shape[-1] % factor:
        raise UserError(
            f"frame has shape {tuple(frame.shape)}; it must be (…, 3, H·{factor}, W·{factor}) for factor={factor}"
        )
    *lead, height, width = frame.shape
    blocks = frame.reshape(*lead, height // factor, factor, width // factor, factor)
    if frame.is_floating_point():
        return blocks.mean((-3, -1))
    return blocks.float().mean((-3, -1)).round_().to(frame.dtype)


def look_at_angles(eye: Vector, target: Vector, up_axis: str = "Z") -> tuple[float, float]:
    """Angles of a camera at ``eye`` that looks at ``target``.

    Args:
        eye, target: World points [m].
        up_axis: ``"X"``, ``"Y"`` or ``"Z"``.

    Returns:
        (pitch, yaw) in degrees. Pitch is the elevation above the horizon, −90 to 90. Yaw turns about the up
        axis; it is 0 along +x for Z up (then towards +y) and for Y up (towards +z), along +y for X up (towards
        +z). Straight up or down, where any yaw will do, it is 0.

    Raises:
        UserError: If the points coincide, or are no points.
    """
    direction = point("target", target) - point("eye", eye)
    length = float(np.linalg.norm(direction))
    if length < 1e-9:
        raise UserError(f"eye and target coincide at {tuple(float(v) for v in eye)} m; move one of them")
    up, ahead, aside = axes(up_axis)
    flat = math.hypot(direction[ahead], direction[aside])
    pitch = math.degrees(math.atan2(direction[up], flat))
    yaw = math.degrees(math.atan2(direction[aside], direction[ahead])) if flat > 1e-9 * length else 0.0
    return pitch, yaw


def axes(up_axis: str) -> tuple[int, int, int]:
    """Indices of the up axis, of yaw 0 and of yaw 90°."""
    found = {"X": (0, 1, 2), "Y": (1, 0, 2), "Z": (2, 0, 1)}.get(str(up_axis).upper())
    if found is None:
        raise UserError(f"up_axis={up_axis!r}: must be X, Y or Z")
    return found


def point(name: str, value: Vector) -> np.ndarray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise UserError(f"{name}={value}: give three finite numbers (x, y, z) in metres")
    return array


def camera_rotation(pitch: float, yaw: float, up_axis: str) -> np.ndarray:
    """Rows are the camera's right, up and backward axes in the world, (3, 3).

    Up is the derivative of forward by pitch: defined straight up and down, too.
    """
    p, y = math.radians(pitch), math.radians(yaw)
    up_index, ahead, aside = axes(up_axis)
    forward, up = np.zeros(3), np.zeros(3)
    forward[[up_index, ahead, aside]] = math.sin(p), math.cos(y) * math.cos(p), math.sin(y) * math.cos(p)
    up[[up_index, ahead, aside]] = math.cos(p), -math.cos(y) * math.sin(p), -math.sin(y) * math.sin(p)
    return np.stack([np.cross(forward, up), up, -forward])
