"""Slow copies of networks: exponential moving averages of their weights."""

import copy

import torch
from torch import Tensor, nn


def frozen_copy[Network: nn.Module](network: Network) -> Network:
    """A copy that no optimiser trains."""
    return copy.deepcopy(network).requires_grad_(False)


def ema_update(slow: nn.Module, live: nn.Module, keep: Tensor) -> None:
    """Move the parameters of `slow` to `keep` · slow + (1 - `keep`) · live; `keep` () on the device.

    Floating-point buffers (running statistics) follow at once.
    """
    targets = [p.data for p in slow.parameters()]
    change = torch._foreach_sub([p.detach() for p in live.parameters()], targets)  # pyright: ignore[reportPrivateImportUsage]
    torch._foreach_mul_(change, 1.0 - keep)  # pyright: ignore[reportPrivateImportUsage]
    torch._foreach_add_(targets, change)  # pyright: ignore[reportPrivateImportUsage]
    for a, b in zip(slow.buffers(), live.buffers(), strict=True):
        if a.is_floating_point():
            a.copy_(b)
