"""What can be read off a latent: ridge and nearest-neighbour probes for physical quantities."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

ALPHAS = tuple(10.0**k for k in range(-4, 5))
"""Ridge penalties that :func:`ridge_probe` chooses from."""

NOISE = 1e-6
"""A target whose standard deviation [m, rad, m/s or rad/s] is smaller does not vary: it is what rounding leaves."""

NEIGHBOURS = 5
"""k of the nearest-neighbour probe; fewer where there are fewer steps to look up."""


def ridge(x: Tensor, y: Tensor, alpha: float) -> tuple[Tensor, Tensor]:
    """Linear regression with a penalty on the weights, in closed form; the offset is not penalised.

    Minimises ‖Y − X W − b‖² + ``alpha`` ‖W‖² (Hoerl & Kennard, 1970).

    Args:
        x: (n, D).
        y: (n, T).
        alpha: At least 0; above 0 where X has fewer than D independent rows.

    Returns:
        Weights (D, T) and offset (T), float64.
    """
    x, y = x.double(), y.double()
    x_mean, y_mean = x.mean(0), y.mean(0)
    a = x - x_mean
    eye = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
    weights = torch.linalg.solve(a.mT @ a + alpha * eye, a.mT @ (y - y_mean))
    return weights, y_mean - x_mean @ weights


def nearest_neighbours(x_train: Tensor, y_train: Tensor, x: Tensor, k: int = NEIGHBOURS) -> Tensor:
    """Mean target of the ``k`` nearest training points, by Euclidean distance.

    Args:
        x_train: (n, D).
        y_train: (n, T).
        x: (m, D).
        k: From 1 to n.

    Returns:
        (m, T) float64; NaN where a point is not a number, or its neighbours are not.

    Raises:
        ValueError: ``k`` out of range.
    """
    if not 1 <= k <= x_train.shape[0]:
        raise ValueError(f"k={k}: must be from 1 to {x_train.shape[0]}, the number of training points")
    y = y_train.double()
    rows = []
    for part in x.double().split(1024):
        nearest = torch.cdist(part, x_train.double()).topk(k, largest=False)
        # What is not a number has no neighbours; topk would give it some.
        lost = nearest.values.isnan().any(1, keepdim=True)
        rows.append(torch.where(lost, torch.nan, y[nearest.indices].mean(1)))
    return torch.cat(rows)


def r_squared(truth: Tensor, predicted: Tensor) -> float | None:
    """Share of the variance that is explained: 1 − Σ(y − ŷ)² / Σ(y − ȳ)², mean over targets.

    Args:
        truth, predicted: (m, T).

    Returns:
        At most 1; below 0 for what is worse than the mean. ``None`` if no target varies; targets that do not vary
        (a fixed goal) are left out.
    """
    y, error = truth.double(), (truth - predicted).double()
    total = (y - y.mean(0)).square().sum(0)
    varies = total > torch.maximum(1e-10 * y.square().sum(0), torch.tensor(NOISE**2 * len(y)))
    if not bool(varies.any()):
        return None
    return float((1 - error.square().sum(0)[varies] / total[varies]).mean())


def split_by_episode(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Episodes to fit (60 %), to choose the penalty by (20 %) and to test on (20 %), at least one each.

    Neighbouring steps of an episode are nearly the same: a split by step would let a probe look its answers up.

    Args:
        count: Number of episodes, at least 3.

    Returns:
        Three disjoint index tensors.

    Raises:
        ValueError: Fewer than 3 episodes.
    """
    if count < 3:
        raise ValueError(f"{count} episodes cannot be split into fit, validation and test; use at least 3")
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    test = validation = max(1, round(0.2 * count))
    fit = count - test - validation
    return order[:fit], order[fit : fit + validation], order[fit + validation :]


def ridge_probe(
    fit: tuple[Tensor, Tensor], validation: tuple[Tensor, Tensor], test: Tensor
) -> tuple[Tensor, float]:
    """Predictions (m, T) of a ridge probe for ``test`` (m, D), and the penalty chosen on ``validation``.

    Features are standardised by ``fit``; the probe is then fitted anew on both. Pairs are (n, D) and (n, T).
    """
    mean, std = fit[0].double().mean(0), fit[0].double().std(0).clamp_min(1e-8)

    def scaled(x: Tensor) -> Tensor:
        return (x.double() - mean) / std

    def error(alpha: float) -> float:
        weights, offset = ridge(scaled(fit[0]), fit[1], alpha)
        residual = validation[1] - (scaled(validation[0]) @ weights + offset)
        # In units of each target's own deviation, so that none rules the choice by its unit.
        return float((residual / fit[1].double().std(0).clamp_min(1e-8)).square().mean())

    alpha = min(ALPHAS, key=error)
    x, y = (torch.cat(pair) for pair in zip(fit, validation, strict=True))
    weights, offset = ridge(scaled(x), y, alpha)
    return scaled(test) @ weights + offset, alpha


def probe(
    latents: Tensor, targets: Mapping[str, Tensor], *, valid: Tensor | None = None
) -> dict[str, dict[str, float | None]]:
    """How well each target can be read off the latents, on episodes that no probe was fitted to.

    Args:
        latents: (E, T, D), E ≥ 3 episodes.
        targets: Name → (E, T, K).
        valid: (E, T) bool, which steps to use; all if not given.

    Returns:
        Name → ``ridge`` and ``neighbours``, both R² on the test episodes; ``None`` where the target does not vary.
    """
    valid = torch.ones(latents.shape[:2], dtype=torch.bool) if valid is None else valid
    parts = [index.to(latents.device) for index in split_by_episode(latents.shape[0])]

    def split(values: Tensor) -> list[Tensor]:
        return [values[index][valid.to(values.device)[index]].double() for index in parts]

    x_fit, x_validation, x_test = split(latents)
    known = torch.cat((x_fit, x_validation))
    mean, std = known.mean(0), known.std(0).clamp_min(1e-8)
    results = {}
    for name, values in targets.items():
        y_fit, y_validation, y_test = split(values)
        linear, _ = ridge_probe((x_fit, y_fit), (x_validation, y_validation), x_test)
        near = nearest_neighbours(
            (known - mean) / std,
            torch.cat((y_fit, y_validation)),
            (x_test - mean) / std,
            k=min(NEIGHBOURS, len(known)),
        )
        results[name] = {"ridge": r_squared(y_test, linear), "neighbours": r_squared(y_test, near)}
    return results
