"""The last few images of every world, side by side along the channels."""

from __future__ import annotations

import torch
from torch import Tensor


class FrameStack:
    """The last ``count`` images of N worlds by observation key, oldest first; nothing waits for the device.

    Args:
        count: Images that are kept, the present one included.
    """

    def __init__(self, count: int):
        self.count = count
        self._frames: dict[str, Tensor] = {}

    def __getitem__(self, key: str) -> Tensor:
        """A copy of what is kept under ``key``, (N, H, W, C · count)."""
        return self._frames[key].clone()

    def push(self, key: str, image: Tensor) -> None:
        """``image`` (N, H, W, C) is the present one from now on, and the oldest is forgotten."""
        kept = self._kept(key, image)
        self._frames[key] = torch.cat((kept[..., image.shape[-1] :], image), -1)

    def restart(self, key: str, image: Tensor, mask: Tensor | None = None) -> None:
        """Copies of ``image`` (N, H, W, C) where ``mask`` (N,) is true, or everywhere: an episode begins."""
        copies = self.still(image)
        if mask is not None and key in self._frames:
            copies = torch.where(mask.view(-1, 1, 1, 1), copies, self._frames[key])
        self._frames[key] = copies

    def replace(self, key: str, image: Tensor) -> None:
        """``image`` (N, H, W, C) instead of the present one."""
        kept = self._kept(key, image)
        self._frames[key] = torch.cat((kept[..., : -image.shape[-1]], image), -1)

    def _kept(self, key: str, image: Tensor) -> Tensor:
        """What is kept, or, before the first reset, as if nothing had ever moved."""
        return self._frames[key] if key in self._frames else self.still(image)

    def still(self, image: Tensor) -> Tensor:
        """``image`` (N, H, W, C) as if nothing had moved, (N, H, W, C · count)."""
        return image.repeat(1, 1, 1, self.count)

    def memory(self) -> dict[str, Tensor]:
        """What is kept, by key: not copies."""
        return dict(self._frames)

    def load(self, frames: dict[str, Tensor]) -> None:
        """Keeps copies of what :meth:`memory` gave."""
        self._frames = {key: frame.clone() for key, frame in frames.items()}
