"""Discounts of returns, how large returns can be, and the scale by which a policy loss is divided."""

import math

import torch
from torch import Tensor, nn

from franka_wm import processes

PUBLISHED_RANGE = 10.0
"""Range of two-hot codes to both sides of zero in symlog space: rewards and values from -22,025 to 22,025."""


def value_range(
    low: float | None,
    high: float | None,
    reward_bounds: tuple[float, float] | None,
    discount: float,
) -> tuple[float, float]:
    """Range of a two-hot code of rewards and values, in symlog space.

    A number given for an end is that end. Where rewards are bounded, discounted returns are bounded by
    max |reward| / (1 - discount), and so are single rewards and bootstrapped targets. The code reaches 5 % further,
    because only certain predictions reach its outermost points. It is symmetric, so that a head which starts at zero
    first predicts zero. Where rewards are not bounded, the range is the published one, ±10.

    Args:
        low, high: the ends, None: derived.
        reward_bounds: the least and the largest reward of a step; None: unknown.
        discount: per step, in [0, 1]; at 1 returns have no bound.

    Raises:
        ValueError: bounds that are not finite or in the wrong order.
    """
    limit = PUBLISHED_RANGE
    if reward_bounds is not None:
        least, largest = reward_bounds
        if not (math.isfinite(least) and math.isfinite(largest) and least <= largest):
            raise ValueError(f"reward_bounds must be two finite numbers in order, got {reward_bounds}")
        size = max(abs(least), abs(largest))
        if size > 0.0 and discount < 1.0:
            limit = 1.05 * math.log1p(size / (1.0 - discount))
    return -limit if low is None else low, limit if high is None else high


def discount_per_step(
    discount: float | None, episode_length: int | None, *, default: float | None = None
) -> float:
    """`discount` where it is given, else that of the episodes' length, else `default`.

    Raises:
        ValueError: none of the three is known.
    """
    if discount is not None:
        return float(discount)
    if episode_length is not None:
        return episode_discount(episode_length)
    if default is None:
        raise ValueError("give episode_length, from which the discount follows, or discount itself")
    return default


def episode_discount(episode_length: int) -> float:
    """Discount per step for episodes of T steps: clamp((T/5 - 1) / (T/5), 0.95, 0.995) (TD-MPC2).

    Raises:
        ValueError: T below 1.
    """
    if episode_length < 1:
        raise ValueError(f"episode_length must be at least 1, got {episode_length}")
    fifth = episode_length / 5.0
    return min(max((fifth - 1.0) / fifth, 0.95), 0.995)


def n_step_returns(
    reward: Tensor,
    terminated: Tensor,
    bootstrap: Tensor,
    *,
    discount: float,
    steps: int,
    ends: Tensor | None = None,
) -> Tensor:
    """n-step returns of the H steps of windows, each within its window and episode.

    Step t sums n = `steps` discounted rewards and adds the discounted `bootstrap` of the step that follows. Near
    the end of an episode that terminated, what is left of the rewards is all. Near any other end, also the window's,
    it bootstraps from the last step, however near that is.

    Args:
        reward, bootstrap: (B, H, 1).
        terminated: (B, H, 1) bool; the last transition of the episode decides.
        ends: (B, 1) int64 in 1 … H, number of transitions that belong to the episode; None: all H.

    Returns:
        (B, H, 1); without meaning past the end.
    """
    length, device = reward.shape[1], reward.device
    if ends is None:
        ends = torch.full((reward.shape[0], 1), length, device=device)
    over = terminated[..., 0].gather(1, ends - 1)
    step = torch.arange(length, device=device)
    stop = torch.minimum(step + steps, ends - 1 + over.long())  # (B, H): the first step not summed
    ahead = step - step.unsqueeze(-1)  # (H, H): steps from t, in rows, to k
    base = torch.full((), discount, device=device, dtype=reward.dtype)
    power = base ** ahead.clamp_min(0).to(reward.dtype)
    summed = power * ((ahead >= 0) & (step < stop.unsqueeze(-1)))  # (B, H, H)
    # After a termination there is no bootstrap: `stop` is then past the last step.
    last = power * ((step == stop.unsqueeze(-1)) & (step < ends).unsqueeze(1))
    # Not a matrix product: autocast would round the targets.
    rewards, values = reward.transpose(1, 2), bootstrap.transpose(1, 2)  # (B, 1, H)
    return (summed * rewards + last * values).sum(-1, keepdim=True)


def lambda_returns(
    reward: Tensor, going_on: Tensor, value: Tensor, *, discount: float, decay: float
) -> Tensor:
    """λ-returns R_t = r_t + γ c_t ((1 - λ) v_t + λ R_{t+1}), with R = v after the last step (TD(λ)).

    Args:
        reward: (T, ..., 1), time leads.
        going_on: (T, ..., 1), c: bool, or the probability that the episode goes on after the step.
        value: (T, ..., 1), v: of the state that follows each step.
        discount: γ per step.
        decay: λ.

    Returns:
        (T, ..., 1).
    """
    following, returns = value[-1], []
    for t in range(reward.shape[0] - 1, -1, -1):
        ahead = (1.0 - decay) * value[t] + decay * following
        following = reward[t] + discount * going_on[t] * ahead
        returns.append(following)
    return torch.stack(returns[::-1])


class RunningScale(nn.Module):
    """Running 5-95 percentile range of values, at least 1, by which a policy loss is divided.

    It lets one entropy coefficient serve rewards of any size (TD-MPC2, section 3.2). `update` works on the
    device, with static shapes.
    """

    value: Tensor

    def __init__(self, tau: float = 0.01) -> None:
        super().__init__()
        self.tau = tau
        self.register_buffer("value", torch.ones(()))

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Move the scale by `tau` towards the 5-95 percentile range of `x` (any shape)."""
        ordered = processes.gather(x.detach().flatten()).sort().values
        span = _percentile(ordered, 0.95) - _percentile(ordered, 0.05)
        self.value.lerp_(span.clamp_min(1.0).to(self.value.dtype), self.tau)

    def forward(self, x: Tensor) -> Tensor:
        # A copy, so that a later update in place cannot invalidate the graph of this division.
        return x / self.value.clone()


def _percentile(ordered: Tensor, fraction: float) -> Tensor:
    """Linear-interpolated percentile of a sorted vector (n,); its indices depend on the shape alone."""
    position = fraction * (ordered.shape[0] - 1)
    low = math.floor(position)
    return torch.lerp(ordered[low], ordered[min(low + 1, ordered.shape[0] - 1)], position - low)
