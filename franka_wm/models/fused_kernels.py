"""The Triton kernels of :mod:`franka_wm.models.fused`; imported when the first of them is called."""

# pyright: reportIndexIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false

import torch
import triton
import triton.language as tl
from torch import Tensor

MANY_ROWS = 8192
"""From so many rows on, each program takes several."""


@triton.jit
def _bias_norm_activation(
    x,
    y,
    bias,
    scale,
    shift,
    action,
    own,
    rows,
    per,
    stride,
    action_stride,
    eps,
    D: tl.constexpr,
    A: tl.constexpr,
    BLOCK: tl.constexpr,
    R: tl.constexpr,
    GROUP: tl.constexpr,
):
    first = tl.program_id(0).to(tl.int64) * R
    member = first // per  # of an ensemble; R divides its rows
    row = first + tl.arange(0, R)
    column = tl.arange(0, BLOCK)
    real = column < D
    there = (row < rows)[:, None] & real[None, :]
    h = tl.load(x + row[:, None] * stride + column[None, :], mask=there, other=0.0).to(tl.float32)
    h += tl.load(bias + member * D + column, mask=real, other=0.0).to(tl.float32)[None, :]
    for k in tl.static_range(A):
        a = tl.load(action + (row - member * per) * action_stride + k, mask=row < rows, other=0.0)
        weight = tl.load(own + (member * A + k) * D + column, mask=real, other=0.0)
        h += a.to(tl.float32)[:, None] * weight[None, :]
    apart = tl.where(real[None, :], h - (tl.sum(h, 1) / D)[:, None], 0.0)
    h = apart * tl.rsqrt(tl.sum(apart * apart, 1) / D + eps)[:, None]
    h = h * tl.load(scale + member * D + column, mask=real, other=0.0).to(tl.float32)[None, :]
    h += tl.load(shift + member * D + column, mask=real, other=0.0).to(tl.float32)[None, :]
    if GROUP == 0:
        # mish(h) = h · tanh(log(1 + e^h)) = h · (e^2h + 2 e^h) / (e^2h + 2 e^h + 2), which is h from 20 on
        e = tl.exp(tl.minimum(h, 20.0))
        part = e * (e + 2.0)
        h = h * part / (part + 2.0)
    else:
        groups = tl.reshape(h, (R, BLOCK // GROUP, GROUP))
        groups = tl.exp(groups - tl.max(groups, 2)[:, :, None])
        h = tl.reshape(groups / tl.sum(groups, 2)[:, :, None], (R, BLOCK))
    tl.store(y + row[:, None] * D + column[None, :], h.to(y.dtype.element_ty), mask=there)


@triton.jit
def _symexp_of_mean(
    logits, support, y, rows, stride, BINS: tl.constexpr, BLOCK: tl.constexpr, R: tl.constexpr
):
    row = tl.program_id(0).to(tl.int64) * R + tl.arange(0, R)
    column = tl.arange(0, BLOCK)
    real = (column < BINS)[None, :]
    there = (row < rows)[:, None] & real
    h = tl.load(logits + row[:, None] * stride + column[None, :], mask=there, other=0.0).to(tl.float32)
    h = tl.where(real, h, -float("inf"))
    e = tl.exp(h - tl.max(h, 1)[:, None])
    points = tl.load(support + column, mask=column < BINS, other=0.0).to(tl.float32)
    mean = tl.sum(e * points[None, :], 1) / tl.sum(e, 1)
    size = tl.abs(mean)
    # e^size - 1 loses what is small: there by its series.
    series = size * (1.0 + size * (0.5 + size * (1.0 / 6.0 + size * (1.0 / 24.0))))
    size = tl.where(size < 0.05, series, tl.exp(size) - 1.0)
    tl.store(y + row, tl.where(mean < 0.0, -size, size), mask=row < rows)


def _rows(x: Tensor) -> Tensor:
    """The same numbers as (rows, D), without a copy where rows lie at equal distances."""
    return x.reshape(-1, x.shape[-1]) if x.stride(-1) == 1 else x.contiguous().view(-1, x.shape[-1])


def bias_norm_activation(
    x: Tensor,
    bias: Tensor,
    scale: Tensor,
    shift: Tensor,
    action: Tensor | None,
    own: Tensor | None,
    *,
    group_size: int = 0,
    eps: float = 1e-5,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """What follows the product x of features: (..., D), or (K, rows, D) of an ensemble's K members.

    Args:
        bias, scale, shift: (D,), or (K, 1, D).
        action, own: (rows, A) without gaps and their weights (A, D) or (K, A, D), which are added; None: nothing is.
        group_size: of consecutive features, a power of two, for a softmax in each; 0: Mish.
        dtype: of the result; None: x's.

    Raises:
        ValueError: features that make no whole groups.
    """
    flat, size = _rows(x), x.shape[-1]
    if group_size and size % group_size:
        raise ValueError(f"{size} features make no whole groups of {group_size}")
    rows, per = flat.shape[0], flat.shape[0] // (bias.numel() // size)
    y = torch.empty(x.shape, device=x.device, dtype=x.dtype if dtype is None else dtype)
    together = 4 if rows >= MANY_ROWS and per % 4 == 0 else 1
    given = flat[:, :0] if action is None else action
    with torch.cuda.device_of(x):  # Triton launches on the present one
        _bias_norm_activation[(triton.cdiv(rows, together),)](
            flat, y, bias.contiguous(), scale.contiguous(), shift.contiguous(), given, flat if own is None else own,
            rows, per, flat.stride(0), given.stride(0), eps,
            D=size, A=given.shape[1], BLOCK=triton.next_power_of_2(size), R=together, GROUP=group_size, num_warps=4,
        )  # fmt: skip
    return y


def symexp_of_mean(logits: Tensor, support: Tensor) -> Tensor:
    """Logits (..., bins), support (bins,) -> symexp of its mean (..., 1), float32."""
    flat = _rows(logits)
    rows, bins = flat.shape
    y = torch.empty((*logits.shape[:-1], 1), device=logits.device)
    together = 8 if rows >= MANY_ROWS else 1
    with torch.cuda.device_of(logits):
        _symexp_of_mean[(triton.cdiv(rows, together),)](
            flat, support, y, rows, flat.stride(0),
            BINS=bins, BLOCK=triton.next_power_of_2(bins), R=together, num_warps=4 if together > 1 else 1,
        )  # fmt: skip
    return y
