"""Products of float32 matrices on a CPU, by oneDNN."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from torch import Tensor

from franka_wm.errors import UserError

LEAST = 2**20
"""Multiplications, for each thread, of a product that oneDNN gets; its call takes about 10 µs more than MKL's."""

_registered: list[torch.library.Library] = []
"""What takes the place of PyTorch's own kernels, until it is removed from here."""


def prefer_onednn(on: bool = True) -> None:
    """Let oneDNN multiply float32 matrices in this process, or, with ``on=False``, PyTorch's own choice again.

    PyTorch gives them to MKL, which leaves much of a processor of AMD unused. Gradients and compiled code are included.
    Small products and other types stay where they were. Results differ by rounding.

    Raises:
        UserError: If this PyTorch has no oneDNN.
    """
    if on and not torch.backends.mkldnn.is_available():
        raise UserError("trainer.onednn=true: this PyTorch has no oneDNN; give trainer.onednn=false")
    if on == bool(_registered):
        return
    if not on:
        _registered.clear()  # PyTorch's kernels come back with the last reference
        return
    library = torch.library.Library("aten", "IMPL")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "(?s).*previously registered kernel")  # which is meant
        for name, ours in (("mm", _mm), ("addmm", _addmm), ("bmm", _bmm), ("baddbmm", _baddbmm)):
            for variant in (name, f"{name}.out"):  # compiled code has places for results
                plain = torch.library.get_kernel(f"aten::{variant}", "CPU")
                kernel = _kernel(ours, plain.call_boxed)
                library.impl(variant, kernel, "CPU", with_keyset=True, allow_override=True)
    _registered.append(library)


def _kernel(ours: Callable[..., Tensor | None], plain: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """What oneDNN computes, and PyTorch's kernel for all else: also for what is wrong, which it tells."""

    def kernel(
        keys: torch.DispatchKeySet, *given: Tensor, out: Tensor | None = None, **factors: float
    ) -> Tensor:
        found = ours(*given, **factors) if out is None or out.dtype == torch.float32 else None
        if found is None or (out is not None and out.shape != found.shape):
            return plain(keys, *given, **factors, **({} if out is None else {"out": out}))
        return found if out is None else out.copy_(found)

    return kernel


def _mm(a: Tensor, b: Tensor) -> Tensor | None:
    return _product(a, _dense(b)) if _fit(a, b, 2) else None


def _addmm(c: Tensor, a: Tensor, b: Tensor, *, beta: float = 1, alpha: float = 1) -> Tensor | None:
    if not (c.dtype == torch.float32 and beta == alpha == 1 and _fit(a, b, 2)):
        return None
    shape = torch.Size((len(a), b.shape[1]))
    row = c[0] if c.shape == shape and c.stride(0) == 0 else c  # compiled code repeats a bias by its strides
    if row.shape == shape[1:] and row.is_contiguous():
        return _product(a, _dense(b), row)
    return _product(a, _dense(b)).add_(c) if c.shape in (shape, shape[1:]) else None


def _bmm(a: Tensor, b: Tensor) -> Tensor | None:
    if _fit(a, b, 3) and len(a) == len(b):
        pairs = zip(a.unbind(), b.unbind(), strict=True)
        return torch.stack([_product(one, _dense(other)) for one, other in pairs])
    return None


def _baddbmm(c: Tensor, a: Tensor, b: Tensor, *, beta: float = 1, alpha: float = 1) -> Tensor | None:
    product = _bmm(a, b) if c.dtype == torch.float32 and beta == alpha == 1 else None
    return None if product is None else product.add_(c)


def _product(a: Tensor, b: Tensor, bias: Tensor | None = None) -> Tensor:
    """(M, K) by (K, N), and the bias (N,) added."""
    return torch.ops.mkldnn._linear_pointwise.default(a, b.t(), bias, "none", [], "")


def _dense(matrix: Tensor) -> Tensor:
    """Without gaps between rows or columns: a second factor that has some takes oneDNN a thousand times as long."""
    return matrix if matrix.is_contiguous() or matrix.t().is_contiguous() else matrix.contiguous()


def _fit(a: Tensor, b: Tensor, dimensions: int) -> bool:
    """Whether (…, M, K) and (…, K, N) make a large product of float32, the first one row by row or column by column."""
    if not (a.dim() == b.dim() == dimensions and a.dtype == b.dtype == torch.float32):
        return False
    (m, k), (rows, n) = a.shape[-2:], b.shape[-2:]
    down, right = a.stride()[-2:]
    return (
        k == rows
        and m * k * n >= LEAST * torch.get_num_threads()
        and min(m, n) > 1  # a matrix by a vector is read as fast as memory allows
        and ((right == 1 and down >= k) or (down == 1 and right >= m))
    )
