"""Model-predictive path integral control for all environments at once."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm.errors import UserError
from franka_wm.options import Bounds
from franka_wm.planning.base import ElitePlanner, Query
from franka_wm.planning.sampling import best, gaussian_candidates, take


@dataclass(kw_only=True, eq=False)
class MPPI(ElitePlanner):
    """MPPI as in TD-MPC2 (Hansen, Su & Wang, arXiv:2310.16828): elites, policy candidates, warm start.

    Each of E environments has its own Gaussian over plans (H, A). An iteration draws S candidates, keeps the
    best `num_elites` and refits mean and standard deviation with the weights
    softmax(`temperature` · (v - max v)).

    Differences from the paper's implementation, each for a reason:
      * Elite scores are divided by their standard deviation before the softmax (`normalize`). Otherwise the
        temperature depends on the unit of the reward: with distances in metres all elites weigh the same,
        with returns of hundreds a single one does.
      * The action is the first one of the final mean, not of a randomly drawn elite. With `explore`, noise of
        the final standard deviation is added to it. So without `explore` equal noise gives equal actions.
      * A score that is not finite counts for nothing, instead of as 0, which would be the best where rewards
        are negative.

    Args besides those of `ElitePlanner`:
        min_std, max_std: bounds of the standard deviation, in units of the action; it starts at `max_std`.
        temperature: the higher, the more the best elites dominate (the paper's convention).
        normalize: see above; False is the paper's.
    """

    horizon: int = 3
    num_samples: int = 512
    num_policy_samples: int = 24
    num_elites: int = 64
    iterations: int = 6
    min_std: float = 0.05
    max_std: float = 2.0
    temperature: float = 0.5
    normalize: bool = True

    ranges: ClassVar[Mapping[str, Bounds]] = {
        **ElitePlanner.ranges,
        **dict.fromkeys(("min_std", "max_std", "temperature"), Bounds(above=0)),
    }
    all_by_policy: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_std > self.max_std:
            raise UserError(f"planner.min_std={self.min_std}: must be at most max_std={self.max_std}")

    def search(self, query: Query) -> TensorDict:
        """See `Planner.plan`; with `explore`, the noise has the final standard deviation.

        Returns:
            TensorDict of batch size [E]: `action` (E, A); `plan`, the final mean, and `std`, both (E, H, A);
            `value` (E, 1), the weighted score of the last elites; `effective_samples` (E, 1), 1 / Σ w² of
            their weights, between 1 and `num_elites`.
        """
        mean = self.start(query)
        std = torch.full_like(mean, self.max_std)
        given = self.guided(query)
        drawing = self.num_samples - sum(one.shape[1] for one in given)

        value = effective = mean.new_zeros(mean.shape[0], 1)
        for _ in range(self.iterations):
            drawn = gaussian_candidates(mean, std, drawing, generator=query.generator, **self.bounds)
            actions = torch.cat((*given, drawn), dim=1)
            elite_scores, weights, index = self._elites(query.score(actions))
            elites = take(actions, index)
            w = weights[..., None, None]
            # Rounding can carry a mean of actions at a bound just past it.
            mean = (w * elites).sum(1).clamp(self.low, self.high)
            variance = (w * (elites - mean.unsqueeze(1)).square()).sum(1)
            std = variance.sqrt().clamp(self.min_std, self.max_std)
            value = (weights * elite_scores).sum(1, keepdim=True)
            effective = weights.square().sum(1, keepdim=True).reciprocal()

        own = {"plan": mean, "std": std, "value": value, "effective_samples": effective}
        return self.result(query, mean[:, 0], std[:, 0], **own)

    def _elites(self, scores: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scores (E, S) -> the elites' scores, weights and indices, each (E, num_elites)."""
        index, elite, valid = best(scores, self.num_elites)
        gap = elite - elite.amax(1, keepdim=True)  # 0 for the best, so that -1e9 is below all that count
        if self.normalize:
            gap = gap / (elite.std(1, keepdim=True, correction=0) + 1e-6)
        # Finite instead of -inf: if no candidate is valid, the weights are uniform, not nan.
        weights = (self.temperature * gap).masked_fill(~valid, -1e9).softmax(1)
        return elite, weights, index
