"""Tasks in torch tensors alone."""

from __future__ import annotations

from abc import abstractmethod
from functools import partial
from typing import TYPE_CHECKING

import torch
import warp as wp
from tensordict import TensorDict, TensorDictBase

from franka_wm.envs.tasks.base import Task, with_goal
from franka_wm.errors import UserError

if TYPE_CHECKING:
    from franka_wm.envs.config import FrankaConfig
    from franka_wm.envs.simulation import Simulation


class TorchTask(Task):
    """Goal, reward and success as functions of batched tensors. Override ``goal``, ``reward`` and ``success``.

    On a GPU they become part of the captured step: only what they did to tensors is replayed. On the CPU they run
    beside it. So they work on whole batches (``torch.where`` instead of ``if``), never wait for the device (no
    ``.item()``), copy nothing from the host (no ``torch.tensor``), and draw nothing: random numbers are given.

    The 20 numbers of a state are joints 7 [rad], velocities 7 [rad/s], tool 3 [m], tool − goal 3 [m]; with a gripper 8
    of the hand follow, and then the 13 of each object (``docs/tasks.md``). It has no observation noise. The config's
    ``action_penalty`` has no part in ``reward``; ``self.config`` has it.
    """

    num_draws = 8
    draws_goals = True
    rewards = ("dense",)

    def __init__(self, config: FrankaConfig):
        self.check_defined()  # of one that has no name, too
        super().__init__(config)

    @classmethod
    def must_define(cls) -> list[str]:
        """Without those of a part that it writes in Warp."""
        parts = {"goal": "reset", "reward": "reward_and_success", "success": "reward_and_success"}
        return [name for name, part in parts.items() if getattr(cls, part) is getattr(TorchTask, part)]

    @abstractmethod
    def goal(self, draws: torch.Tensor) -> torch.Tensor:
        """Goal of an episode: (N, num_draws) random numbers, uniform in [0, 1) → (N, 3) [m]."""
        raise NotImplementedError(f"{type(self).__name__} gives no goal")

    @abstractmethod
    def reward(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Reward of being in ``state`` after ``action``, clipped to [−1, 1]: (..., 20), (..., A) → (...,)."""
        raise NotImplementedError(f"{type(self).__name__} gives no reward")

    @abstractmethod
    def success(self, state: torch.Tensor) -> torch.Tensor:
        """Whether the task is solved in ``state``: (..., 20) → (...,) bool."""
        raise NotImplementedError(f"{type(self).__name__} says no success")

    def reset(self, sim: Simulation, mask: wp.array) -> None:
        sim.recorder.run(partial(self._write_goal, sim))

    def reward_and_success(self, sim: Simulation) -> None:
        sim.recorder.run(partial(self._write_reward_and_success, sim))

    def present_reward(self, sim: Simulation, action: torch.Tensor) -> torch.Tensor:
        t = sim.tensors
        return self.reward(_seen(t.true_state, t.true_objects), _applied(action)).unsqueeze(-1)

    def relabel(self, transitions: TensorDictBase, goal: torch.Tensor) -> TensorDict:
        """As :meth:`Reach.relabel`: observations, reward and end of recorded transitions had the goal been another."""
        out = with_goal(transitions, goal)
        after = _seen(out.get(("next", "state")), transitions.get(("next", "objects"), None))
        out.set(("next", "reward"), self.reward(after, _applied(transitions.get("action"))).unsqueeze(-1))
        ended = self.success(after).unsqueeze(-1) & self.config.terminate_on_success
        out.set(("next", "terminated"), ended)
        return out

    @property
    def relabel_reads(self) -> tuple[str, ...]:
        """The objects, too, where there are any: reward and success may be about them."""
        return ("state", "objects") if self.config.object_dim else ("state",)

    @classmethod
    def relabels(cls) -> bool:
        """Where the task is to come near a goal: else a place that the tool reached is no goal of it."""
        return cls.goal_distance is True and super().relabels()

    def _write_goal(self, sim: Simulation) -> None:
        t = sim.tensors
        goal = self._checked("goal", self.goal(t.draws), (sim.num_envs, 3))
        mask = t.mask.unsqueeze(-1)
        t.task_goal.copy_(torch.where(mask, goal, t.task_goal))
        if "goal_pixels" in sim.config.images:
            home = wp.to_torch(sim.chain.home).expand(sim.num_envs, -1)
            t.goal_q.copy_(torch.where(mask, sim.kinematics.solve(goal, home, iterations=24), t.goal_q))

    def _write_reward_and_success(self, sim: Simulation) -> None:
        t, shape = sim.tensors, (sim.num_envs,)
        state = _seen(t.next_true_state, t.next_true_objects)
        reward = self._checked("reward", self.reward(state, _applied(t.action)), shape)
        success = self._checked("success", self.success(state), shape, boolean=True)
        t.reward.copy_(reward.unsqueeze(-1))
        t.success.copy_(success.unsqueeze(-1))

    def _checked(
        self, name: str, value: object, shape: tuple[int, ...], *, boolean: bool = False
    ) -> torch.Tensor:
        if isinstance(value, torch.Tensor):
            right = value.dtype == torch.bool if boolean else value.dtype.is_floating_point
            if value.shape == shape and right:
                return value.detach()
            given = f"{tuple(value.shape)} {value.dtype}"
        else:
            given = f"{type(value).__name__}, not a tensor"
        raise UserError(
            f"{type(self).__name__}.{name} gave {given}; for {shape[0]} worlds it must "
            f"give {shape} {'bool' if boolean else 'float'}"
        )


def _seen(state: torch.Tensor, objects: torch.Tensor | None) -> torch.Tensor:
    """The state, and the objects where there are any: what reward and success are functions of."""
    return state if objects is None or not objects.shape[-1] else torch.cat([state, objects], -1)


def _applied(action: torch.Tensor) -> torch.Tensor:
    """Actions as they count: in [−1, 1]; 0 for one that is not finite, whose world is caught as broken."""
    return action.nan_to_num(0.0, 0.0, 0.0).clamp(-1.0, 1.0)
