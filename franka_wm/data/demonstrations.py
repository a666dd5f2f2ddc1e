"""Demonstrations: recorded episodes that take the place of a share of each batch of windows."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from franka_wm.data.hindsight import Hindsight
from franka_wm.data.image_storage import BOUNDARY
from franka_wm.errors import UserError

DEMONSTRATED = "demonstrated"
"""Key of the flag (B, H, 1) of the steps that were."""


class Demonstrations:
    """Replaces the first windows of each batch by windows of recorded episodes.

    As in RLPD (arXiv:2302.02948) and MoDem (arXiv:2212.05698).

    They stay on the training device for the whole run, apart from what the run gathers. Windows are uniform over all
    that lie within one episode. Goals in hindsight are given to them as to the others.

    Args:
        transitions: All of them, episode after episode, (T, 1); what the replay keeps, and what `hindsight` reads.
        window: Transitions per window, H.
        burn_in: Steps in front of each window, as in the replay's batches.
        most: How many windows of a batch are replaced at most.
        hindsight: Relabels a share of them; `None`: none.
        states: Where worlds may begin, (T,): what a simulation restores a state from; `None`: nowhere.

    Raises:
        UserError: No episode is as long as a window.
    """

    def __init__(
        self,
        transitions: TensorDictBase,
        *,
        window: int,
        burn_in: int = 0,
        most: int,
        hindsight: Hindsight | None = None,
        states: Any = None,
    ):
        self.transitions, self.most, self.hindsight, self.states = transitions, most, hindsight, states
        device = transitions.device
        episode = transitions.get(BOUNDARY).flatten().cumsum(0)
        within = episode[window - 1 :] == episode[: max(0, len(episode) - window + 1)]
        self._starts = within.nonzero().squeeze(1)  # waits for the device, once
        if not len(self._starts):
            raise UserError(f"no demonstration has {window} steps, as the windows of this run")
        self._steps = torch.arange(-burn_in, window, device=device)
        self._numbers = torch.arange(most, device=device)
        self._count = torch.zeros((), dtype=torch.int64, device=device)
        self.use(most)

    def use(self, count: int) -> None:
        """From the next batch on so many windows are demonstrations: at most :attr:`most`."""
        self._count.fill_(min(count, self.most))

    def __call__(self, batch: Any) -> TensorDictBase:
        """Replaces windows of `batch` (B, H) in place, and marks them; no operation waits for the device."""
        device = self.transitions.device
        drawn = torch.randint(len(self._starts), (self.most,), device=device)
        # The first one's first step, which is marked as such, stands for those before it.
        time = (self._starts[drawn].unsqueeze(1) + self._steps).clamp_min(0)
        world = torch.zeros_like(time)
        windows: Any = self.transitions[time, world]
        if self.hindsight is not None:
            self.hindsight(windows, self.transitions, time, world, len(self.transitions) - 1)
        mask = self._numbers < self._count
        for key in windows.keys(True, True):
            new, old = windows.get(key), batch.get(key)[: self.most]
            old.copy_(torch.where(mask.view(-1, *[1] * (old.dim() - 1)), new, old))
        shown = torch.zeros((*batch.shape, 1), dtype=torch.bool, device=device)
        shown[: self.most] = mask.view(-1, 1, 1)
        return batch.set(DEMONSTRATED, shown)
