"""Why training broke, and what to warn of: rewards first, since what they spoil looks like too high a learning rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from franka_wm.errors import UserError
from franka_wm.models import WorldModel
from franka_wm.training.learner import Learner
from franka_wm.training.settings import RunSettings


def finite(
    moments: Mapping[str, tuple[Tensor, Tensor]], settings: RunSettings
) -> Mapping[str, tuple[Tensor, Tensor]]:
    """Mean and deviation of each observation that was gathered, as they are given. It waits.

    Raises:
        UserError: An observation was not finite, in any step.
    """
    odd = [key for key, of in moments.items() if not all(bool(x.isfinite().all()) for x in of)]
    if odd:
        raise UserError(
            f"observation {' and '.join(odd)}: not finite (NaN or inf) in the first steps of {settings.env.label}, "
            "demonstrations included; mend what the task observes, its goal, or the dataset"
        )
    return moments


def odd_rewards(model: WorldModel, steps: TensorDictBase | None) -> str:
    """``3 of 64 rewards`` of steps that are not finite; empty if all are, or the model learns from none. It waits."""
    learned = model.has_reward or model.has_value
    reward = steps.get(("next", "reward"), None) if learned and steps is not None else None
    odd = 0 if reward is None else int((~reward.isfinite()).sum())
    return "" if reward is None or not odd else f"{odd} of {reward.numel()} rewards"


def beyond_bounds(model: WorldModel, steps: TensorDictBase | None, bounds: tuple[float, float] | None) -> str:
    """Rewards of steps beyond ``reward_bounds``, to warn of; empty if there are none, or no bounds. It waits."""
    reward = steps.get(("next", "reward"), None) if steps is not None else None
    if reward is None or bounds is None or not (model.has_reward or model.has_value):
        return ""
    (least, largest), (low, high) = torch.stack(reward.aminmax()).tolist(), bounds
    rounding = 1e-4 * (high - low)
    if not (
        least < low - rounding or largest > high + rounding
    ):  # of what is not finite more is said elsewhere
        return ""
    return (
        f"rewards from {least:.4g} to {largest:.4g} go beyond reward_bounds=({low:g}, {high:g}), for which the model "
        "was built; widen what the task declares"
    )


def clipped(metrics: Mapping[str, float]) -> str:
    """How much a model clips of what it learns from, to warn of; empty if nothing."""
    share = metrics.get("target_outside", 0.0)
    if not share > 0.0:
        return ""
    return (
        f"{100 * share:.2g} % of rewards and targets of values lie outside the model's range and are clipped to it; "
        "widen model.value_low and model.value_high, or leave them at null"
    )


def why(rewards: str, broken: Sequence[str], learner: Learner, settings: RunSettings) -> str:
    """What is not finite, and what to change.

    Args:
        rewards: As :func:`odd_rewards` says them.
        broken: What else is not finite.
    """
    at = f"not finite at update {learner.updates}"
    if rewards:
        return f"{rewards} {at}; mend the reward of {settings.env.label}: whatever learns from it breaks"
    own = "whole_run" in settings.values and settings.trainer.lr is None  # of a first stage
    return (
        f"{', '.join(broken[:3])} {at}; lower {'pretrain.model.lr' if own else 'trainer.lr'} ({learner.lr:g}) or "
        f"trainer.grad_clip ({learner.grad_clip:g})"
    )
