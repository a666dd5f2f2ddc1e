"""Whether each batch of a replay goes on where the last one ended."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from franka_wm.data.image_storage import BOUNDARY
from franka_wm.errors import UserError


class Following:
    """What the last step of each world led to, and whether the next batch (worlds, time) begins with it.

    Vectors that steps both begin with and lead to are compared, if they go on from step to step within the batches so
    far. On the CPU alone: elsewhere a comparison waits for the device.
    """

    def __init__(self) -> None:
        self._last: dict[str, torch.Tensor] | None = None

    def forget(self) -> None:
        """The next batch may begin with anything."""
        self._last = None

    def check(self, data: Any) -> None:
        """Compares the first step of a batch with what the last one before led to.

        Raises:
            UserError: A world neither goes on nor begins an episode.
        """
        first = data[:, 0]
        for key, last in (self._last or {}).items():
            now = first.get(key, None)
            if now is None or now.shape != last.shape or now.device.type != "cpu":
                continue
            broken = ~(_same(last, now) | first.get(BOUNDARY).reshape(len(now), -1).any(1))
            if bool(broken.any()):
                raise UserError(
                    f"a batch must go on where the last one ended (world {int(broken.long().argmax())} does not): give "
                    f"every batch in turn, or begin with {BOUNDARY}"
                )

    def keep(self, data: Any) -> None:
        """Keeps in mind what the last step of a batch led to."""
        keys = [key for key in vectors(data) if self._last is None or key in self._last]
        self._last = {}
        for key in keys:
            begins = data.get(BOUNDARY).reshape(*data.shape, -1).any(2)
            led_to = data.get(("next", key))
            if bool((_same(led_to[:, :-1], data.get(key)[:, 1:]) | begins[:, 1:]).all()):
                self._last[key] = led_to[:, -1].clone()


def vectors(data: Any) -> Sequence[str]:
    """Keys of vectors on the CPU that steps (worlds, time) both begin with and lead to."""
    return [
        key for key, x in data.items()
        if isinstance(x, torch.Tensor) and x.dim() == 3 and x.is_floating_point() and x.device.type == "cpu"
        and getattr(data.get(("next", key), None), "shape", None) == x.shape
    ]  # fmt: skip


def _same(before: torch.Tensor, now: torch.Tensor) -> torch.Tensor:
    """Whether vectors (…, D) are the same, (…,); what is no number is like anything."""
    return ((before == now) | before.isnan()).all(-1)
