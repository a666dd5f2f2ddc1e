"""Which directions latents use: rank, spread, spectrum, and whether they have collapsed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

SAME_POINT = 0.01
"""Warn below this spread (see :func:`latent_statistics`): all latents are nearly one point."""

FEW_DIRECTIONS = 2.0
"""Warn below this effective rank: an arm alone has seven joints, so states vary in more directions than that."""

LEAST_SAMPLES = 16
"""Fewer latents than this say nothing."""


def rankme(latents: Tensor) -> float:
    """RankMe: exp of the entropy of the singular values (Garrido et al., arXiv:2210.02885, equation 1).

    p_k = σ_k / ‖σ‖₁ + ε, ε = 1e-7; exp(−Σ p_k log p_k). Of the raw latents, as published: a common offset counts as
    a direction.

    Args:
        latents: (n, D).

    Returns:
        Between 1 and min(n, D), up to ε; 0 if all latents are 0.
    """
    return _exp_entropy(torch.linalg.svdvals(latents.double()), 1e-7)


def effective_rank(latents: Tensor) -> float:
    """Number of directions in which latents vary: exp of the entropy of the covariance's normalised eigenvalues.

    Roy & Vetterli, "The effective rank" (EUSIPCO 2007), of the covariance matrix.

    Args:
        latents: (n, D).

    Returns:
        Between 1 and min(n − 1, D); 0 if all latents are the same.
    """
    centred = latents.double() - latents.double().mean(0)
    if _negligible(centred, latents):
        return 0.0
    return _exp_entropy(torch.linalg.svdvals(centred).square(), 0.0)


def mean_cosine(latents: Tensor) -> float:
    """Mean cosine between two different latents, over all pairs.

    Args:
        latents: (n, D), n ≥ 2; a latent of 0 has cosine 0 to all.
    """
    n = latents.shape[0]
    units = torch.nn.functional.normalize(latents.double(), dim=-1, eps=1e-30)
    lengths = units.square().sum()
    return float((units.sum(0).square().sum() - lengths) / (n * (n - 1)))


def latent_statistics(latents: Tensor) -> dict[str, float]:
    """All numbers about a set of latents.

    Args:
        latents: (n, D), n ≥ 2.

    Returns:
        * ``norm``: mean length;
        * ``feature_std``, ``smallest_feature_std``: standard deviation of a feature, mean and least over features;
        * ``spread``: √(Σ variances / mean squared length), from 0 (all latents equal) to 1 (centred at 0);
        * ``rankme``, ``effective_rank``, ``mean_cosine``: see these functions;
        * ``dimensions``, ``samples``: D and n.

    Raises:
        ValueError: Not (n, D) with n ≥ 2, or values that are not finite.
    """
    if latents.dim() != 2 or latents.shape[0] < 2:
        raise ValueError(f"latents must be (n, D) with n of at least 2, got {tuple(latents.shape)}")
    x = latents.detach().double()
    if not bool(torch.isfinite(x).all()):
        raise ValueError("latents must be finite")
    variance = x.var(0, correction=0)
    size = x.square().sum(-1).mean()
    return {
        "norm": float(x.norm(dim=-1).mean()),
        "feature_std": float(variance.sqrt().mean()),
        "smallest_feature_std": float(variance.sqrt().min()),
        "spread": float((variance.sum() / size.clamp_min(1e-30)).sqrt()),
        "rankme": rankme(x),
        "effective_rank": effective_rank(x),
        "mean_cosine": mean_cosine(x),
        "dimensions": float(x.shape[1]),
        "samples": float(x.shape[0]),
    }


def spectrum(latents: Tensor) -> dict[str, Any]:
    """:func:`latent_statistics`, the singular values, and the warning if there is one.

    Args:
        latents: (n, D), n ≥ 2.

    Returns:
        Also ``singular_values``: of the centred latents / √n, descending, min(n, D) of them, in the latents' unit
        (standard deviations along the principal directions); and ``warning``, a text or ``None``.
    """
    statistics = latent_statistics(latents)
    x = latents.detach().double()
    values = torch.linalg.svdvals(x - x.mean(0)) / math.sqrt(x.shape[0])
    return {**statistics, "singular_values": values.tolist(), "warning": collapse_warning(statistics)}


def collapse_warning(statistics: Mapping[str, float]) -> str | None:
    """What is wrong with the latents, in one line, or ``None``.

    Two kinds of collapse are told apart (Jing et al., arXiv:2110.09348): *complete*, where all latents are nearly
    one point (``spread`` below :data:`SAME_POINT`), and *dimensional*, where they lie along hardly more than a
    line (``effective_rank`` below :data:`FEW_DIRECTIONS`, of at least 4 dimensions).

    Args:
        statistics: Statistics of :func:`latent_statistics`, or those of
            :func:`franka_wm.evaluation.health.training_diagnostics`, whose keys begin with ``latent/``.
    """

    def number(name: str) -> float:
        return float(statistics.get(name, statistics.get(f"latent/{name}", math.nan)))

    if number("samples") < LEAST_SAMPLES:
        return None
    spread, rank, dimensions = number("spread"), number("effective_rank"), number("dimensions")
    if spread < SAME_POINT:
        return (
            f"the latents have collapsed to a point: their spread is {100 * spread:.2g} % of their length "
            f"(warning below {100 * SAME_POINT:g} %); what is predicted of them is worth nothing"
        )
    if dimensions >= 4 and rank < FEW_DIRECTIONS:
        return (
            f"the latents have collapsed to {rank:.1f} of {dimensions:.0f} directions (warning below "
            f"{FEW_DIRECTIONS:g}); planning cannot tell most states apart"
        )
    return None


def _exp_entropy(values: Tensor, eps: float) -> float:
    total = values.sum()
    if total <= 0:
        return 0.0
    p = values / total + eps
    return float(torch.special.entr(p).sum().exp())


def _negligible(centred: Tensor, latents: Tensor) -> bool:
    """Whether all that varies is rounding: 1e-7 of the latents' own size, the resolution of float32."""
    return bool(centred.abs().max() <= 1e-7 * latents.abs().max().double())
