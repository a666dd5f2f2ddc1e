"""How far returns are discounted, and how large they can be."""

import math

PUBLISHED_RANGE = 10.0
"""Of two-hot codes, to both sides of zero in symlog space: rewards and values from -22,025 to 22,025."""


def value_range(
    low: float | None,
    high: float | None,
    reward_bounds: tuple[float, float] | None,
    discount: float,
) -> tuple[float, float]:
    """The range of a two-hot code of rewards and values, in symlog space.

    A number given for an end is that end. Where rewards are bounded, discounted returns are by max |reward| / (1 -
    discount), and so are single rewards and bootstrapped targets: the code reaches 5 % further, since its outermost
    points are reached by certain predictions alone. It reaches as far to the other side, so that a head
    which starts at zero first predicts zero. Otherwise the range is the published one, ±10.

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


def episode_discount(episode_length: int) -> float:
    """The discount per step for episodes of T steps: clamp((T/5 - 1) / (T/5), 0.95, 0.995) (TD-MPC2).

    Raises:
        ValueError: T below 1.
    """
    if episode_length < 1:
        raise ValueError(f"episode_length must be at least 1, got {episode_length}")
    fifth = episode_length / 5.0
    return min(max((fifth - 1.0) / fifth, 0.95), 0.995)
