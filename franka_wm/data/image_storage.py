"""Images in a replay: each is kept once.

A step has two images of a camera, before and after it, and the latter is the next step's first, but where an episode
ends. With ``env.frame_stack`` k an observation also holds the k - 1 images before: those of earlier steps, back to
where the episode began, whose first image stands for those before it. So one image a step is kept, and the last of each
episode; samples are put together from them.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage

from franka_wm.errors import UserError
from franka_wm.keys import LOST

CHANNELS = 3
"""Channels of one image; stacks are of colours alone."""

BOUNDARY = "is_init"
"""Key of the flag that marks the first step of an episode."""
OVERFLOW = ("next", LOST)
"""Key of the flag that marks a step in which contacts were lost, where there is a scene."""


class ImageStorage(LazyTensorStorage):
    """A storage of (time, worlds) that keeps each image once, and gives back what it was given.

    What is read by times and worlds has stacks, as a sampler asks for it; everything else (``storage[:]``) has single
    images. Stacks of the oldest ``frame_stack - 1`` steps need images that are gone: a sampler leaves them out. It is
    extended round-robin along time.

    Args:
        max_size: Steps of all worlds together.
        episode_length: Steps of an episode, if known: how many last images there is room for at first. Room is made
            when more are needed.
        frame_stack: Images in a stack, k.
        stacked: Keys of stacks, (…, H, W, 3 k) uint8, oldest first along the channels; under ``next`` as well. Those
            that the first steps do not have are passed over.
        device: Where everything lives.
    """

    def __init__(
        self,
        max_size: int,
        *,
        episode_length: int = 0,
        frame_stack: int = 1,
        stacked: Sequence[str] = (),
        device: torch.device | str,
    ):
        super().__init__(max_size, ndim=2, device=device)
        self.episode_length = episode_length or 50
        self.frame_stack = frame_stack
        self.stacked = tuple(stacked)
        self.images: tuple[str, ...] = ()
        """Keys (…, H, W, channels) that steps begin with and lead to."""
        self._checked = False
        self._ends: _Ends | None = None

    def set(  # pyright: ignore[reportIncompatibleVariableOverride]  # TorchRL declares an attribute
        self, cursor: Any, data: Any, *, set_cursor: bool = True
    ) -> None:
        """Keeps what is not kept yet.

        Raises:
            UserError: The first images that are given are not those that the steps before led to, or their stacks are
                not made of these.
        """
        if not self.initialized:
            self.stacked = tuple(key for key in self.stacked if data.get(key, None) is not None)
            self.images = image_keys(data)
        if not self.images:
            super().set(cursor, data, set_cursor=set_cursor)
            return
        steps = len(data)
        times = self.max_size // data.shape[1]
        if steps > times:  # the first of them would be overwritten at once
            cursor, data = cursor[-times:], data[-times:]
        singles = newest(data, self.stacked, self.frame_stack)
        if not self._checked:  # once, and some: asking waits for the device, and compares copies
            some = data[:64]
            stacks = check_stacks(some, self.stacked, self.frame_stack)
            check_following(singles[:64], self.images)
            self._checked = len(some) > 1 and (stacks or not self.stacked)
        super().set(cursor, single_images(singles, self.images), set_cursor=set_cursor)
        led_to = {key: singles.get(("next", key)).to(self.device) for key in self.images}
        if self._ends is None:
            self._ends = _Ends(times, self.episode_length, led_to)
        self._ends.add(data.get(BOUNDARY).squeeze(-1).to(self.device), led_to, skipped=steps - len(data))

    def _init(self, data: Any) -> None:
        log = logging.getLogger("torchrl")
        log.addFilter(_is_worth_telling)
        try:
            super()._init(data)
        finally:
            log.removeFilter(_is_worth_telling)

    def get(self, index: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]  # two overloads
        match index:
            case torch.Tensor() as time, torch.Tensor() as world:
                return self.windows(time, world)
        found: Any = super().get(index)
        if not self.images:
            return found
        shape: Any = self._len_along_dim0, self._storage.shape[1]
        time = torch.arange(shape[0], device=found.device).unsqueeze(1).expand(shape)[index]
        world = torch.arange(shape[1], device=found.device).expand(shape)[index]
        found = found.copy()  # of the structure
        for key, image in self._led_to(time, world).items():
            found.set(("next", key), image)
        return found

    def windows(self, time: torch.Tensor, world: torch.Tensor) -> TensorDictBase:
        """Steps with both their images, and stacks of them; no operation waits for the device.

        Args:
            time, world: Indices of steps, of equal shape; none of the oldest ``frame_stack - 1`` times that are kept.
        """
        data: Any = self._storage
        batch = data.exclude(*self.images)[time, world]
        if not self.images:
            return batch
        for key in self.images:
            batch.set(key, _read(data.get(key), time, world))
        led_to = self._led_to(time, world)
        if self.stacked:
            begins = data.get(BOUNDARY).squeeze(-1)
            earlier, times = time, []
            for _ in range(self.frame_stack - 1):
                earlier = torch.where(begins[earlier, world], earlier, (earlier - 1) % data.shape[0])
                times.insert(0, earlier)
            for key in self.stacked:
                images = data.get(key)
                stack = torch.cat([*(_read(images, one, world) for one in times), batch.get(key)], -1)
                batch.set(key, stack)
                # The step's own images come before what it led to, also at the end of an episode.
                led_to[key] = torch.cat([stack[..., CHANNELS:], led_to[key]], -1)
        for key, image in led_to.items():
            batch.set(("next", key), image)
        return batch

    def to_host(self) -> TensorDictBase:
        """All steps that are kept (time, worlds), in the host's memory: a device's may have no room for both images."""
        data: Any = self._storage
        if data.device.type == "cpu":
            return self.get(slice(None))
        some = max(1, int(5e8 * data.shape[1] // data.bytes()))
        every = range(0, data.shape[1], some)
        parts: Any = [self.get((slice(None), slice(k, k + some))).cpu() for k in every]
        return cast(TensorDictBase, torch.cat(parts, 1))

    @property
    def memory(self) -> tuple[int, ...]:
        """Where the kept tensors lie; another place: what was captured of them is stale."""
        data: Any = self._storage
        return (id(data), data.get(BOUNDARY).data_ptr(), *(() if self._ends is None else self._ends.memory))

    def bytes_per_step(self, data: TensorDictBase) -> float:
        """Bytes that a step of ``data`` takes here, last images of episodes included."""
        singles = newest(data, self.stacked, self.frame_stack)
        images = image_keys(singles)
        last = sum(singles.get(key).nbytes for key in images) / self.episode_length
        return (single_images(singles, images).bytes() + last) / data.numel()

    def _led_to(self, time: torch.Tensor, world: torch.Tensor) -> dict[str, torch.Tensor]:
        """Single images that steps led to."""
        data: Any = self._storage
        assert self._ends is not None
        slot, following = self._ends.slots[time, world].long(), (time + 1) % data.shape[0]
        last = slot >= 0
        slot = slot.clamp_min(0)
        found = {}
        for key, ends in self._ends.images.items():
            ended, goes_on = _words(ends)[slot, world], _words(data.get(key))[following, world]
            images = torch.where(last.unsqueeze(-1), ended, goes_on)
            found[key] = images.view(ends.dtype).view(*time.shape, *ends.shape[2:])
        return found

    def _empty(self) -> None:
        super()._empty()
        self._ends = None


def _is_worth_telling(record: logging.LogRecord) -> bool:
    """TorchRL's line about the shape of a new storage is not."""
    return not record.getMessage().startswith("Initialized ")


class _Ends:
    """Images that steps led to and no following step begins with, in slots of their world.

    A slot is given back when its step is overwritten. Nothing waits for the device, but when slots may have run out.

    Args:
        times: That are kept; they are written round-robin, from 0 on.
        episode_length: Steps of an episode, about.
        images: Some images (…, worlds, H, W, channels) each.

    Attributes:
        slots: (times, worlds) int32: slot of the image that a step led to; `FOLLOWED`: the next step begins with it.
        images: (slots, worlds, H, W, channels) each.
    """

    FOLLOWED = -1
    NEWEST = 0
    """Slot of what the newest step led to: the step after it is not there yet."""
    WASTE = 1
    """Slot of what is not kept: a mask with a fixed number of writes needs no count on the host."""
    FIRST = 2

    def __init__(self, times: int, episode_length: int, images: dict[str, torch.Tensor]) -> None:
        some = next(iter(images.values()))
        worlds = some.shape[1]
        self.device, self.world = some.device, torch.arange(worlds, device=some.device)
        self.start, self.filled = 0, False  # time of the next step; whether there was one before
        self.slots = torch.full((times, worlds), self.FOLLOWED, dtype=torch.int32, device=self.device)
        self.images = {key: x.new_empty(self.FIRST, *x.shape[1:]) for key, x in images.items()}
        # A stack for each world: its free slots are the first `count` rows; the last row takes what does not count.
        self.free = torch.zeros(1, worlds, dtype=torch.int32, device=self.device)
        self.count = torch.zeros(worlds, dtype=torch.int64, device=self.device)
        self._surely_free = 0
        self._told: tuple[torch.Tensor, torch.cuda.Event] | None = None
        self._grow(-(-times // episode_length) + 8)

    @property
    def memory(self) -> tuple[int, ...]:
        """Where it lies."""
        return tuple(x.data_ptr() for x in (self.slots, *self.images.values()))

    def add(self, begins: torch.Tensor, led_to: dict[str, torch.Tensor], *, skipped: int) -> None:
        """Keeps the last images of episodes that end, and the newest.

        Args:
            begins: (T, worlds) bool for the next T times: first steps of episodes.
            led_to: Images (T, worlds, H, W, channels) that the steps led to.
            skipped: Steps before these that are not kept.
        """
        steps, times = len(begins), len(self.slots)
        start = (self.start + skipped) % times
        time = (torch.arange(steps, device=self.device) + start) % times
        self._give_back(self.slots[time])
        self._make_room(begins)
        if self.filled and steps < times:  # the newest step so far has a following one now
            newest = (start - 1) % times
            image = {key: x[self.NEWEST].clone().unsqueeze(0) for key, x in self.images.items()}
            self._keep(slice(newest, newest + 1), begins[:1], image)
        self._keep(time[:-1], begins[1:], {key: x[:-1] for key, x in led_to.items()})
        for key, x in led_to.items():
            self.images[key][self.NEWEST] = x[-1]
        self.start, self.filled = (start + steps) % times, True
        newest = (self.start - 1) % times
        self.slots[newest] = self.NEWEST
        if self.device.type == "cuda":
            self._told = self.count.min().to("cpu", non_blocking=True), torch.cuda.Event()
            self._told[1].record()

    def _keep(
        self, times: torch.Tensor | slice, ended: torch.Tensor, images: dict[str, torch.Tensor]
    ) -> None:
        """Images (T, worlds, …) of some times into free slots, where the episode has ended (T, worlds)."""
        order = ended.cumsum(0)
        taken = self.free.gather(0, self.count - order)
        slot = torch.where(ended, taken, self.WASTE).long()
        self.count -= order[-1:].sum(0)
        for key, x in images.items():
            self.images[key][slot, self.world] = x
        self.slots[times] = torch.where(ended, taken, self.FOLLOWED)

    def _give_back(self, slots: torch.Tensor) -> None:
        """Slots (T, worlds) of steps that are overwritten."""
        held = slots >= self.FIRST
        row = torch.where(held, self.count + held.cumsum(0) - 1, len(self.free) - 1)
        self.free.scatter_(0, row, slots)
        self.count += held.sum(0)

    def _make_room(self, begins: torch.Tensor) -> None:
        """As many free slots in each world as episodes may end; waits for the device only where there may be too few.

        How many were free after the steps before was copied to the host then, which takes no waiting.
        """
        needed = len(begins)
        if self._told is not None and self._told[1].query():
            self._surely_free = int(self._told[0])
        if self._surely_free < needed:
            self._surely_free, needed = int(self.count.min()), int(begins.sum(0).max())
        if self._surely_free < needed:
            self._grow(max(needed - self._surely_free, len(self.free) // 8 + 1))
        self._surely_free -= needed

    def _grow(self, more: int) -> None:
        first = len(next(iter(self.images.values())))
        self.images = {key: torch.cat([x, x.new_empty(more, *x.shape[1:])]) for key, x in self.images.items()}
        self.free = torch.cat([self.free[:-1], self.free.new_zeros(more + 1, len(self.world))])
        new = torch.arange(first, first + more, dtype=torch.int32, device=self.device).unsqueeze(1)
        row = self.count + torch.arange(more, device=self.device).unsqueeze(1)
        self.free.scatter_(0, row, new.expand(more, len(self.world)))
        self.count += more
        self._surely_free += more


def _words(images: torch.Tensor) -> torch.Tensor:
    """Kept images (a, b, …) as (a, b, words), in the same memory.

    What is read by indices goes number by number, and there are eight times fewer words than bytes.
    """
    flat = images.view(*images.shape[:2], -1)
    return flat.view(torch.int64) if flat.shape[2] % 8 == 0 else flat


def _read(images: torch.Tensor, time: torch.Tensor, world: torch.Tensor) -> torch.Tensor:
    """``images[time, world]`` of kept images (times, worlds, …)."""
    return _words(images)[time, world].view(images.dtype).view(*time.shape, *images.shape[2:])


def image_keys(data: TensorDictBase) -> tuple[str, ...]:
    """Keys of images that steps (time, worlds) both begin with and lead to."""
    return tuple(
        key for key, x in data.items()
        if isinstance(x, torch.Tensor) and x.dim() >= data.dim() + 2 and data.get(("next", key), None) is not None
    )  # fmt: skip


def single_images(data: TensorDictBase, images: Sequence[str]) -> TensorDictBase:
    """``data`` without the images that steps lead to."""
    return data.exclude(*(("next", key) for key in images))


def check_following(data: TensorDictBase, images: Sequence[str]) -> None:
    """That steps (time, worlds) begin with what the steps before them led to; waits for the device.

    Raises:
        UserError: They do not.
    """
    begins = data.get(BOUNDARY)[1:].squeeze(-1)
    for key in images:
        same = (data.get(key)[1:] == data.get(("next", key))[:-1]).flatten(2).all(-1)
        if not bool((same | begins).all()):
            raise UserError(
                f"{key}: the image that a step begins with is not the one that the step before led to; a replay keeps "
                f"each image once, so only steps with {BOUNDARY} may begin with another"
            )


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
    """That stacks (time, worlds) are what :class:`ImageStorage` will put together again; waits for the device.

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
