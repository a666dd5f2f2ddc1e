"""Shared parts of the planners: rollouts of candidates, draws, and the best candidates.

E environments, S candidates, H steps, A action components, D the size of a latent.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from franka_wm.seeding import of_worlds


def require_is_init(is_init: Tensor, envs: int) -> None:
    """Raises ValueError unless `is_init` is (E, 1)."""
    if is_init.shape != (envs, 1):
        raise ValueError(f"is_init must have shape (E, 1) = {(envs, 1)}, got {tuple(is_init.shape)}")


def normal(shape: Sequence[int], like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Normal numbers of this shape (E, ...), of the type and device of `like`, as `of_worlds` gives them."""
    kind: dict[str, Any] = {"device": like.device, "dtype": like.dtype}
    return of_worlds(lambda drawn: torch.randn(drawn, generator=generator, **kind), shape)


# ---------------------------------------------------------------------- candidates


def repeated(z: Tensor, samples: int) -> Tensor:
    """Latents (E, ...) -> (E, samples, ...), without a copy."""
    return z.unsqueeze(1).expand(z.shape[0], samples, *z.shape[1:])


def rollout(z: Tensor, actions: Tensor, next: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Latents (E, ...) and candidates (E, S, H, A) -> trajectories (E, S, H+1, ...) that start at `z`."""
    latents = [repeated(z, actions.shape[1])]
    for t in range(actions.shape[2]):
        latents.append(next(latents[-1], actions[:, :, t]))
    latents[0] = latents[0].to(latents[-1].dtype)  # predicted latents may be coarser
    # In memory (H+1, E, S, ...) on a GPU, where most of the time is copying: steps are written and read as a whole.
    return torch.stack(latents).movedim(0, 2) if z.is_cuda else torch.stack(latents, dim=2)


def gaussian_candidates(
    mean: Tensor, std: Tensor, samples: int, *, low: float, high: float, generator: torch.Generator | None
) -> Tensor:
    """Draws of independent Gaussians: mean and std (E, H, A) -> (E, samples, H, A), clamped."""
    noise = normal((mean.shape[0], samples, *mean.shape[1:]), mean, generator)
    return (mean.unsqueeze(1) + std.unsqueeze(1) * noise).clamp(low, high)


def explored(
    action: Tensor,
    std: Tensor | float,
    explore: bool,
    *,
    low: float,
    high: float,
    generator: torch.Generator | None,
) -> Tensor:
    """The action (E, A) within its bounds, with Gaussian noise of `std` if `explore`."""
    if explore:
        action = action + std * normal(action.shape, action, generator)
    return action.clamp(low, high)


# ---------------------------------------------------------------------- the best candidates


class Elites(NamedTuple):
    """The best candidates of each environment, best first."""

    which: Tensor
    """(E, K): which candidates they are."""
    scores: Tensor
    """(E, K), always finite: the worst valid score (0 if none is valid) stands in for one that is not."""
    valid: Tensor
    """(E, K) bool: whether the score was finite."""

    def mean_score(self) -> Tensor:
        """Mean of the valid scores (E, 1); where none is valid, 0."""
        weight = self.valid.to(self.scores.dtype)
        return (weight * self.scores).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp(min=1.0)


def best(scores: Tensor, count: int) -> Elites:
    """The `count` best of scores (E, S); those that are not finite come last, whatever they are."""
    valid = torch.isfinite(scores)
    largest = torch.finfo(scores.dtype).max
    worst = torch.where(valid, scores, largest).amin(1, keepdim=True)
    worst = torch.where(valid.any(1, keepdim=True), worst, torch.zeros_like(worst))
    # Stand in with the worst valid score, which keeps the statistics finite, but rank below it.
    order = torch.where(valid, scores, -largest)
    index = order.topk(count, dim=1).indices
    return Elites(index, torch.where(valid, scores, worst).gather(1, index), valid.gather(1, index))


def take(actions: Tensor, index: Tensor) -> Tensor:
    """Candidates (E, S, H, A) at `index` (E, K) -> (E, K, H, A)."""
    return actions.gather(1, index[..., None, None].expand(-1, -1, *actions.shape[2:]))


def refit(
    elites: Tensor, valid: Tensor, mean: Tensor, std: Tensor, *, momentum: float
) -> tuple[Tensor, Tensor]:
    """Gaussian of the elites, each weighing the same, smoothed with the one before.

    new = `momentum` · old + (1 - `momentum`) · fitted, for mean and standard deviation. Where no elite is
    valid, the old Gaussian stays.

    Args:
        elites: (E, K, H, A).
        valid: (E, K) bool; the others weigh nothing.
        mean, std: the Gaussian they were drawn from, (E, H, A).
    """
    count = valid.sum(1).view(-1, 1, 1)
    weight = (valid.to(elites.dtype) / valid.sum(1, keepdim=True).clamp(min=1))[..., None, None]
    fitted = (weight * elites).sum(1)
    deviation = (weight * (elites - fitted.unsqueeze(1)).square()).sum(1).sqrt()
    keep = momentum + (1.0 - momentum) * (count == 0).to(elites.dtype)
    return keep * mean + (1.0 - keep) * fitted, keep * std + (1.0 - keep) * deviation
