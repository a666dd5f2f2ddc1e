"""The cross-entropy method for all environments at once."""

import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm.planning.objectives import Score
from franka_wm.planning.sampling import (
    Next,
    Prior,
    best,
    explored,
    gaussian_candidates,
    refit,
    require_bounds,
    require_counts,
    require_deviations,
    require_fraction,
    require_samples,
    roll_prior,
    rollout,
    take,
    warm_start,
)


class CEM:
    """Cross-entropy method (Rubinstein & Kroese, 2004), with the numbers of LeWorldModel's planning.

    Each of E environments has its own Gaussian over plans (H, A). An iteration draws S candidates and refits
    mean and standard deviation to the best `num_elites`, each weighing the same. One iteration with one
    elite is random shooting.

    The mean itself is always a candidate, so that the search cannot forget a good plan it started from. The
    standard deviation has a floor, `min_std`, without which there would be nothing left to explore with;
    0 is the plain method. A score that is not finite counts for nothing.

    Plain tensor code, see `MPPI`. Rollouts hold E · S · (H + 1) · D numbers.

    Args:
        action_dim: A.
        horizon: H, steps looked ahead.
        num_samples: S, candidates per environment and iteration, the mean and those of the policy included.
        num_policy_samples: how many of them are rolled out with `prior`, if `plan` gets one.
        num_elites: how many candidates the Gaussian is refitted to.
        iterations: rounds of sampling and refitting.
        momentum: share of the old mean and standard deviation that each refit keeps.
        std: standard deviation that every search starts with, in units of the action.
        min_std: the least it becomes.
        low, high: bounds of every action component.

    Raises:
        ValueError: a setting that cannot work.
    """

    def __init__(
        self,
        *,
        action_dim: int,
        horizon: int = 5,
        num_samples: int = 300,
        num_policy_samples: int = 0,
        num_elites: int = 30,
        iterations: int = 10,
        momentum: float = 0.0,
        std: float = 1.0,
        min_std: float = 0.05,
        low: float = -1.0,
        high: float = 1.0,
    ) -> None:
        require_counts(
            action_dim=action_dim,
            horizon=horizon,
            num_samples=num_samples,
            num_elites=num_elites,
            iterations=iterations,
        )
        require_samples(num_samples, num_policy_samples, num_elites)
        require_fraction(momentum=momentum)
        require_deviations(std, min_std)
        require_bounds(low, high)
        self.action_dim, self.horizon, self.iterations = action_dim, horizon, iterations
        self.num_samples, self.num_policy_samples, self.num_elites = (
            num_samples,
            num_policy_samples,
            num_elites,
        )
        self.momentum, self.std, self.min_std, self.low, self.high = momentum, std, min_std, low, high

    @torch.no_grad()
    def plan(
        self,
        z: Tensor,
        next: Next,
        objective: Score,
        *,
        prior: Prior | None = None,
        previous: Tensor | None = None,
        is_init: Tensor | None = None,
        explore: bool = False,
        generator: torch.Generator | None = None,
    ) -> TensorDict:
        """Plan for E environments.

        Args:
            z: current latents (E, D).
            next: (z (..., D), action (..., A)) -> next latents (..., D).
            objective: (trajectory (E, S, H+1, D), actions (E, S, H, A)) -> scores (E, S), higher is better.
            prior: a policy z (..., D) -> actions (..., A), unrolled for `num_policy_samples` candidates.
            previous: the `plan` of the last call (E, H, A); the search starts there, shifted by one step.
            is_init: (E, 1) bool; where True, `previous` belongs to another episode and is dropped.
            explore: add noise of the final standard deviation to the returned action.
            generator: source of the planner's own noise, on the device of z; `prior` draws its own.

        Returns:
            TensorDict of batch size [E]: `action` (E, A), the first of the final mean; `plan`, the final
            mean, and `std`, both (E, H, A); `value` (E, 1), the mean score of the last elites.

        Raises:
            ValueError: `previous` or `is_init` has another shape.
        """
        bounds = {"low": self.low, "high": self.high}
        mean = warm_start(
            z,
            previous,
            is_init,
            horizon=self.horizon,
            action_dim=self.action_dim,
            low=self.low,
            high=self.high,
        )
        mean = mean.clamp(self.low, self.high)
        std = torch.full_like(mean, self.std)
        guided = 0 if prior is None else self.num_policy_samples
        given = []
        if prior is not None and guided:
            given.append(roll_prior(z, next, prior, samples=guided, horizon=self.horizon, **bounds))

        value = mean.new_zeros(z.shape[0], 1)
        for _ in range(self.iterations):
            drawn = gaussian_candidates(
                mean, std, self.num_samples - guided - 1, generator=generator, **bounds
            )
            actions = torch.cat((mean.unsqueeze(1), *given, drawn), dim=1)
            elites = best(objective(rollout(z, actions, next), actions), self.num_elites)
            mean, std = refit(take(actions, elites.which), elites.valid, mean, std, momentum=self.momentum)
            # Rounding can carry a mean of actions at a bound just past it.
            mean, std = mean.clamp(self.low, self.high), std.clamp(min=self.min_std)
            value = elites.mean_score()

        return TensorDict(
            {
                "action": explored(mean[:, 0], std[:, 0], explore, generator=generator, **bounds),
                "plan": mean,
                "std": std,
                "value": value,
            },
            batch_size=[z.shape[0]],
        )
