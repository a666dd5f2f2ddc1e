"""Frames that an episode reached after a window: goals farther away than a window is long."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase

from franka_wm.data.hindsight import reached_later

FUTURE = "future"
"""Key of a batch's frames that were reached later; ``steps`` of it: how many steps after each of the window."""


class FutureFrames:
    """Gives each window a frame of its episode that it ends with or that comes after it, drawn uniformly.

    Args:
        episode_length: Steps of an episode, at most: how far to look ahead.
    """

    ENDS = ("done", "terminated", "truncated")
    """Flags of an episode's end: no observations."""

    def __init__(self, *, episode_length: int):
        self.episode_length = episode_length

    def __call__(
        self,
        batch: TensorDictBase,
        storage: Any,
        time: torch.Tensor,
        world: torch.Tensor,
        newest: int | torch.Tensor,
    ) -> TensorDictBase:
        """Adds them to ``batch`` (B, H); no operation waits for the device.

        Args:
            batch: Windows that were read from ``storage``.
            storage: An :class:`~franka_wm.data.image_storage.ImageStorage`.
            time, world: Time and world of each step of the windows, (B, H).
            newest: Time of the step that was written last.
        """
        later, ahead = reached_later(storage._storage, time, world, newest, most=self.episode_length)
        led_to = cast(TensorDictBase, storage.windows(later.unsqueeze(1), world[:, :1]).get("next"))
        keys = [key for key in led_to.keys() if key in batch.keys() and key not in self.ENDS]  # noqa: SIM118
        return batch.set(FUTURE, future_frames({key: led_to.get(key) for key in keys}, ahead, time.shape[1]))


def future_frames(frames: Mapping[str, torch.Tensor], ahead: torch.Tensor, horizon: int) -> TensorDict:
    """What a batch of windows keeps under :data:`FUTURE`, (B, H): one frame, seen from each step.

    Args:
        frames: Observations (B, 1, ...) each.
        ahead: (B,) steps after the windows' last observation.
        horizon: H.
    """
    shape, device = (len(ahead), horizon), ahead.device
    steps = ahead.unsqueeze(1) + torch.arange(horizon, 0, -1, device=device)
    expanded = {key: frame.expand(*shape, *frame.shape[2:]) for key, frame in frames.items()}  # no copy
    return TensorDict({**expanded, "steps": steps.unsqueeze(-1)}, batch_size=shape)
