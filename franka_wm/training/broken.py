"""Why training broke, in words: rewards first, since what they spoil looks as if the learning rate were too high."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
            f"observation {' and '.join(odd)}: not finite (NaN or inf) in the first steps of {settings.env.label}; "
            "mend what it observes, or the goal"
        )
    return moments


def odd_rewards(model: WorldModel, steps: TensorDictBase | None) -> str:
    """``3 of 64 rewards`` of steps that are not finite; empty if all are, or the model learns from none. It waits."""
    learned = model.has_reward or model.has_value
    reward = steps.get(("next", "reward"), None) if learned and steps is not None else None
    odd = 0 if reward is None else int((~reward.isfinite()).sum())
    return "" if reward is None or not odd else f"{odd} of {reward.numel()} rewards"


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
