"""Mean and deviation of observations, of vectors and of images."""

from __future__ import annotations

import torch
from torch import Tensor


def moments(x: Tensor, at_once: int = 256) -> tuple[Tensor, Tensor]:
    """Mean and deviation over the first dimension (N, ...).

    Of uint8 images as numbers in [0, 1], `at_once` at a time, in float64; their deviation is that of N, not of N - 1.
    One row deviates by nothing.
    """
    if x.dtype != torch.uint8:
        return x.mean(0), x.std(0) if len(x) > 1 else torch.zeros_like(x[0])
    total, squares = (torch.zeros(x.shape[1:], dtype=torch.float64, device=x.device) for _ in range(2))
    for part in x.split(at_once):
        values = part.double() / 255.0
        total, squares = total + values.sum(0), squares + values.square().sum(0)
    mean = total / len(x)
    return mean.float(), (squares / len(x) - mean.square()).clamp_min(0.0).sqrt().float()
