"""What every task is."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
import warp as wp
from tensordict import TensorDictBase

from franka_wm.envs.config import FrankaConfig

if TYPE_CHECKING:
    from franka_wm.envs.simulation import Simulation


class Task:
    """Goal, reward and success of all worlds. Override what differs; each method only launches kernels.

    Args:
        config: The environment's.
    """

    def __init__(self, config: FrankaConfig):
        self.config = config

    @property
    def reward_bounds(self) -> tuple[float, float] | None:
        """The least and the largest reward of a step, from which models derive the range of their values.

        ``None``: unknown. A class attribute is enough: ``reward_bounds = (-1.0, 0.0)``.
        """
        return None

    @property
    def goal_distance(self) -> bool:
        """Whether success is to have the tool near ``task_goal``.

        Then evaluation reports the distance, and success within several distances, and else what ``judge`` writes into
        ``success``. A class attribute is enough.
        """
        return False

    def reset(self, sim: Simulation, mask: wp.array) -> None:
        """Writes ``sim.warp.task_goal`` (N, 3), and ``sim.warp.goal_q`` (N, 7) if known, where ``mask`` (N,)."""
        raise NotImplementedError(f"{type(self).__name__} gives no goal")

    def begin(self, sim: Simulation, mask: wp.array) -> None:
        """Called after a reset, when ``sim.warp.true_state`` (N, 20) is the first one of the masked worlds."""

    def advance(self, sim: Simulation) -> None:
        """Called in every step after the physics and before the observation: moves a goal that moves."""

    def judge(self, sim: Simulation) -> None:
        """Writes ``sim.warp.reward`` and ``sim.warp.success`` (N, 1) from ``next_true_state`` (N, 20) and ``action``.

        ``next_true_state`` is ``next_state`` without observation noise."""
        raise NotImplementedError(f"{type(self).__name__} gives no reward")

    def measures(self, sim: Simulation) -> dict[str, torch.Tensor]:
        """What else evaluation reports, by names with their units: (N,) each, after a step; the episode's last counts.

        Computed with torch, outside the captured step, from ``sim.next_true_state`` (N, 20): finished worlds have
        been reset already.
        """
        return {}

    relabel: Callable[[TensorDictBase, torch.Tensor], TensorDictBase] | None = None
    """Recorded transitions as if the goal had been another, where the task can say so in torch: see `Reach.relabel`."""

    @classmethod
    def relabels(cls) -> bool:
        """Whether ``relabel`` speaks for this task: a subclass that changes rewards or moves goals says so anew."""

        def owner(name: str) -> int:
            return next(i for i, one in enumerate(cls.__mro__) if name in vars(one))

        return cls.relabel is not None and owner("relabel") <= min(owner("judge"), owner("advance"))
