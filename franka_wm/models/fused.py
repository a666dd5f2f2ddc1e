"""Kernels that join LayerNorm, activation, bias and casts between two matrix products, for planners on CUDA.

A decision sends thousands of candidates for each arm through small networks. On a GPU the products are soon done; what
stands between them, each a kernel of its own, takes most of the time. Inside :func:`kernels` layers call what is here.
Their own code stays the definition: tests hold both equal. Without gradients, and not inside `torch.compile`, which
does the same by itself.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
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
    """Input of a network over features (..., D) and actions (..., A), not side by side: that would copy both."""

    features: Tensor
    action: Tensor


@dataclass
class _Decision:
    """What holds for the layers inside :func:`kernels`.

    Attributes:
        coarse: whether latents may be left in the precision of products.
        prepared: what was made of a weight, by its address, shape and use; beside the weight, so that it stays there.
    """

    coarse: bool
    prepared: dict[tuple[int, tuple[int, ...], str, torch.dtype], tuple[Tensor, Tensor]] = field(
        default_factory=dict
    )


class _Present(threading.local):
    decision: _Decision | None = None


_present = _Present()


@cache
def ready(kind: str) -> bool:
    """Whether a device of this kind has the kernels: CUDA does, where Triton can compile; if not, it is said once."""
    if kind != "cuda":
        return False
    missing = missing_to_compile(torch.device(kind))
    if missing is None and find_spec("triton") is None:
        missing = "the package triton"
    if missing is not None:
        say(f"planning is slower than it could be: its CUDA kernels need {missing}")
    return missing is None


@contextmanager
def kernels(on: bool = True, *, coarse: bool = False) -> Iterator[None]:
    """Layers inside use the kernels, if `on`. Weights must not change inside.

    Args:
        coarse: latents need not be float32 where products are in bfloat16: only networks read them.
    """
    before, _present.decision = _present.decision, _Decision(coarse) if on else None
    try:
        yield
    finally:
        _present.decision = before


def applies() -> bool:
    """Whether layers use the kernels now."""
    # Asked first: a compiler cannot trace what follows.
    return not torch.compiler.is_compiling() and _present.decision is not None and not torch.is_grad_enabled()


def coarse() -> bool:
    """Whether latents may be left in bfloat16 now."""
    return applies() and _decision().coarse


def suits(weight: Tensor) -> bool:
    """Whether the kernels know this precision of weights: float32, in which they compute."""
    return weight.dtype == torch.float32


def _decision() -> _Decision:
    assert _present.decision is not None
    return _present.decision


def _prepared(weight: Tensor, use: str, dtype: torch.dtype, make: Callable[[Tensor], Tensor]) -> Tensor:
    """What `make` makes of a weight in this precision, once per decision."""
    key, known = (weight.data_ptr(), tuple(weight.shape), use, dtype), _decision().prepared
    if key not in known:
        known[key] = weight, make(weight).to(dtype).contiguous()
    return known[key][1]


def _cast(x: Tensor) -> Tensor:
    """x in the precision of products."""
    kind = x.device.type
    return x.to(torch.get_autocast_dtype(kind)) if torch.is_autocast_enabled(kind) else x


def _pieces(x: Tensor, dim: int = -1) -> Tensor:
    """With zeros at the end of a dimension, up to a whole piece."""
    lacking = -x.shape[dim] % PIECE
    return F.pad(x, (0, 0) * (-dim - 1) + (0, lacking)) if lacking else x


def _aligned(x: Tensor) -> Tensor:
    """Inputs (..., D) in whole pieces, and rows that begin at one: those of a slice may not."""
    x = _pieces(x)
    return x.contiguous() if x.dim() > 1 and x.stride(-2) % PIECE else x


def _in_order(x: Tensor) -> tuple[Tensor, list[int]]:
    """x (..., D) with its leading dimensions in the order of memory, so that a product need not copy; and the order."""
    order = sorted(range(x.dim() - 1), key=lambda k: -x.stride(k))
    return x.permute(*order, -1), order


def _restored(y: Tensor, order: list[int]) -> Tensor:
    """The result with its leading dimensions as they were before `_in_order`."""
    return y.permute(*(order.index(k) for k in range(len(order))), -1)


def _columns(first: int) -> Callable[[Tensor], Tensor]:
    """Takes the first columns of a weight (..., out, in), in whole pieces."""
    return lambda weight: _pieces(_pieces(weight[..., :first]), -2)


def _require_width(features: Tensor, action: Tensor | None, width: int) -> None:
    given = features.shape[-1] + (0 if action is None else action.shape[-1])
    if given != width:
        raise ValueError(f"inputs have {given} features, the layer reads {width}")


def linear(x: Tensor | Joined, weight: Tensor, bias: Tensor | None) -> Tensor:
    """`F.linear`: (..., in) -> (..., out), a view where out is no whole piece."""
    x = _cast(torch.cat((x.features, x.action), -1) if isinstance(x, Joined) else x)
    out, width = weight.shape
    _require_width(x, None, width)
    bias = None if bias is None else _prepared(bias, "bias", x.dtype, _pieces)
    x, order = _in_order(x)
    product = F.linear(_aligned(x), _prepared(weight, f"first {width}", x.dtype, _columns(width)), bias)
    return _restored(product[..., :out], order)


def normed_linear(
    x: Tensor | Joined,
    weight: Tensor,
    bias: Tensor | None,
    scale: Tensor,
    shift: Tensor,
    *,
    group_size: int,
    eps: float,
) -> Tensor:
    """Linear, LayerNorm, and Mish or a softmax in groups of `group_size`, 0 for Mish: (..., in) -> (..., out)."""
    from franka_wm.models.fused_kernels import bias_norm_activation

    features, action = x if isinstance(x, Joined) else (x, None)
    _require_width(features, action, weight.shape[1])
    features, order = _in_order(_cast(features))
    weights = _prepared(weight, f"first {features.shape[-1]}", features.dtype, _columns(features.shape[-1]))
    y = bias_norm_activation(
        F.linear(_aligned(features), weights)[..., : len(weight)],
        bias if bias is not None else weight.new_zeros(len(weight)),
        scale,
        shift,
        *_of_action(None if action is None else action.permute(*order, -1), weight),
        group_size=group_size,
        eps=eps,
        # As without the kernels: a softmax in groups gives latents, which are float32 unless they may be coarse.
        dtype=torch.float32 if group_size and not _decision().coarse else None,
    )
    return _restored(y, order)


def ensemble(
    x: Tensor | Joined,
    layers: Sequence[tuple[Tensor, Tensor]],
    norms: Sequence[tuple[Tensor, Tensor]],
    members: Tensor | int | None = None,
) -> Tensor:
    """`Ensemble.forward` without dropout.

    Args:
        x: (..., in), shared by all M members.
        layers: weight (M, in, out) and bias (M, 1, out) of each.
        norms: scale and shift (M, 1, out) of the LayerNorm after each layer but the last.
        members: indices (K,), or the first so many; all when None.

    Returns:
        (K, ..., out).
    """
    from franka_wm.models.fused_kernels import bias_norm_activation

    def some(parameter: Tensor) -> Tensor:
        if members is None or isinstance(members, int):
            return parameter[:members]
        return parameter.index_select(0, members)

    if isinstance(x, Joined) and not norms:
        x = torch.cat(x, -1)
    features, action = x if isinstance(x, Joined) else (x, None)
    _require_width(features, action, layers[0][0].shape[1])
    leading, h = features.shape[:-1], _cast(features)
    h = h.reshape(1, -1, h.shape[-1])

    def weights(weight: Tensor) -> Tensor:
        """(K, in, out) for the present inputs, transposed in memory: so the product reads rows of both."""
        width = h.shape[-1]
        return some(_prepared(weight.mT, f"first {width}", h.dtype, _columns(width))).mT

    for (weight, bias), (scale, shift) in zip(layers[:-1], norms, strict=True):
        own = weights(weight)
        product = (_aligned(h).expand(len(own), -1, -1) @ own)[..., : weight.shape[2]]
        given, columns = _of_action(action, weight.mT)
        columns = None if columns is None else some(columns)
        h = bias_norm_activation(product, some(bias), some(scale), some(shift), given, columns)
        action = None  # the first layer's alone
    weight, bias = layers[-1]
    own, bias = weights(weight), some(_prepared(bias, "bias", h.dtype, _pieces))
    h = torch.baddbmm(bias, _aligned(h).expand(len(own), -1, -1), own)[..., : weight.shape[2]]
    return h.reshape(len(own), *leading, weight.shape[2])


def _of_action(action: Tensor | None, weight: Tensor) -> tuple[Tensor, Tensor] | tuple[None, None]:
    """Actions (rows, A), and their columns of a weight (..., out, in): (..., A, out); None where there are none."""
    if action is None:
        return None, None
    count = action.shape[-1]
    columns = _prepared(weight, f"last {count}", torch.float32, lambda w: w[..., -count:].mT)
    return action.reshape(-1, count).contiguous(), columns


def expectation(logits: Tensor, support: Tensor) -> Tensor:
    """`TwoHotSymlog.decode`: logits (..., bins), support (bins,) -> symexp of its mean (..., 1), float32."""
    from franka_wm.models.fused_kernels import symexp_of_mean

    logits, order = _in_order(logits)
    return _restored(symexp_of_mean(logits, support), order)
