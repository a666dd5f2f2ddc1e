"""What planners have in common: how they are asked, and the settings of those over continuous actions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm.errors import UserError
from franka_wm.options import POSITIVE, Bounds, check_arguments
from franka_wm.planning.objectives import Score
from franka_wm.planning.sampling import roll_prior, warm_start

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


@dataclass(kw_only=True, eq=False)
class ContinuousPlanner:
    """Settings of a planner over continuous actions; each field is one of `conf/planner`.

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

    def start(
        self, z: Tensor, previous: Tensor | None, is_init: Tensor | None, *, repeat_last: bool = False
    ) -> Tensor:
        """Plan to start from (E, H, A), see `warm_start`."""
        return warm_start(
            z,
            previous,
            is_init,
            horizon=self.horizon,
            action_dim=self.action_dim,
            repeat_last=repeat_last,
            **self.bounds,
        )

    def guided(self, z: Tensor, next: Next, prior: Prior | None) -> list[Tensor]:
        """The policy's candidates (E, `num_policy_samples`, H, A), if there are any."""
        if prior is None or not self.num_policy_samples:
            return []
        return [
            roll_prior(z, next, prior, samples=self.num_policy_samples, horizon=self.horizon, **self.bounds)
        ]


@dataclass(kw_only=True, eq=False)
class ElitePlanner(ContinuousPlanner):
    """A planner that refits a Gaussian to its best candidates.

    Args:
        num_elites: how many candidates the Gaussian is refitted to.
    """

    num_elites: int

    ranges: ClassVar[Mapping[str, Bounds]] = {**ContinuousPlanner.ranges, "num_elites": POSITIVE}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_elites > self.num_samples:
            raise UserError(
                f"planner.num_elites={self.num_elites}: must be at most num_samples={self.num_samples}"
            )
