"""What planners have in common: how they are asked, and the settings of those over continuous actions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm.errors import UserError
from franka_wm.options import POSITIVE, Bounds, check_arguments
from franka_wm.planning.objectives import Score
from franka_wm.planning.sampling import explored, repeated, require_is_init, rollout

Next = Callable[[Tensor, Tensor], Tensor]
"""(z (..., D), action (..., A)) -> next latents (..., D)."""

Prior = Callable[[Tensor], Tensor]
"""A policy: z (..., D) -> actions (..., A)."""


class Planner(Protocol):
    """Interface of a planner. E environments, S candidates, H steps, A action components, D the size of a latent."""

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
            explore: add noise to the returned action.
            generator: source of the planner's own noise, on the device of z; `prior` draws its own.

        Returns:
            TensorDict of batch size [E]: `action` (E, A), `plan` (E, H, A), and what the planner adds.

        Raises:
            ValueError: `previous` or `is_init` has another shape.
        """
        ...


class Query(NamedTuple):
    """What one decision is asked with: the arguments of `Planner.plan`."""

    z: Tensor
    next: Next
    objective: Score
    prior: Prior | None
    previous: Tensor | None
    is_init: Tensor | None
    explore: bool
    generator: torch.Generator | None

    def score(self, actions: Tensor) -> Tensor:
        """Scores (E, S) of candidates (E, S, H, A), rolled out with the model.

        Raises:
            ValueError: the objective returns something else.
        """
        scores = self.objective(rollout(self.z, actions, self.next), actions)
        if scores.shape != actions.shape[:2] or not scores.is_floating_point():
            found = f"{tuple(scores.shape)} of {scores.dtype}"
            raise ValueError(
                f"an objective returns scores (E, S) = {tuple(actions.shape[:2])}, floats; got {found}"
            )
        return scores


@dataclass(kw_only=True, eq=False)
class ContinuousPlanner:
    """A planner over continuous actions: its settings, each a field of `conf/planner`, and what all of them do.

    Plain tensor code: static shapes, no data-dependent control flow, no host synchronisation. It holds no
    state; `previous` carries the plan from one call to the next. Rollouts hold E · S · (H + 1) · D numbers.

    Args:
        action_dim: A.
        horizon: H, steps looked ahead.
        num_samples: S, candidates per environment, those of the policy included.
        num_policy_samples: how many of them are rolled out with `prior`, if `plan` gets one.
        iterations: rounds of the search.
        low, high: bounds of every action component.

    Raises:
        UserError: a setting that cannot work.
    """

    action_dim: int
    horizon: int
    num_samples: int
    num_policy_samples: int = 0
    iterations: int
    low: float = -1.0
    high: float = 1.0

    ranges: ClassVar[Mapping[str, Bounds]] = {
        **dict.fromkeys(("action_dim", "horizon", "num_samples", "iterations"), POSITIVE),
        "num_policy_samples": Bounds(least=0),
    }
    all_by_policy: ClassVar[bool] = False
    """Whether the policy may make all candidates."""

    def __post_init__(self) -> None:
        check_arguments(type(self), vars(self), "planner", self.ranges)
        most = self.num_samples - (not self.all_by_policy)
        if self.num_policy_samples > most:
            raise UserError(
                f"planner.num_policy_samples={self.num_policy_samples}: must be at most {most}, "
                f"with num_samples={self.num_samples}"
            )
        if not self.low < self.high:
            raise UserError(f"planner.low={self.low}: must be below high={self.high}")

    @property
    def bounds(self) -> dict[str, float]:
        """`low` and `high`."""
        return {"low": self.low, "high": self.high}

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
        """See `Planner.plan`; what the result holds besides `action` and `plan` stands at `search`."""
        return self.search(Query(z, next, objective, prior, previous, is_init, explore, generator))

    def search(self, query: Query) -> TensorDict:
        """The plan of one decision: a TensorDict as `Planner.plan` returns it."""
        raise NotImplementedError

    def start(self, query: Query, *, repeat_last: bool = False) -> Tensor:
        """Plan to start from (E, H, A): the previous one, one step on, or the middle of the bounds.

        Args:
            repeat_last: fill the step that comes into sight with the last action; else with the middle.

        Raises:
            ValueError: `previous` or `is_init` has another shape.
        """
        z, previous = query.z, query.previous
        shape = (z.shape[0], self.horizon, self.action_dim)
        cold = torch.full(shape, 0.5 * (self.low + self.high), device=z.device, dtype=z.dtype)
        if previous is None:
            return cold
        if previous.shape != shape:
            raise ValueError(f"previous must have shape (E, H, A) = {shape}, got {tuple(previous.shape)}")
        previous = previous.to(z.dtype)
        shifted = torch.cat((previous[:, 1:], previous[:, -1:] if repeat_last else cold[:, :1]), dim=1)
        if query.is_init is None:
            return shifted
        require_is_init(query.is_init, z.shape[0])
        return torch.where(query.is_init.unsqueeze(-1), cold, shifted)

    def guided(self, query: Query) -> list[Tensor]:
        """The policy's candidates (E, `num_policy_samples`, H, A), unrolled from z, if there are any."""
        z, samples = query.z, self.num_policy_samples
        if query.prior is None or not samples:
            return []
        latent = repeated(z, samples)
        actions = []
        for _ in range(self.horizon):
            # A weight of zero does not remove a nan from a weighted mean, so it must not get in.
            actions.append(torch.nan_to_num(query.prior(latent), nan=0.0).clamp(self.low, self.high))
            if len(actions) < self.horizon:
                latent = query.next(latent, actions[-1])
        return [torch.stack(actions, dim=2)]

    def result(self, query: Query, action: Tensor, noise: Tensor | float, **entries: Tensor) -> TensorDict:
        """What `plan` returns: the action (E, A), explored with a deviation of `noise` if asked, and `entries`."""
        action = explored(action, noise, query.explore, generator=query.generator, **self.bounds)
        return TensorDict({"action": action, **entries}, batch_size=[action.shape[0]])


@dataclass(kw_only=True, eq=False)
class ElitePlanner(ContinuousPlanner):
    """A planner that refits a Gaussian to its best candidates.

    Args:
        num_elites: how many candidates the Gaussian is refitted to.
        kernels: False: the model's layers are called as they are; True or None: on CUDA, where nothing is compiled, a
            `PlannerPolicy` calls their kernels (`franka_wm.models.fused`), which compute the same but for rounding.
    """

    num_elites: int
    kernels: bool | None = None

    ranges: ClassVar[Mapping[str, Bounds]] = {**ContinuousPlanner.ranges, "num_elites": POSITIVE}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_elites > self.num_samples:
            raise UserError(
                f"planner.num_elites={self.num_elites}: must be at most num_samples={self.num_samples}"
            )
