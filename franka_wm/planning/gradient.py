"""Planning by gradient: Adam on the actions, through the model and the objective."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm.errors import UserError
from franka_wm.options import Bounds
from franka_wm.planning.base import ContinuousPlanner, Query
from franka_wm.planning.sampling import gaussian_candidates, take


@dataclass(kw_only=True, eq=False)
class GradientPlanner(ContinuousPlanner):
    """Ascends the objective's gradient from several starts per environment and keeps the best plan seen.

    Adam (Kingma & Ba, arXiv:1412.6980) on whole action sequences, by backpropagation through the model's
    `next` and the objective, as in Universal Planning Networks (Srinivas et al., arXiv:1804.00645). The first
    start is the warm start; the others are scattered around it, since the gradient only leads to the nearest
    optimum. Steps are Adam's, so neither the unit of the reward nor that of the latents matters (while gradients are
    well above its 1e-8, and their squares below the largest float32).

    Of all plans of all starts and iterations the best one counts, the starts included, so the result is never
    worse than what it began with (`tanh` first moves starts at a bound in by 1 % of half the range). A
    gradient that is not finite moves nothing; a score that is not finite never wins.

    Works under `torch.no_grad`, and leaves no gradient in the model's parameters. Memory: the graph of one
    rollout of E · S · H steps.

    Args besides those of `ContinuousPlanner`:
        num_samples: S, starts per environment, those of the policy included.
        iterations: steps of Adam.
        lr: length of a step, in units of the action (before squashing with `tanh`).
        betas: Adam's decay rates.
        std: how far the starts are scattered, in units of the action.
        explore_std: noise added to the action with `explore`.
        bound: what keeps actions within bounds. `clamp`: each step is projected, and plans reach the bounds.
            `tanh`: actions are a squashed free variable; smooth, but slow near the bounds.
    """

    horizon: int = 5
    num_samples: int = 16
    iterations: int = 20
    lr: float = 0.1
    betas: tuple[float, float] = (0.9, 0.999)
    std: float = 0.5
    explore_std: float = 0.1
    bound: Literal["clamp", "tanh"] = "clamp"

    ranges: ClassVar[Mapping[str, Bounds]] = {
        **ContinuousPlanner.ranges,
        "lr": Bounds(above=0),
        **dict.fromkeys(("std", "explore_std"), Bounds(least=0)),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        first, second = self.betas
        if not (0.0 <= first < 1.0 and 0.0 <= second < 1.0):
            raise UserError(f"planner.betas={self.betas}: both must be at least 0 and below 1")
        self.betas = first, second  # may have come as a list

    def search(self, query: Query) -> TensorDict:
        """See `Planner.plan`; with `explore`, the noise has the deviation `explore_std`.

        Args:
            query: `next` and `objective` are differentiable.

        Returns:
            TensorDict of batch size [E]: `action` (E, A), the first of the best plan; `plan` (E, H, A), the
            best plan; `value` (E, 1), its score.

        Raises:
            ValueError: `previous` or `is_init` has another shape, or the scores have no gradient.
        """
        query = query._replace(z=query.z.detach())
        starts = self._starts(query)
        free = starts if self.bound == "clamp" else self._unsquash(starts)
        first_moment, second_moment = torch.zeros_like(free), torch.zeros_like(free)
        first, second = self.betas

        actions, score = starts, None
        best_actions = best_score = None
        for step in range(1, self.iterations + 1):
            actions, score, gradient = self._ascent(query, free)
            best_actions, best_score = self._keep(best_actions, best_score, actions, score)
            first_moment = first * first_moment + (1.0 - first) * gradient
            second_moment = second * second_moment + (1.0 - second) * gradient.square()
            mean, variance = first_moment / (1.0 - first**step), second_moment / (1.0 - second**step)
            free = free + self.lr * mean / (variance.sqrt() + 1e-8)
            if self.bound == "clamp":
                free = free.clamp(self.low, self.high)

        actions = self._bounded(free)
        score = query.score(actions)
        best_actions, best_score = self._keep(best_actions, best_score, actions, score)

        winner = best_score.argmax(1, keepdim=True)  # (E, 1)
        plan = take(best_actions, winner).squeeze(1)
        value = best_score.gather(1, winner)
        value = torch.where(torch.isfinite(value), value, torch.zeros_like(value))
        return self.result(query, plan[:, 0], self.explore_std, plan=plan, value=value)

    def _starts(self, query: Query) -> Tensor:
        """Where the search starts (E, S, H, A): the warm start, the policy's, and some around the former."""
        warm = self.start(query)
        guided = self.guided(query)
        scattered = gaussian_candidates(
            warm,
            torch.full_like(warm, self.std),
            self.num_samples - 1 - sum(one.shape[1] for one in guided),
            generator=query.generator,
            **self.bounds,
        )
        return torch.cat((warm.clamp(self.low, self.high).unsqueeze(1), *guided, scattered), dim=1)

    def _ascent(self, query: Query, free: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The free variable's actions, their scores (E, S), and the scores' gradient, where finite."""
        with torch.enable_grad():
            free = free.detach().requires_grad_()
            actions = self._bounded(free)
            score = query.score(actions)
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
