"""Planning by gradient: Adam on the actions, through the model and the objective."""

from typing import Literal, get_args

import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm.planning.objectives import Score
from franka_wm.planning.sampling import (
    Next,
    Prior,
    explored,
    gaussian_candidates,
    require_bounds,
    require_counts,
    require_samples,
    roll_prior,
    rollout,
    warm_start,
)

Bound = Literal["clamp", "tanh"]


class GradientPlanner:
    """Ascends the objective's gradient from several starts per environment and keeps the best plan seen.

    Adam (Kingma & Ba, arXiv:1412.6980) on whole action sequences, by backpropagation through the model's
    `next` and the objective, as in Universal Planning Networks (Srinivas et al., arXiv:1804.00645). The first
    start is the warm start; the others are scattered around it, since the gradient only leads to the nearest
    optimum. Steps are Adam's, so neither the unit of the reward nor that of the latents matters.

    Of all plans of all starts and iterations the best one counts, the starts included, so the result is never
    worse than what it began with (`tanh` first moves starts at a bound in by 1 % of half the range). A
    gradient that is not finite moves nothing; a score that is not finite never wins.

    Works under `torch.no_grad`, and leaves no gradient in the model's parameters. Static shapes, no
    data-dependent control flow, no host synchronisation. Memory: the graph of one rollout of E · S · H steps.

    Args:
        action_dim: A.
        horizon: H, steps looked ahead.
        num_samples: S, starts per environment, those of the policy included.
        num_policy_samples: how many of them are rolled out with `prior`, if `plan` gets one.
        iterations: steps of Adam.
        lr: length of a step, in units of the action (before squashing with `tanh`).
        betas: Adam's decay rates.
        std: how far the starts are scattered, in units of the action.
        explore_std: noise added to the action with `explore`.
        bound: what keeps actions within bounds. `clamp`: each step is projected, and plans reach the bounds.
            `tanh`: actions are a squashed free variable; smooth, but slow near the bounds.
        low, high: bounds of every action component.

    Raises:
        ValueError: a setting that cannot work.
    """

    def __init__(
        self,
        *,
        action_dim: int,
        horizon: int = 5,
        num_samples: int = 16,
        num_policy_samples: int = 0,
        iterations: int = 20,
        lr: float = 0.1,
        betas: tuple[float, float] = (0.9, 0.999),
        std: float = 0.5,
        explore_std: float = 0.1,
        bound: Bound = "clamp",
        low: float = -1.0,
        high: float = 1.0,
    ) -> None:
        require_counts(action_dim=action_dim, horizon=horizon, num_samples=num_samples, iterations=iterations)
        require_samples(num_samples, num_policy_samples)
        if not lr > 0.0:
            raise ValueError(f"lr must be positive, got {lr}")
        first, second = betas
        if not (0.0 <= first < 1.0 and 0.0 <= second < 1.0):
            raise ValueError(f"betas must be in [0, 1), got {first} and {second}")
        if not (std >= 0.0 and explore_std >= 0.0):
            raise ValueError(f"std and explore_std must not be negative, got {std} and {explore_std}")
        if bound not in get_args(Bound):
            raise ValueError(f"bound={bound!r}: must be one of {', '.join(get_args(Bound))}")
        require_bounds(low, high)
        self.action_dim, self.horizon, self.iterations = action_dim, horizon, iterations
        self.num_samples, self.num_policy_samples = num_samples, num_policy_samples
        self.lr, self.betas, self.std, self.explore_std = lr, (first, second), std, explore_std
        self.bound: Bound = bound
        self.low, self.high = low, high

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
            next: (z (..., D), action (..., A)) -> next latents (..., D), differentiable.
            objective: (trajectory (E, S, H+1, D), actions (E, S, H, A)) -> scores (E, S), higher is better,
                differentiable.
            prior: a policy z (..., D) -> actions (..., A), unrolled for `num_policy_samples` starts.
            previous: the `plan` of the last call (E, H, A); the first start is this, shifted by one step.
            is_init: (E, 1) bool; where True, `previous` belongs to another episode and is dropped.
            explore: add noise of `explore_std` to the returned action.
            generator: source of the planner's own noise, on the device of z; `prior` draws its own.

        Returns:
            TensorDict of batch size [E]: `action` (E, A), the first of the best plan; `plan` (E, H, A), the
            best plan; `value` (E, 1), its score.

        Raises:
            ValueError: `previous` or `is_init` has another shape, or the scores have no gradient.
        """
        z = z.detach()
        starts = self._starts(z, next, prior, previous, is_init, generator)
        free = starts if self.bound == "clamp" else self._unsquash(starts)
        first_moment, second_moment = torch.zeros_like(free), torch.zeros_like(free)
        first, second = self.betas

        actions, score = starts, None
        best_actions = best_score = None
        for step in range(1, self.iterations + 1):
            actions, score, gradient = self._ascent(z, next, objective, free)
            best_actions, best_score = self._keep(best_actions, best_score, actions, score)
            first_moment = first * first_moment + (1.0 - first) * gradient
            second_moment = second * second_moment + (1.0 - second) * gradient.square()
            mean, variance = first_moment / (1.0 - first**step), second_moment / (1.0 - second**step)
            free = free + self.lr * mean / (variance.sqrt() + 1e-8)
            if self.bound == "clamp":
                free = free.clamp(self.low, self.high)

        actions = self._bounded(free)
        score = objective(rollout(z, actions, next), actions)
        best_actions, best_score = self._keep(best_actions, best_score, actions, score)

        winner = best_score.argmax(1, keepdim=True)  # (E, 1)
        plan = best_actions.gather(
            1, winner[..., None, None].expand(-1, -1, self.horizon, self.action_dim)
        ).squeeze(1)
        value = best_score.gather(1, winner)
        value = torch.where(torch.isfinite(value), value, torch.zeros_like(value))
        return TensorDict(
            {
                "action": explored(
                    plan[:, 0],
                    self.explore_std,
                    explore,
                    low=self.low,
                    high=self.high,
                    generator=generator,
                ),
                "plan": plan,
                "value": value,
            },
            batch_size=[z.shape[0]],
        )

    def _starts(
        self,
        z: Tensor,
        next: Next,
        prior: Prior | None,
        previous: Tensor | None,
        is_init: Tensor | None,
        generator: torch.Generator | None,
    ) -> Tensor:
        """Where the search starts (E, S, H, A): the warm start, the policy's, and some around the former."""
        bounds = {"low": self.low, "high": self.high}
        warm = warm_start(
            z,
            previous,
            is_init,
            horizon=self.horizon,
            action_dim=self.action_dim,
            low=self.low,
            high=self.high,
        )
        parts = [warm.clamp(self.low, self.high).unsqueeze(1)]
        guided = 0 if prior is None else self.num_policy_samples
        if prior is not None and guided:
            parts.append(roll_prior(z, next, prior, samples=guided, horizon=self.horizon, **bounds))
        scattered = gaussian_candidates(
            warm,
            torch.full_like(warm, self.std),
            self.num_samples - guided - 1,
            generator=generator,
            **bounds,
        )
        return torch.cat((*parts, scattered), dim=1)

    def _ascent(self, z: Tensor, next: Next, objective: Score, free: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The free variable's actions, their scores (E, S), and the scores' gradient, where finite."""
        with torch.enable_grad():
            free = free.detach().requires_grad_()
            actions = self._bounded(free)
            score = objective(rollout(z, actions, next), actions)
            # Candidates do not interact, so the gradient of the sum holds each one's own. Unlike backward(),
            # grad() writes to no parameter.
            gradient = (
                torch.autograd.grad(score.sum(), free, allow_unused=True)[0] if score.requires_grad else None
            )
        if gradient is None:
            raise ValueError(
                "the scores do not depend on the actions in a way that can be differentiated: "
                "use a sampling planner (cem, icem, mppi), or remove no_grad from the model or objective"
            )
        gradient = torch.where(torch.isfinite(gradient), gradient, torch.zeros_like(gradient))
        return actions.detach(), score.detach(), gradient

    @staticmethod
    def _keep(
        best_actions: Tensor | None, best_score: Tensor | None, actions: Tensor, score: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The better of two plans for each start; a score that is not finite is below all others."""
        score = torch.where(torch.isfinite(score), score, torch.full_like(score, -torch.inf))
        if best_actions is None or best_score is None:
            return actions, score
        better = score > best_score
        return torch.where(better[..., None, None], actions, best_actions), torch.maximum(score, best_score)

    def _bounded(self, free: Tensor) -> Tensor:
        if self.bound == "clamp":
            return free  # projected after every step
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        return (middle + half * free.tanh()).clamp(self.low, self.high)

    def _unsquash(self, actions: Tensor) -> Tensor:
        """Inverse of `_bounded`; a start at a bound is moved in to where tanh still has a slope."""
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        return ((actions - middle) / half).clamp(-0.99, 0.99).atanh()
