"""Networks whose weights stand still: slow copies (moving averages of weights), and weights taken as constants."""

import copy

import torch
from torch import Tensor, nn
from torch.func import functional_call


def frozen_copy[Network: nn.Module](network: Network) -> Network:
    """A copy that no optimiser trains."""
    return copy.deepcopy(network).requires_grad_(False)


def frozen(network: nn.Module, *inputs: Tensor) -> Tensor:
    """`network(*inputs)` whose gradients reach the inputs, never the weights."""
    weights = {name: parameter.detach() for name, parameter in network.named_parameters()}
    return functional_call(network, weights, inputs)


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
