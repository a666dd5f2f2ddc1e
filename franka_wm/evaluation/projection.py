"""Latents along their main directions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from franka_wm.errors import UserError


class Projection(NamedTuple):
    """Points along the first two principal directions.

    Attributes:
        points: (N, 2) coordinates; the second column is zero where there is one direction only.
        explained: (2,) share of the variance along each, in [0, 1].
    """

    points: NDArray
    explained: NDArray


def principal_components(latents: ArrayLike) -> Projection:
    """Latents (N, Z), N ≥ 2, along their first two principal directions.

    Signs are fixed (the largest coordinate of each direction is positive), so that an image does not flip.

    Raises:
        UserError: another shape, or values that are not finite.
    """
    values = np.asarray(latents, dtype=np.float64)
    if values.ndim != 2 or values.shape[0] < 2 or values.shape[1] < 1:
        raise UserError(f"latents have shape {values.shape}; (N, Z) with N ≥ 2 is needed.")
    if not np.isfinite(values).all():
        raise UserError("latents are not all finite; a projection of the rest would mislead.")
    left, singular, right = np.linalg.svd(values - values.mean(0), full_matrices=False)
    signs = np.sign(right[np.arange(len(right)), np.abs(right).argmax(1)])
    points = (left * singular * np.where(signs == 0, 1, signs))[:, :2]
    total = float((singular**2).sum())
    share = singular[:2] ** 2 / total if total > 0 else np.zeros(min(2, singular.size))
    missing = 2 - points.shape[1]
    return Projection(np.pad(points, ((0, 0), (0, missing))), np.pad(share, (0, missing)))
