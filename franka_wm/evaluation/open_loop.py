"""What a model predicts without looking: latent error by horizon, ranks of distances, calibration of values."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from franka_wm.evaluation.calibration import calibration_bins
from franka_wm.evaluation.intervals import Interval, bootstrap_ratio

if TYPE_CHECKING:
    from franka_wm.models.base import WorldModel

PAIRS = 2000
"""Random pairs of states that a rank correlation is measured over."""

RESAMPLES = 2000
"""Draws of whole episodes behind the interval of such a correlation."""

_DRAWN_AT_ONCE = 250


class NothingToPredictError(ValueError):
    """Latents that never change, or episodes that are shorter than the horizon: a ratio of errors is not defined."""


@torch.no_grad()
def horizon_error(
    model: WorldModel, latents: Tensor, actions: Tensor, *, horizon: int = 10, valid: Tensor | None = None
) -> dict[str, Any]:
    """Error of predicted latents by horizon, against the encoded truth and against "nothing changes".

    From every step of every episode the model is unrolled with the actions that were really taken. The error at h
    is ‖ẑ_{t+h} − z_{t+h}‖², that of no change ‖z_t − z_{t+h}‖², both on ``model.embed`` where the family has it.
    Their ratio is 0 for a perfect model, 1 for one that says that nothing changes, and above 1 for one
    that would better say so.

    Args:
        model: With ``next``.
        latents: (E, T + 1, Z), the encoded truth.
        actions: (E, T, A), or (E, T) of discrete ones.
        horizon: Largest h; at most T.
        valid: (E, T + 1) bool, which latents are of the first episode; all if not given.

    Returns:
        ``steps`` [1 … H]; ``curves``: under ``model`` the ratio, ``mean``, ``low`` and ``high`` (H values each, 95 %
        intervals by a bootstrap that draws whole episodes, since the windows of one are alike), and under
        ``no_change`` that baseline, 1; ``unit``, in words; ``error`` and ``no_change_error``, means of
        the squared distances; ``windows`` behind the longest horizon and ``episodes``.

    Raises:
        NothingToPredictError: Latents that never change, or no episode of that length.
        ValueError: Less than one step, or shapes that do not fit.
    """
    envs, steps = actions.shape[:2]
    if latents.shape[:2] != (envs, steps + 1):
        raise ValueError(f"latents {tuple(latents.shape)} do not fit to actions {tuple(actions.shape)}")
    if horizon < 1 or steps < 1:
        raise ValueError(f"horizon={horizon} over {steps} steps: both must be at least 1")
    horizon = min(horizon, steps)
    embed = model.embed
    valid = torch.ones(envs, steps + 1, dtype=torch.bool, device=latents.device) if valid is None else valid
    truth = embed(latents)
    predicted = latents[:, :-1]
    errors, ratios, no_change = [], [], []
    windows = 0
    for h in range(1, horizon + 1):
        starts = steps + 1 - h
        predicted = model.next(predicted[:, :starts], actions[:, h - 1 :])
        # An episode that ended early is valid to a point: then a window is if its last step is.
        use = valid[:, h:].double()
        error = (embed(predicted) - truth[:, h:]).double().square().sum(-1)
        still = (truth[:, :starts] - truth[:, h:]).double().square().sum(-1)
        top, bottom = (torch.where(use > 0, x, 0.0).sum(1).cpu() for x in (error, still))
        windows = int(use.sum())
        if not windows:
            raise NothingToPredictError(f"no episode lasts {h} steps: there is nothing to predict")
        if float(bottom.sum()) <= 0:
            raise NothingToPredictError(f"no latent changes within {h} steps: there is nothing to predict")
        errors.append(float(top.sum()) / windows)
        no_change.append(float(bottom.sum()) / windows)
        ratios.append(bootstrap_ratio(top, bottom).as_dict())
    curve = {name: [ratio[name] for ratio in ratios] for name in ("mean", "low", "high")}
    return {
        "steps": list(range(1, horizon + 1)),
        "curves": {"model": curve, "no_change": {"mean": [1.0] * horizon}},
        "unit": "error relative to no change",
        "error": errors,
        "no_change_error": no_change,
        "windows": windows,
        "episodes": envs,
    }


def correlation(x: Tensor, y: Tensor) -> float:
    """Pearson's correlation of two vectors; NaN where one of them never varies."""
    a, b = (v.double() - v.double().mean() for v in (x, y))
    size = math.sqrt(float(a.square().sum()) * float(b.square().sum()))
    return max(-1.0, min(1.0, float((a * b).sum()) / size)) if size > 0 else math.nan


def grouped_spearman(x: Tensor, y: Tensor, groups: Tensor, *, seed: int = 0) -> Interval:
    """Spearman's rank correlation of pairs of states, with a 95 % interval that draws whole episodes.

    Many pairs from few episodes are not independent: each resample draws as many episodes as there are, with
    repetition (a cluster bootstrap: Field & Welsh, "Bootstrapping clustered data", JRSS B 69, 2007). A pair of two
    episodes counts as often as their copies can be paired, a pair within one as often as that one was drawn, and
    the ranks are those of the resample.

    Args:
        x, y: (n,), n ≥ 4.
        groups: (n, 2) the episodes, from 0, that the two states of each pair are from.
        seed: Seed of the draw.

    Returns:
        In [−1, 1]; NaN where one of them never varies. Pairs of a single episode have no spread: low = mean = high.

    Raises:
        ValueError: Other shapes.
    """
    n = x.numel()
    if x.dim() != 1 or x.shape != y.shape or groups.shape != (n, 2) or n < 4:
        raise ValueError(
            f"give two vectors of the same length, at least 4, and (n, 2) groups, not {tuple(x.shape)}, "
            f"{tuple(y.shape)}, {tuple(groups.shape)}"
        )
    rho = correlation(_ranks(x), _ranks(y))
    # Episodes that no pair is from cannot be told from those that do not exist.
    names, groups = torch.unique(groups, return_inverse=True)
    if math.isnan(rho) or names.numel() < 2:
        return Interval(rho, rho, rho)
    one, two = groups.unbind(1)
    within = one == two
    places = [torch.unique(v, return_inverse=True) for v in (x, y)]
    generator = torch.Generator().manual_seed(seed)
    found = []
    for start in range(0, RESAMPLES, _DRAWN_AT_ONCE):
        count = min(_DRAWN_AT_ONCE, RESAMPLES - start)
        drawn = torch.randint(names.numel(), (count, names.numel()), generator=generator)
        copies = torch.zeros(count, names.numel(), dtype=torch.double)
        copies.scatter_add_(1, drawn, torch.ones_like(drawn, dtype=torch.double))
        weights = torch.where(within, copies[:, one], copies[:, one] * copies[:, two])
        total = weights.sum(1, keepdim=True)
        a, b = (_centred_ranks(place, values.numel(), weights, total) for values, place in places)
        size = ((weights * a * a).sum(1) * (weights * b * b).sum(1)).sqrt()
        found.append((weights * a * b).sum(1)[size > 0] / size[size > 0])
    draws = torch.cat(found)
    if not draws.numel():
        return Interval(rho, rho, rho)
    low, high = torch.quantile(draws, torch.tensor([0.025, 0.975], dtype=torch.double)).tolist()
    return Interval(rho, max(-1.0, min(low, rho)), min(1.0, max(high, rho)))


def _ranks(x: Tensor) -> Tensor:
    """Ranks from 1 (n,), equal values sharing their mean rank."""
    from scipy.stats import rankdata

    return torch.from_numpy(rankdata(x.cpu().numpy()))


def _centred_ranks(place: Tensor, values: int, weights: Tensor, total: Tensor) -> Tensor:
    """Ranks (B, n) minus their mean, where pair i is there ``weights[:, i]`` times; ``place`` sorts the values."""
    here = torch.zeros(len(weights), values, dtype=torch.double).index_add_(1, place, weights)
    rank = (here.cumsum(1) - here / 2)[:, place]
    return rank - (weights * rank).sum(1, keepdim=True) / total.clamp_min(1.0)


def cost_ranks(
    latents: Tensor,
    positions: Tensor,
    *,
    embed: Callable[[Tensor], Tensor] = lambda z: z,
    valid: Tensor | None = None,
    pairs: int = PAIRS,
    seed: int = 0,
) -> dict[str, dict[str, float]]:
    """Whether latents that are further apart belong to tools that are further apart.

    Spearman's correlation over random pairs of states, of the latent cost ‖embed(z) − embed(z')‖² with the true
    distance between the tool positions.

    Args:
        latents: (E, T, Z).
        positions: (E, T, 3), the tool [m].
        embed: What costs are measured on.
        valid: (E, T) bool, which states to use.
        pairs: Number of pairs of each kind.
        seed: Seed of the draw.

    Returns:
        ``across``: pairs from anywhere; ``within``: pairs of one episode, which share its goal, as the states that
        a planner compares do. Each an interval, by :func:`grouped_spearman`: whole episodes are drawn. NaN where
        fewer than 4 pairs can be drawn.
    """
    generator = torch.Generator().manual_seed(seed)
    envs, steps = latents.shape[:2]
    embedded, positions = embed(latents).cpu(), positions.cpu()
    valid = torch.ones(envs, steps, dtype=torch.bool) if valid is None else valid.cpu()

    def measured(e1: Tensor, t1: Tensor, e2: Tensor, t2: Tensor) -> dict[str, float]:
        use = valid[e1, t1] & valid[e2, t2] & ((e1 != e2) | (t1 != t2))
        if use.sum() < 4:  # episodes of a step or two
            return Interval(math.nan, math.nan, math.nan).as_dict()
        e1, t1, e2, t2 = e1[use], t1[use], e2[use], t2[use]
        cost = (embedded[e1, t1] - embedded[e2, t2]).square().sum(-1)
        distance = (positions[e1, t1] - positions[e2, t2]).norm(dim=-1)
        return grouped_spearman(cost, distance, torch.stack((e1, e2), 1), seed=seed).as_dict()

    def draw(size: int) -> Tensor:
        return torch.randint(size, (pairs,), generator=generator)

    one, two, three, four = draw(envs), draw(steps), draw(envs), draw(steps)
    return {"across": measured(one, two, three, four), "within": measured(one, two, one, four)}


def value_calibration(predicted: Tensor, returns: Tensor) -> dict[str, object]:
    """Predicted values against true discounted returns.

    Args:
        predicted: (n,).
        returns: (n,), true.

    Returns:
        ``slope`` and ``intercept`` of the line return = slope · value + intercept: 1 and 0 for an exact value;
        ``bias``: mean of value − return, above 0 for an optimist; ``error``: root mean square of that;
        ``correlation`` (Pearson); ``samples``; and of bins of equal count along the prediction the means ``predicted``
        and ``true``, the middle half of the returns ``low`` and ``high``, and the ``count``. Slope, intercept and
        correlation are NaN where the value never varies.

    Raises:
        ValueError: Other shapes or no values.
    """
    if predicted.dim() != 1 or predicted.shape != returns.shape or not predicted.numel():
        raise ValueError(
            f"give two vectors of the same length, not {tuple(predicted.shape)}, {tuple(returns.shape)}"
        )
    p, r = predicted.double().cpu(), returns.double().cpu()
    centred = p - p.mean()
    spread = float(centred.square().sum())
    slope = float((centred * (r - r.mean())).sum()) / spread if spread > 0 else math.nan
    return {
        "slope": slope,
        "intercept": float(r.mean()) - slope * float(p.mean()),
        "bias": float((p - r).mean()),
        "error": float((p - r).square().mean().sqrt()),
        "correlation": correlation(p, r),
        "samples": p.numel(),
        **calibration_bins(p.numpy(), r.numpy()),
    }


def steps_until_forgotten(discount: float) -> int:
    """Steps after which rewards weigh less than 2 % in a discounted return; at most 400."""
    if discount <= 0:
        return 1
    return 400 if discount >= 1 else min(400, math.ceil(math.log(0.02) / math.log(discount)))
