"""The cross-entropy method for all environments at once."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict

from franka_wm.errors import UserError
from franka_wm.options import Bounds
from franka_wm.planning.base import ElitePlanner, Query
from franka_wm.planning.sampling import best, gaussian_candidates, refit, take


@dataclass(kw_only=True, eq=False)
class CEM(ElitePlanner):
    """Cross-entropy method (Rubinstein & Kroese, 2004), with the numbers of LeWorldModel's planning.

    Each of E environments has its own Gaussian over plans (H, A). An iteration draws S candidates and refits
    mean and standard deviation to the best `num_elites`, each weighing the same. One iteration with one
    elite is random shooting.

    The mean itself is always a candidate, so that the search cannot forget a good plan it started from. The
    standard deviation has a floor, `min_std`, without which there would be nothing left to explore with;
    0 is the plain method. A score that is not finite counts for nothing.

    Args besides those of `ElitePlanner`:
        num_samples: S, candidates per environment and iteration, the mean and those of the policy included.
        momentum: share of the old mean and standard deviation that each refit keeps.
        std: standard deviation that every search starts with, in units of the action.
        min_std: the least it becomes.
    """

    horizon: int = 5
    num_samples: int = 300
    num_elites: int = 30
    iterations: int = 10
    momentum: float = 0.0
    std: float = 1.0
    min_std: float = 0.05

    ranges: ClassVar[Mapping[str, Bounds]] = {
        **ElitePlanner.ranges,
        "momentum": Bounds(least=0, below=1),
        "std": Bounds(above=0),
        "min_std": Bounds(least=0),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_std > self.std:
            raise UserError(f"planner.min_std={self.min_std}: must be at most std={self.std}")

    def search(self, query: Query) -> TensorDict:
        """See `Planner.plan`; with `explore`, the noise has the final standard deviation.

        Returns:
            TensorDict of batch size [E]: `action` (E, A), the first of the final mean; `plan`, the final
            mean, and `std`, both (E, H, A); `value` (E, 1), the mean score of the last elites.
        """
        mean = self.start(query).clamp(self.low, self.high)
        std = torch.full_like(mean, self.std)
        given = self.guided(query)
        drawing = self.num_samples - 1 - sum(one.shape[1] for one in given)

        value = mean.new_zeros(mean.shape[0], 1)
        for _ in range(self.iterations):
            drawn = gaussian_candidates(mean, std, drawing, generator=query.generator, **self.bounds)
            actions = torch.cat((mean.unsqueeze(1), *given, drawn), dim=1)
            elites = best(query.score(actions), self.num_elites)
            mean, std = refit(take(actions, elites.which), elites.valid, mean, std, momentum=self.momentum)
            # Rounding can carry a mean of actions at a bound just past it.
            mean, std = mean.clamp(self.low, self.high), std.clamp(min=self.min_std)
            value = elites.mean_score()

        return self.result(query, mean[:, 0], std[:, 0], plan=mean, std=std, value=value)
