"""Hindsight goals: sampled windows as if their goal had been a place that the same episode reached later."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase

from franka_wm.data.image_storage import BOUNDARY, OVERFLOW
from franka_wm.keys import CONTEXT

Relabel = Callable[[TensorDictBase, torch.Tensor], TensorDictBase]
"""(windows (B, H), goals (B, 3) [m]) -> the entries that another goal changes, of the same shapes."""


class Hindsight:
    """Relabels a share of each batch of windows with goals reached later (HER, arXiv:1707.01495, strategy `future`).

    The reward is a known function of state and goal, so relabeled windows are exact, not approximate. The new goal is
    where the tool, or the object that the goal is for, was after a step drawn uniformly from those between the window's
    end and the episode's. Where a policy's memory is kept (`context`), these windows begin as episodes do, without it.

    Args:
        relabel: The task's, see `franka_wm.envs.tasks.Task.relabel`.
        achieved: Name and columns of the observation that holds the place reached [m].
        reads: Observations that `relabel` and `achieved` need.
        share: Share of the windows of a batch, in [0, 1].
        episode_length: Steps of an episode, at most: how far to look ahead.
    """

    def __init__(
        self,
        relabel: Relabel,
        *,
        achieved: tuple[str, slice],
        reads: Sequence[str],
        share: float,
        episode_length: int,
    ):
        self.relabel, self.reads = relabel, reads
        self.key, self.columns = achieved
        self.share, self.episode_length = share, episode_length

    def __call__(
        self,
        batch: TensorDictBase,
        data: Any,
        time: torch.Tensor,
        world: torch.Tensor,
        newest: int | torch.Tensor,
    ) -> TensorDictBase:
        """Relabels in place; no operation waits for the device.

        Args:
            batch: Windows (B, H) that were read from `data`.
            data: The storage, (time, worlds).
            time, world: Time and world of each step of the windows, (B, H).
            newest: Time of the step that was written last.
        """
        later, _ = reached_later(data, time, world, newest, most=self.episode_length)
        reached = data.get(("next", self.key))[later, world[:, 0]]
        relabeled = self.relabel(batch, reached[..., self.columns])
        mask = torch.rand(later.shape, device=later.device) < self.share
        for key in relabeled.keys(True, True):
            new, old = relabeled.get(key), batch.get(key)
            batch.set(key, torch.where(mask.view(-1, *[1] * (old.dim() - 1)), new, old))
        if batch.get(CONTEXT, None) is not None:  # what was remembered there tells of the goal that was
            batch.get(BOUNDARY)[:, 0] |= mask.unsqueeze(-1)
        return batch


def reached_later(
    data: Any, time: torch.Tensor, world: torch.Tensor, newest: int | torch.Tensor, *, most: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """A step of each window's episode, drawn uniformly from the window's last to the episode's last.

    No operation waits for the device.

    Args:
        data: The storage, (time, worlds).
        time, world: Time and world of each step of the windows, (B, H).
        newest: Time of the step that was written last.
        most: Steps of an episode, at most: how far to look ahead.

    Returns:
        Its time, and how many steps it comes after the window's last; (B,) both.
    """
    capacity, device = data.shape[0], time.device
    last, world = time[:, -1], world[:, 0]
    ahead = torch.arange(most, device=device)
    later = (last.unsqueeze(1) + ahead) % capacity  # (B, L): the window's last step and what follows
    # Of the same episode, and written: neither past the next episode's start nor past the newest step.
    begins = data.get(BOUNDARY)[later, world.unsqueeze(1)].squeeze(-1)
    begins[:, 0] = False
    same = (begins.cumsum(1) == 0) & (ahead <= ((newest - last) % capacity).unsqueeze(1))
    # A marked step is the last of its episode: what it led to is no goal.
    if (lost := data.get(OVERFLOW, None)) is not None:
        same &= ~lost[later, world.unsqueeze(1)].squeeze(-1)
    chosen = (torch.rand(last.shape, device=device) * same.sum(1)).long()
    return later.gather(1, chosen.unsqueeze(1)).squeeze(1), chosen
