"""Whether each batch of a replay goes on where the last one ended."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from franka_wm.data.image_storage import BOUNDARY
from franka_wm.errors import UserError


class Following:
    """What the last step of each world led to, and whether the next batch (worlds, time) begins with it.

    Vectors and images that steps both begin with and lead to are compared, once they were seen to go on from step to
    step: others, as a policy's own, need not. On the CPU alone: elsewhere a comparison waits for the device.
    """

    def __init__(self) -> None:
        self._last: dict[str, torch.Tensor] = {}
        self._goes_on: dict[str, bool] = {}  # nothing of keys of which nothing was seen

    def forget(self) -> None:
        """The next batch may begin with anything."""
        self._last = {}

    def check(self, data: Any) -> None:
        """Compares the first step of a batch with what the last one before led to.

        Raises:
            UserError: A world neither goes on nor begins an episode.
        """
        first = data[:, 0]
        begins = first.get(BOUNDARY).flatten(1).any(1)
        for key, last in self._last.items():
            now = first.get(key, None)
            if now is None or now.shape != last.shape or now.device.type != "cpu":
                continue
            broken = ~(_same(last, now, 1) | begins)
            if self._goes_on.get(key) and bool(broken.any()):
                raise UserError(
                    f"a batch must go on where the last one ended (world {int(broken.long().argmax())} does not): give "
                    f"every batch in turn, or begin with {BOUNDARY}"
                )
            self._learn(key, broken, begins)

    def keep(self, data: Any) -> None:
        """Keeps in mind what the last step of a batch led to."""
        self._last = {}
        begins = data.get(BOUNDARY).flatten(2).any(2)[:, 1:]
        for key in observed(data):
            led_to = data.get(("next", key))
            self._learn(key, ~(_same(led_to[:, :-1], data.get(key)[:, 1:], 2) | begins), begins)
            if self._goes_on.get(key, True):
                self._last[key] = led_to[:, -1].clone()

    def _learn(self, key: str, broken: torch.Tensor, begins: torch.Tensor) -> None:
        """That a key goes on, if so far it did wherever no episode begins; once it does not, it never did."""
        if bool(broken.any()):
            self._goes_on[key] = False
        elif not bool(begins.all()):  # of no steps it is True
            self._goes_on.setdefault(key, True)


def observed(data: Any) -> Sequence[str]:
    """Keys on the CPU, of vectors and images, that steps (worlds, time) both begin with and lead to."""
    return [
        key for key, x in data.items()
        if isinstance(x, torch.Tensor) and (x.is_floating_point() if x.dim() == 3 else x.dim() > 4)
        and x.device.type == "cpu" and getattr(data.get(("next", key), None), "shape", None) == x.shape
    ]  # fmt: skip


def _same(before: torch.Tensor, now: torch.Tensor, leading: int) -> torch.Tensor:
    """Whether entries are the same, in their leading dimensions; what is no number is like anything."""
    same = before == now
    if before.is_floating_point():
        same |= before.isnan()
    return same.flatten(leading).all(-1)
