"""What stands between two products of a plan, as one kernel each: fewer passes over the same numbers.

A decision sends millions of candidates through small networks. On a GPU the products are soon done; LayerNorm, Mish,
casts and copies, each a kernel of its own, take most of the time. Inside :func:`kernels` layers call what is here.
Their own code stays the definition: tests hold both equal. Without gradients, and not inside `torch.compile`, which
does the same by itself.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from franka_wm.console import say
from franka_wm.device import missing_to_compile

PIECE = 8
"""Rows of so many numbers suit tensor cores: 16 bytes of bfloat16."""


class Joined(NamedTuple):
    """Input of a network over features (..., D) and actions (..., A) that lie apart: joining them would copy both."""

    features: Tensor
    action: Tensor


class _Decision(threading.local):
    """What was made of the weights for the present decision, by where they lie and what for; None outside of one."""

    made: dict[tuple[int, tuple[int, ...], str, torch.dtype], tuple[Tensor, Tensor]] | None = None


_decision = _Decision()


@cache
def ready(kind: str) -> bool:
    """Whether a device of this kind has the kernels: CUDA does, where Triton can compile; if not, it is said once."""
    if kind != "cuda":
        return False
    missing = missing_to_compile(torch.device(kind))
    if missing is None and find_spec("triton") is None:
        missing = "the package triton"
    if missing is not None:
        say(f"planning takes longer than it must: its kernels need {missing}, which is not here")
    return missing is None


@contextmanager
def kernels(on: bool = True) -> Iterator[None]:
    """Layers inside use the kernels, if `on`. Weights must not change inside."""
    before, _decision.made = _decision.made, {} if on else None
    try:
        yield
    finally:
        _decision.made = before


def applies() -> bool:
    """Whether layers use the kernels now."""
    return _decision.made is not None and not torch.is_grad_enabled() and not torch.compiler.is_compiling()


def suits(group_size: int) -> bool:
    """Whether there is a kernel for a softmax in groups of this size."""
    return group_size & (group_size - 1) == 0


def _precision(x: Tensor) -> torch.dtype:
    kind = x.device.type
    return torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else x.dtype


def _prepared(weight: Tensor, what: str, dtype: torch.dtype, make: Callable[[Tensor], Tensor]) -> Tensor:
    """What `make` makes of a weight in this precision, once per decision."""
    assert _decision.made is not None
    key = (weight.data_ptr(), tuple(weight.shape), what, dtype)
    if key not in _decision.made:
        # The weight is kept, too: while it is, nothing else lies where it does.
        _decision.made[key] = weight, make(weight).to(dtype).contiguous()
    return _decision.made[key][1]


def _pieces(x: Tensor, dim: int) -> Tensor:
    """With zeros at the end of a dimension, up to a whole piece."""
    lacking = -x.shape[dim] % PIECE
    return F.pad(x, (0, 0) * (-dim - 1) + (0, lacking)) if lacking else x


def _product(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """x (..., D) with the first D columns of a weight (out, in), or (K, rows, D) of K members with (K, out, in).

    Returns:
        (..., out), a view where out is no whole piece. Weights lie so that the product reads rows of both.
    """
    out, width = weight.shape[-2], x.shape[-1]
    x = _pieces(x.to(_precision(x)), -1)
    weight = _prepared(weight, f"first {width}", x.dtype, lambda w: _pieces(_pieces(w[..., :width], -1), -2))
    bias = None if bias is None else _prepared(bias, "bias", x.dtype, lambda b: _pieces(b, -1))
    return (F.linear(x, weight, bias) if weight.dim() == 2 else x @ weight.mT)[..., :out]


def _as_stored(x: Tensor) -> tuple[Tensor, list[int]]:
    """x (..., D) with its leading dimensions in the order of memory, and that order."""
    order = sorted(range(x.dim() - 1), key=lambda k: -x.stride(k))
    return x.permute(*order, -1), order


def linear(x: Tensor | Joined, weight: Tensor, bias: Tensor | None) -> Tensor:
    """`F.linear`: (..., in) -> (..., out)."""
    return _product(torch.cat((x.features, x.action), -1) if isinstance(x, Joined) else x, weight, bias)


def normed_linear(
    x: Tensor | Joined,
    weight: Tensor,
    bias: Tensor,
    scale: Tensor,
    shift: Tensor,
    *,
    group_size: int,
    eps: float,
) -> Tensor:
    """Linear, LayerNorm, and Mish or a softmax in groups of `group_size`, 0 for Mish: (..., in) -> (..., out)."""
    features, action = x if isinstance(x, Joined) else (x, None)
    features, order = _as_stored(features)
    action = None if action is None else action.permute(*order, -1)
    y = _normed(
        _product(features, weight), weight, bias, scale, shift, action, group_size=group_size, eps=eps
    )
    return y.permute(*(order.index(k) for k in range(len(order))), -1)


def ensemble(
    x: Tensor | Joined, layers: Sequence[tuple[Tensor, Tensor]], norms: Sequence[tuple[Tensor, Tensor]]
) -> Tensor:
    """`Ensemble.forward` without dropout.

    Args:
        x: (..., in), shared by all K members.
        layers: weight (K, in, out) and bias (K, 1, out) of each.
        norms: scale and shift (K, 1, out) of the LayerNorm after each layer but the last.

    Returns:
        (K, ..., out).
    """
    features, action = x if isinstance(x, Joined) else (x, None)
    h = features.reshape(-1, features.shape[-1]).expand(layers[0][0].shape[0], -1, -1)
    for (weight, bias), (scale, shift) in zip(layers[:-1], norms, strict=True):
        h = _normed(_product(h, weight.mT), weight.mT, bias, scale, shift, action)
        action = None  # the first layer's alone
    weight, bias = layers[-1]
    return (_product(h, weight.mT) + bias.to(h.dtype)).unflatten(1, features.shape[:-1])


def _normed(
    x: Tensor,
    weight: Tensor,
    bias: Tensor,
    scale: Tensor,
    shift: Tensor,
    action: Tensor | None,
    *,
    group_size: int = 0,
    eps: float = 1e-5,
) -> Tensor:
    """What follows the product of features: bias and the part of actions, LayerNorm, activation; of x's shape."""
    from franka_wm.models.fused_kernels import bias_norm_activation

    own = None
    if action is not None:
        action, count = action.reshape(-1, action.shape[-1]), action.shape[-1]
        own = _prepared(weight, f"last {count}", torch.float32, lambda w: w[..., -count:].mT)
    return bias_norm_activation(x, bias, scale, shift, action, own, group_size, eps)


def expectation(logits: Tensor, support: Tensor) -> Tensor:
    """`TwoHotSymlog.decode`: logits (..., bins), support (bins,) -> symexp of its mean (..., 1), float32."""
    from franka_wm.models.fused_kernels import symexp_of_mean

    return symexp_of_mean(logits, support)
