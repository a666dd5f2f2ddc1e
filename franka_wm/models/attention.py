"""Attention over heads, by the quickest kernel for its sizes and device."""

import torch
from torch import Tensor
from torch.nn import functional as F

SHORT = 8
"""Masked sequences up to this length are attended to by `short_attention` on CUDA."""


def attention(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
    """softmax(q kᵀ / √D) v for every head.

    On a CPU, bfloat16 is attended to in float32: the fused kernel's gradient takes two to three times as long in
    bfloat16 (torch 2.11), while products of matrices take a fraction.

    Args:
        q, k, v: (N, heads, L, D).
        mask: broadcasts to (N, heads, L, L), bool, True where the query may attend to the key.

    Returns:
        (N, heads, L, D), of the type of `v`.
    """
    if mask is not None and q.is_cuda and q.shape[-2] <= SHORT:
        return short_attention(q, k, v, mask)
    if q.device.type == "cpu" and q.dtype in (torch.bfloat16, torch.float16):
        # Autocast would cast what goes into this very function back.
        with torch.autocast("cpu", enabled=False):
            return F.scaled_dot_product_attention(q.float(), k.float(), v.float(), attn_mask=mask).to(v.dtype)
    return F.scaled_dot_product_attention(q, k, v, attn_mask=mask)


def short_attention(q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
    """`scaled_dot_product_attention` for sequences of a few tokens, written out.

    Fused kernels work on tiles of at least 64 queries and keys: for a history of three frames, which a planner
    asks about ten thousand times at once, they compute hundreds of products to use nine. Its rounding in bfloat16 is
    a little coarser. Training on CUDA uses it, too.

    Args:
        q, k, v: (N, heads, L, D).
        mask: broadcasts to (N, heads, L, L), bool.
    """
    scores = (q.unsqueeze(3) * k.unsqueeze(2)).sum(-1) * q.shape[-1] ** -0.5
    weights = scores.masked_fill(~mask, -torch.inf).softmax(-1).to(v.dtype)
    return (weights.unsqueeze(-1) * v.unsqueeze(2)).sum(3)
