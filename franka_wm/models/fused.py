"""What stands between two products of a plan, as one kernel each: fewer passes over the same numbers.

A decision sends millions of candidates through small networks. On a GPU the products are soon done; LayerNorm, Mish,
casts and copies, each a kernel of its own, take most of the time. Inside :func:`kernels` layers call what is here.
Their own code stays the definition: tests hold both equal. Without gradients, and not inside `torch.compile`, which
does the same by itself.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec

import torch
from torch import Tensor
from torch.nn import functional as F

from franka_wm.console import say
from franka_wm.device import missing_to_compile

PIECE = 8
"""Rows of so many numbers suit tensor cores: 16 bytes of bfloat16."""


class _Decision(threading.local):
    """Weights of the present decision, cast and padded once, by where they lie; None outside of one."""

    weights: dict[tuple[int, tuple[int, ...], torch.dtype], tuple[Tensor, Tensor]] | None = None


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
    before, _decision.weights = _decision.weights, {} if on else None
    try:
        yield
    finally:
        _decision.weights = before


def applies() -> bool:
    """Whether layers use the kernels now."""
    return _decision.weights is not None and not torch.is_grad_enabled() and not torch.compiler.is_compiling()


def _precision(x: Tensor) -> torch.dtype:
    kind = x.device.type
    return torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else x.dtype


def _prepared(weight: Tensor, padding: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """The weight, cast, with zeros at its ends as `F.pad` puts them; made once per decision."""
    assert _decision.weights is not None
    key = (weight.data_ptr(), (*weight.shape, *padding), dtype)
    if key not in _decision.weights:
        made = weight.to(dtype)
        # The weight itself is kept, too: while it is, nothing else lies where it does.
        _decision.weights[key] = weight, F.pad(made, padding) if any(padding) else made
    return _decision.weights[key][1]


def joined(*parts: Tensor) -> Tensor:
    """Parts (..., Dk) of one input side by side, in the precision of products, with zeros up to a whole piece."""
    dtype, width = _precision(parts[0]), sum(part.shape[-1] for part in parts)
    zeros = parts[0].new_zeros((), dtype=dtype).expand(*parts[0].shape[:-1], -width % PIECE)
    return torch.cat([*(part.to(dtype) for part in parts), zeros], dim=-1)


def _padded(x: Tensor, width: int) -> Tensor:
    """Inputs (..., D), which `joined` may have made wider, in the precision of products: (..., whole pieces)."""
    x, beyond = x.to(_precision(x)), width + -width % PIECE - x.shape[-1]
    return F.pad(x, (0, beyond)) if beyond else x


def linear(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """`F.linear` with padded sizes: (..., in or as `joined` makes it) -> (..., out), a view where out is padded."""
    out, width = weight.shape
    x = _padded(x, width)
    weight = _prepared(weight, (0, -width % PIECE, 0, -out % PIECE), x.dtype)
    bias = None if bias is None else _prepared(bias, (0, -out % PIECE), x.dtype)
    return F.linear(x, weight, bias)[..., :out]


def ensemble(
    x: Tensor, layers: Sequence[tuple[Tensor, Tensor]], norms: Sequence[tuple[Tensor, Tensor]]
) -> Tensor:
    """`Ensemble.forward` without dropout.

    Args:
        x: (..., in), shared by all K members.
        layers: weight (K, in, out) and bias (K, 1, out) of each.
        norms: scale and shift (K, 1, out) of the LayerNorm after each layer but the last.

    Returns:
        (K, ..., out).
    """
    leading, (members, width, _) = x.shape[:-1], layers[0][0].shape
    h = _padded(x, width).reshape(leading.numel(), -1).expand(members, -1, -1)
    for i, (weight, bias) in enumerate(layers):
        width, out = weight.shape[1:]
        h = _padded(h, width)
        weight = _prepared(weight, (0, -out % PIECE, 0, -width % PIECE), h.dtype)
        h = torch.baddbmm(_prepared(bias, (0, -out % PIECE), h.dtype), h, weight)[..., :out]
        if i < len(norms):
            h = normed(h, *norms[i])
    return h.unflatten(1, leading)


def suits(group_size: int) -> bool:
    """Whether there is a kernel for a softmax in groups of this size."""
    return group_size & (group_size - 1) == 0


def normed(x: Tensor, scale: Tensor, shift: Tensor, *, group_size: int = 0, eps: float = 1e-5) -> Tensor:
    """LayerNorm over the last dimension, then Mish, or a softmax in groups: of x's shape and precision.

    Args:
        x: (..., D), or (K, rows, D) of K members.
        scale, shift: (D,), or (K, 1, D).
        group_size: of consecutive features, a power of two; 0: Mish.
    """
    from franka_wm.models.fused_kernels import norm_and_activation

    return norm_and_activation(x, scale, shift, group_size, eps)


def expectation(logits: Tensor, support: Tensor) -> Tensor:
    """`TwoHotSymlog.decode`: logits (..., bins), support (bins,) -> symexp of its mean (..., 1), float32."""
    from franka_wm.models.fused_kernels import symexp_of_mean

    return symexp_of_mean(logits, support)
