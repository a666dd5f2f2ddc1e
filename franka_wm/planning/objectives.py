"""Objectives: what a planner maximises.

A planner is given a `Score`: (trajectory (E, S, H+1, D), actions (E, S, H, A)) -> scores (E, S), higher is better, for
E environments, S candidates and H steps. The trajectory starts at the current latent.

An `Objective` makes the score of each decision. One that depends on the present observation (a goal image, the last
action) overrides `bind`. A plain function with the signature of a score is an objective that never changes.
Objectives are classes rather than closures, so that a policy that holds one can be copied and sent to another process.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal, Protocol, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F

Score = Callable[[Tensor, Tensor], Tensor]
"""(trajectory (E, S, H+1, D), actions (E, S, H, A)) -> scores (E, S)."""

Metric = Literal["l2", "l1", "cosine"]
"""`l2`: squared Euclidean, Σ (x - g)². `l1`: Σ |x - g|. `cosine`: 1 - cos(x, g), between 0 and 2."""


class Objective:
    """Base class of objectives: a score that stays as it is, unless a method says otherwise."""

    in_keys: Sequence[str] = ()
    """Entries of the observation that `bind` cannot do without."""
    coarse = False  # Whether latents may come in bfloat16: nothing but the model reads them.

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        """Scores (E, S) of trajectories (E, S, H+1, D) and actions (E, S, H, A)."""
        raise NotImplementedError

    def bind(self, tensordict: TensorDictBase) -> Score:
        """Score of the present decision.

        Args:
            tensordict: what the policy was given, of batch size [E].
        """
        return self

    def compiled(self) -> Objective:
        """The same objective, with what it calls compiled by `torch.compile`; unchanged by default."""
        return self


class FunctionObjective(Objective):
    """A plain function as an objective."""

    def __init__(self, function: Score) -> None:
        self.function = function

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        return self.function(trajectory, actions)


def as_objective(objective: Objective | Score) -> Objective:
    """`objective` itself, or a plain function wrapped."""
    return objective if isinstance(objective, Objective) else FunctionObjective(objective)


class ReturnModel(Protocol):
    """What `RewardPlusValue.of` asks of a world model."""

    has_reward: bool
    has_arrival_reward: bool
    has_value: bool
    terminates: bool
    discount: float

    def reward(self, z: Tensor, action: Tensor) -> Tensor: ...
    def arrival_reward(self, z: Tensor) -> Tensor: ...
    def value(self, z: Tensor) -> Tensor: ...
    def terminated(self, z: Tensor) -> Tensor: ...


class RewardPlusValue(Objective):
    """Discounted rewards of the H steps plus the discounted value of the last latent.

    score = Σ_{t<H} γ^t · reward(z_t, a_t) + γ^H · value(z_H). The value is that of the latent after the last
    action, so every action counts (TD-MPC2, arXiv:2310.16828, equation 5). Where the episode is predicted to have
    terminated, nothing that follows counts: neither rewards nor the value.

    Args:
        reward: (z (..., D), action (..., A)) -> (..., 1).
        value: z (..., D) -> (..., 1).
        discount: γ per step.
        terminated: z (..., D) -> (..., 1) bool, whether an episode ends there; None: no episode terminates.
        arrival_reward: z (..., D) -> (..., 1), the reward of the action that led to z; asked in place of `reward`.

    Raises:
        ValueError: `discount` outside [0, 1].
    """

    def __init__(
        self,
        reward: Callable[[Tensor, Tensor], Tensor],
        value: Callable[[Tensor], Tensor],
        discount: float,
        terminated: Callable[[Tensor], Tensor] | None = None,
        arrival_reward: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        if not 0.0 <= discount <= 1.0:
            raise ValueError(f"discount must be in [0, 1], got {discount}")
        self.reward, self.value, self.discount, self.terminated = reward, value, discount, terminated
        self.arrival_reward = arrival_reward

    @classmethod
    def of(cls, model: ReturnModel) -> RewardPlusValue:
        """Rewards plus value of a model; with its `terminated`, if it `terminates`.

        Raises:
            ValueError: the model lacks reward, value or discount.
        """
        there = {"reward": model.has_reward, "value": model.has_value, "discount": model.discount >= 0.0}
        if lacking := [name for name, has in there.items() if not has]:
            raise ValueError(f"{type(model).__name__} has no {', '.join(lacking)}")
        ends = model.terminated if model.terminates else None
        arrival = model.arrival_reward if model.has_arrival_reward else None
        made = cls(model.reward, model.value, model.discount, ends, arrival)
        made.coarse = cls is RewardPlusValue
        return made

    def compiled(self) -> RewardPlusValue:
        """The same, with what it calls compiled by `torch.compile`."""
        made = copy.copy(self)
        called = {name: getattr(self, name) for name in ("reward", "value", "terminated", "arrival_reward")}
        made.__dict__ |= {name: one and torch.compile(one, dynamic=False) for name, one in called.items()}
        return made

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        horizon = actions.shape[2]
        if self.arrival_reward is None:
            rewards = self.reward(trajectory[:, :, :horizon], actions).squeeze(-1)  # (E, S, H), one call
        else:
            rewards = self.arrival_reward(trajectory[:, :, 1:]).squeeze(-1)
        value = self.value(trajectory[:, :, horizon]).squeeze(-1)
        if self.terminated is not None:
            ended = self.terminated(trajectory[:, :, 1:]).squeeze(-1).cumsum(-1) > 0  # (E, S, H): by then
            rewards = torch.cat((rewards[..., :1], rewards[..., 1:].masked_fill(ended[..., :-1], 0.0)), -1)
            value = value.masked_fill(ended[..., -1], 0.0)
        score = self.discount**horizon * value
        for t in range(horizon):
            score = score + self.discount**t * rewards[:, :, t]
        return score


class GoalDistance(Objective):
    """Minus the distance to a goal, summed over the rollout or at its end only.

    The current latent, which no action can change, is left out. Summing rewards arriving early and staying.

    Args:
        goal_latent: (D,) for all environments, or (E, D), one each; in the space that `embed` maps to.
        summed: over the H predicted latents; else the last one alone.
        metric: see `Metric`.
        embed: latents (..., Z) -> (..., D), what the distance is measured on; None: the latents themselves.
        steps: a learned distance in steps, (embedded (..., D), goal (..., D)) -> (...); None: none.
        steps_weight: what it weighs beside the metric.

    Raises:
        ValueError: `goal_latent` has another number of dimensions, or there is no such metric.
    """

    def __init__(
        self,
        goal_latent: Tensor,
        summed: bool = True,
        *,
        metric: Metric = "l2",
        embed: Callable[[Tensor], Tensor] | None = None,
        steps: Callable[[Tensor, Tensor], Tensor] | None = None,
        steps_weight: float = 0.0,
    ) -> None:
        if goal_latent.dim() not in (1, 2):
            raise ValueError(f"goal_latent must be (D,) or (E, D), got {tuple(goal_latent.shape)}")
        _require_metric(metric)
        self.goal_latent, self.summed, self.metric, self.embed = goal_latent, summed, metric, embed
        self.steps, self.steps_weight = steps, steps_weight

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        goal = self.goal_latent if self.goal_latent.dim() == 1 else self.goal_latent[:, None, None]
        reached = trajectory[:, :, 1:] if self.summed else trajectory[:, :, -1:]
        if self.embed is not None:
            reached = self.embed(reached)
        if reached.shape[-1] != goal.shape[-1]:
            raise ValueError(
                f"the goal has {goal.shape[-1]} features and the latents it is compared with "
                f"{reached.shape[-1]}: give `embed`, which maps latents to the goal's space"
            )
        if self.metric == "l2":
            score = -(reached - goal).square().sum(dim=(-2, -1))
        elif self.metric == "l1":
            score = -(reached - goal).abs().sum(dim=(-2, -1))
        else:
            score = (F.cosine_similarity(reached, goal, dim=-1) - 1.0).sum(-1)
        if self.steps is None:
            return score
        return score - self.steps_weight * self.steps(reached, goal.expand_as(reached)).sum(-1)


class GoalImage(Objective):
    """Minus the distance to the embedding of the goal's image, or of its images from several cameras.

    They are encoded once per decision, by `bind`; planning then is `GoalDistance`.

    Args:
        encode_goal: observation of a goal, a TensorDict of batch size [E] with the goal's images -> (E, D). It
            holds nothing else: other entries of the present observation (joint angles) are not those of the goal.
        embed: latents (..., Z) -> (..., D), the space of `encode_goal`; None: the latents themselves.
        goals: key that the model's encoder reads -> key of the goal's image in the observation,
            (E, H, W, C) uint8. None: `pixels` -> `goal_pixels`.
        metric, summed, steps, steps_weight: see `GoalDistance`.

    Raises:
        ValueError: there is no such metric, or no image.
    """

    def __init__(
        self,
        encode_goal: Callable[[TensorDictBase], Tensor],
        embed: Callable[[Tensor], Tensor] | None = None,
        goals: Mapping[str, str] | None = None,
        metric: Metric = "l2",
        summed: bool = True,
        steps: Callable[[Tensor, Tensor], Tensor] | None = None,
        steps_weight: float = 0.0,
    ) -> None:
        _require_metric(metric)
        self.goals = {"pixels": "goal_pixels"} if goals is None else dict(goals)
        if not self.goals:
            raise ValueError("goals is empty: name at least one image")
        self.encode_goal, self.embed = encode_goal, embed
        self.metric: Metric = metric
        self.summed, self.steps, self.steps_weight = summed, steps, steps_weight
        self.in_keys = list(self.goals.values())

    def bind(self, tensordict: TensorDictBase) -> GoalDistance:
        """The objective of the present decision.

        Raises:
            ValueError: the observation has no image of the goal.
        """
        options = {"embed": self.embed, "steps": self.steps, "steps_weight": self.steps_weight}
        return GoalDistance(self.goal(tensordict), self.summed, metric=self.metric, **options)  # pyright: ignore[reportArgumentType]

    def goal(self, tensordict: TensorDictBase) -> Tensor:
        """Embedding (E, D) of the goal of the present decision.

        Raises:
            ValueError: the observation has no image of the goal.
        """
        images = {key: tensordict.get(goal, None) for key, goal in self.goals.items()}
        for key, image in images.items():
            if image is None:
                raise ValueError(
                    f"the observation has no {self.goals[key]!r}, the image of the goal to plan towards: "
                    "add goal_pixels to env.observations"
                )
        return self.encode_goal(TensorDict(images, batch_size=tensordict.batch_size))

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        raise ValueError("a GoalImage has no goal yet: plan with its bind(tensordict)")


def goal_images(keys: Iterable[str]) -> dict[str, str]:
    """Key of an image that a model reads -> that of the same camera's image of the goal."""
    return {key: f"goal_{key}" for key in keys}


class Sum(Objective):
    """Weighted sum of objectives: Σ weight · score. `bind` binds every term.

    Args:
        terms: pairs (weight, objective).

    Raises:
        ValueError: no terms, or a weight that is not finite.
    """

    def __init__(self, terms: Sequence[tuple[float, Objective | Score]]) -> None:
        if not terms:
            raise ValueError("a Sum needs at least one (weight, objective)")
        for weight, objective in terms:
            if not math.isfinite(weight):
                raise ValueError(f"the weight of {type(objective).__name__} must be finite, got {weight}")
        self.terms = [(float(weight), as_objective(objective)) for weight, objective in terms]
        self.in_keys = list(dict.fromkeys(key for _, objective in self.terms for key in objective.in_keys))
        self.coarse = all(objective.coarse for _, objective in self.terms)

    def compiled(self) -> Sum:
        """The same sum of compiled terms."""
        return Sum([(weight, objective.compiled()) for weight, objective in self.terms])

    def bind(self, tensordict: TensorDictBase) -> Sum:
        """The same sum of bound terms."""
        return Sum([(weight, objective.bind(tensordict)) for weight, objective in self.terms])

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        (weight, objective), *rest = self.terms
        score = weight * objective(trajectory, actions)
        for weight, objective in rest:
            score = score + weight * objective(trajectory, actions)
        return score


Masked = Callable[[Tensor, Tensor], Tensor]
"""z (..., D), actions (..., A) -> actions with 0 in the entries that the task of z has not."""


class _OfActions(Objective):
    """What costs by the actions alone, where tasks share a model: by the entries that the task of a plan has."""

    coarse = True

    def __init__(self, weight: float, masked: Masked | None = None) -> None:
        self.weight, self.masked = _penalty(type(self).__name__, weight), masked

    def _own(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        """Actions (E, S, H, A), or differences of some, in the entries that count."""
        return actions if self.masked is None else self.masked(trajectory[:, :, :1], actions)


class ActionPenalty(_OfActions):
    """Minus `weight` times the squared size of the actions, Σ_t |a_t|².

    Args:
        weight: of the sum.
        masked: see `Masked`; None: all entries count.

    Raises:
        ValueError: a negative weight.
    """

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        return -self.weight * self._own(trajectory, actions).square().sum(dim=(-2, -1))


class PolicyPenalty(_OfActions):
    """Minus `weight` times the squared distance of the first action from the policy's own, |a_0 - π(z_0)|².

    Planning maximises errors of the model along with returns. Near the policy's actions the model was trained, so
    there it errs less. This keeps the action that is done there, unless the model promises more than the penalty:
    the other side of TD-M(PC)² (arXiv:2502.03550), which keeps the policy near the plans.

    Args:
        policy: z (..., D) -> actions (..., A), without noise.
        weight: of the distance.
        masked: see `Masked`; None: all entries count.

    Raises:
        ValueError: a negative weight.
    """

    def __init__(
        self, policy: Callable[[Tensor], Tensor], weight: float, masked: Masked | None = None
    ) -> None:
        super().__init__(weight, masked)
        self.policy = policy

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        own = self.policy(trajectory[:, :1, 0])  # all candidates start at the same latent
        away = self._own(trajectory, (actions[:, :, 0] - own).unsqueeze(2)).squeeze(2)
        return -self.weight * away.square().sum(-1)


class GoalPolicyPenalty(Objective):
    """The same of a policy towards goals; planning with its `bind(tensordict)` is a `PolicyPenalty`.

    Args:
        policy: z (..., Z), goals (..., D) -> actions (..., A), without noise.
        reader: reads the goal of a decision.

    Raises:
        ValueError: a negative weight.
    """

    def __init__(self, policy: Callable[[Tensor, Tensor], Tensor], reader: GoalImage, weight: float) -> None:
        self.policy, self.reader, self.weight = policy, reader, _penalty(type(self).__name__, weight)
        self.in_keys = reader.in_keys

    def bind(self, tensordict: TensorDictBase) -> PolicyPenalty:
        """The penalty of the present decision."""
        goal = self.reader.goal(tensordict).unsqueeze(1)
        return PolicyPenalty(lambda z: self.policy(z, goal), self.weight)

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        raise ValueError("a GoalPolicyPenalty has no goal yet: plan with its bind(tensordict)")


class Smoothness(_OfActions):
    """Minus `weight` times the squared changes of the action, Σ_{t>0} |a_t - a_{t-1}|².

    Bound to an observation, it also counts the change from the last executed action to the first planned
    one: otherwise replanning at every step leaves what is executed as rough as before.

    Args:
        weight: of the sum.
        masked: see `Masked`; None: all entries count.

    Raises:
        ValueError: a negative weight.
    """

    def __init__(self, weight: float, masked: Masked | None = None) -> None:
        super().__init__(weight, masked)
        self._last: Tensor | None = None  # (E, A)
        self._acted: Tensor | None = None  # (E, 1)

    def bind(self, tensordict: TensorDictBase) -> Smoothness:
        """The objective of the present decision.

        Args:
            tensordict: may hold `action` (E, A), the last executed action (TorchRL's environments carry it
                to the next step; after a reset there is none), and `is_init` (E, 1) bool: where True, the
                action belongs to another episode and does not count.
        """
        bound = Smoothness(self.weight, self.masked)
        if (last := tensordict.get("action", None)) is not None:
            is_init = tensordict.get("is_init", None)
            acted = torch.ones_like(last[..., :1]) if is_init is None else (~is_init).to(last.dtype)
            # What lies in a fresh buffer may not be finite, and 0 · nan is nan.
            bound._last = torch.where(acted > 0, last, torch.zeros_like(last))
            bound._acted = acted
        return bound

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        change = self._own(trajectory, actions.diff(dim=2)).square().sum(dim=(-2, -1))
        if self._last is not None and self._acted is not None:
            first = self._own(trajectory, actions[:, :, :1] - self._last[:, None, None]).squeeze(2)
            change = change + self._acted * first.square().sum(-1)
        return -self.weight * change


def _require_metric(metric: str) -> None:
    if metric not in get_args(Metric):
        raise ValueError(f"metric={metric!r}: must be one of {', '.join(get_args(Metric))}")


def _penalty(name: str, weight: float) -> float:
    if not (math.isfinite(weight) and weight >= 0.0):
        raise ValueError(f"the weight of {name} must be finite and not negative, got {weight}")
    return float(weight)
