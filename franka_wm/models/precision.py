"""Weights in low precision, cast once for all that multiplies by them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import nn

from franka_wm.models.base import WorldModel
from franka_wm.models.rssm import BlockLinear

PRODUCTS = (nn.Linear, nn.Conv2d, BlockLinear)
"""Layers that autocast computes in low precision."""


@contextmanager
def lowered(model: WorldModel, dtype: torch.dtype) -> Iterator[None]:
    """Inside, layers of the modules that `model.repeated` names hold their weights as `dtype`, cast once.

    Autocast casts them at every use: of a recurrent network at every step. Gradients reach the parameters, which come
    back at the end; those of several uses are summed in `dtype`.
    """
    kept = [
        (layer._parameters, name, weight)
        for module in map(model.get_submodule, model.repeated)
        for layer in module.modules()
        if isinstance(layer, PRODUCTS)
        for name, weight in layer.named_parameters(recurse=False)
    ]
    try:
        for parameters, name, weight in kept:
            parameters[name] = weight.to(dtype)  # pyright: ignore[reportArgumentType]
        yield
    finally:
        for parameters, name, weight in kept:
            parameters[name] = weight
