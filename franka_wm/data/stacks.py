"""Stacked images in a replay: each image is kept once, a stack is put together when it is sampled.

With ``env.frame_stack`` k every observation holds the present image and the k - 1 before it, so a replay of
observations holds each image k times. Older images of a stack are the newest ones of earlier steps, back to
where the episode began; its first image stands for those before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage

from franka_wm.errors import UserError

CHANNELS = 3
"""Channels of one image; stacks are of colours alone."""

BOUNDARY = "is_init"
"""Key of the flag that marks the first step of an episode."""


class StackStorage(LazyTensorStorage):
    """A storage of (time, worlds) that is given stacks and gives them back, and keeps their newest images.

    What is read by times and worlds has stacks, as a sampler asks for it; everything else (``storage[:]``) is as it is
    kept. Stacks of the oldest ``frame_stack - 1`` steps need images that are gone: a sampler leaves them out.

    Args:
        max_size: Steps of all worlds together.
        frame_stack: Images in a stack, k.
        stacked: Keys of stacks, (…, H, W, 3 k) uint8, oldest first along the channels; under ``next`` as well. Those
            that the first steps do not have are passed over.
        device: Where everything lives.
    """

    def __init__(
        self, max_size: int, *, frame_stack: int, stacked: Sequence[str], device: torch.device | str
    ):
        super().__init__(max_size, ndim=2, device=device)
        self.frame_stack = frame_stack
        self.stacked = tuple(stacked)
        self._checked = False

    def set(  # pyright: ignore[reportIncompatibleVariableOverride]  # TorchRL declares an attribute
        self, cursor: Any, data: Any, *, set_cursor: bool = True
    ) -> None:
        """Keeps the newest image of each stack.

        Raises:
            UserError: The first stacks that are given are not made of the images before them.
        """
        if not self.initialized:
            self.stacked = tuple(key for key in self.stacked if data.get(key, None) is not None)
        kept = newest(data, self.stacked, self.frame_stack)
        if not self._checked:  # once, and some: asking waits for the device, and compares copies
            self._checked = check_stacks(data[:64], self.stacked, self.frame_stack)
        super().set(cursor, kept, set_cursor=set_cursor)

    def get(self, index: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]  # two overloads
        match index:
            case torch.Tensor() as time, torch.Tensor() as world:
                return self.windows(time, world)
        return super().get(cast(Any, index))

    def windows(self, time: torch.Tensor, world: torch.Tensor) -> TensorDictBase:
        """Steps with their stacks; no operation waits for the device.

        Args:
            time, world: Indices of steps, of equal shape; none of the oldest ``frame_stack - 1`` times that are kept.
        """
        data: Any = self._storage
        batch = data[time, world]
        begins = data.get(BOUNDARY).squeeze(-1)
        earlier, times = time, []
        for _ in range(self.frame_stack - 1):
            earlier = torch.where(begins[earlier, world], earlier, (earlier - 1) % data.shape[0])
            times.insert(0, earlier)
        for key in self.stacked:
            images = data.get(key)
            stack = torch.cat([*(images[one, world] for one in times), batch.get(key)], -1)
            batch.set(key, stack)
            following = batch.get(("next", key), None)
            if following is not None:  # the step's own images come before it, also at the end of an episode
                batch.set(("next", key), torch.cat([stack[..., CHANNELS:], following], -1))
        return batch


def newest(data: TensorDictBase, stacked: Sequence[str], frame_stack: int) -> TensorDictBase:
    """``data`` with the newest image of each stack in its place; images that are single already stay.

    Raises:
        UserError: Images of other sizes.
    """
    out = data.copy()  # of the structure, not of the images
    for key in stacked:
        for name in (key, ("next", key)):
            images = data.get(name, None)
            if images is None:
                continue
            if images.shape[-1] not in (CHANNELS, CHANNELS * frame_stack):
                raise UserError(
                    f"{key} has {images.shape[-1]} channels, {frame_stack} stacked images have "
                    f"{CHANNELS * frame_stack}; is env.frame_stack the same as when they were gathered?"
                )
            out.set(name, images[..., -CHANNELS:])
    return out


def check_stacks(data: TensorDictBase, stacked: Sequence[str], frame_stack: int) -> bool:
    """That stacks (time, worlds) are what :class:`StackStorage` will put together again; waits for the device.

    Returns:
        Whether there are any: a checkpoint has single images.

    Raises:
        UserError: They are not: older images are not those of the steps before.
    """
    begins = data.get(BOUNDARY).squeeze(-1)
    stacks = [key for key in stacked if data.get(key).shape[-1] != CHANNELS]
    for key in stacks:
        stack = data.get(key)
        first = stack[..., -CHANNELS:].repeat(*[1] * (stack.ndim - 1), frame_stack)
        same = (stack == first).flatten(2).all(-1)
        goes_on = (stack[1:, ..., :-CHANNELS] == stack[:-1, ..., CHANNELS:]).flatten(2).all(-1)
        right = torch.where(begins, same, True).all() & torch.where(begins[1:], True, goes_on).all()
        following = data.get(("next", key), None)
        if following is not None:
            right &= (following[..., :-CHANNELS] == stack[..., CHANNELS:]).all()
        if not bool(right):
            raise UserError(
                f"{key}: its older images are not those of the steps before; a replay with frame_stack={frame_stack} "
                "takes stacks as franka_wm.envs gives them (env.frame_stack)"
            )
    return bool(stacks)
