"""A replay buffer on the training device, and a sampler of windows that is exact."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import torch
from torchrl.data import ReplayBuffer
from torchrl.data.replay_buffers import RoundRobinWriter, Sampler

from franka_wm.data.demonstrations import Demonstrations
from franka_wm.data.following import Following
from franka_wm.data.future import FutureFrames
from franka_wm.data.hindsight import Hindsight
from franka_wm.data.image_storage import BOUNDARY, OVERFLOW, ImageStorage
from franka_wm.errors import UserError
from franka_wm.options import check_whole


class WindowSampler(Sampler):
    """Windows of consecutive steps of one episode, uniform over all such windows but for ``moved``, in O(batch).

    The storage is (time, worlds), written round-robin along time. A window starts at a uniformly drawn
    (time, world) and is kept if it neither crosses the writer's position nor contains the start of an episode
    after its first step: drawing and rejecting is exact and, unlike a list of episodes, free of any pass over
    the buffer. A fixed number of candidates is drawn, so that nothing waits for the device.

    A window of ``length`` H has H transitions: the observations o₀ … o_{H−1} at its root and, under ``next``,
    o₁ … o_H. So H + 1 observations, the last one the true end of the episode where there is one.

    Args:
        writer: The buffer's writer; knows where the oldest step is.
        length: Transitions per window, H ≥ 1.
        oversample: Candidates per window kept. With episodes of L steps a candidate is kept with probability
            (L − H + 1) / L; 4 is enough for L ≥ 2 H and batches of 32.
        cross_episode: Windows may go on past the end of an episode, into the next one: for losses that look at
            :data:`BOUNDARY` themselves. Then every step starts windows, also the last ones of an episode, and
            episodes shorter than a window are seen.
        moved: Windows that would cross the end of an episode are moved to the side of it where they have more steps.
            Else the first and the last steps of an episode are in few windows, its very first and last in one.
        before: So many steps before each window must be kept as well: for stacked images.
        burn_in: So many steps before each window are given in front of it, of any episode, for a memory to begin
            with. The oldest one that is kept stands for those that are not.
        marks: Steps under ``("next", "overflow")`` are in no window, only in front of one: contacts were lost in them.
    """

    OVERSAMPLE = 4

    def __init__(
        self,
        writer: RoundRobinWriter,
        *,
        length: int,
        oversample: int = OVERSAMPLE,
        cross_episode: bool = False,
        moved: bool = False,
        before: int = 0,
        burn_in: int = 0,
        marks: bool = False,
    ):
        if length < 1 or oversample < 1 or burn_in < 0:
            raise UserError(
                f"window length={length}, oversample={oversample}, burn_in={burn_in}: the first two must be at least "
                "1, the last at least 0"
            )
        self.writer = writer
        self.length = length
        self.oversample = oversample
        self.cross_episode = cross_episode
        self.moved = moved
        self.before = before
        self.burn_in = burn_in
        self.marks = marks
        self._missing: torch.Tensor | None = None

    def sample(self, storage: Any, batch_size: int) -> tuple[Any, dict]:
        span, oldest = self.bounds(storage)
        worlds = storage._storage.shape[1]
        count = self.candidates(batch_size)
        draw = torch.randint(span * worlds, (count,), device=storage._storage.device)
        time, world, crossing = self.choose(storage._storage, draw, oldest, span, batch_size)
        if crossing is not None:
            self.record_missing(crossing)
        return (time, world), {}

    def bounds(self, storage: Any) -> tuple[int, int]:
        """How many times a window may start at, in each world, and the oldest of them.

        Raises:
            UserError: There are fewer steps than a window has.
        """
        filled = storage._len_along_dim0 or 0  # None before the first batch
        span = filled - self.before - self.length + 1
        if span < 1:
            raise UserError(
                f"the replay buffer holds {filled} steps per world, a window needs {self.before + self.length}; "
                "collect more first"
            )
        oldest = self.writer._cursor if filled == storage._storage.shape[0] else 0
        return span, oldest + self.before

    @property
    def _whole(self) -> bool:
        """Whether windows across an episode's start are rejected."""
        return self.length > 1 and not self.cross_episode

    def candidates(self, batch_size: int) -> int:
        """How many windows are drawn for a batch of so many."""
        return self.oversample * batch_size + 64 if self._whole or self.marks else batch_size

    def choose(
        self,
        data: Any,
        draw: torch.Tensor,
        oldest: int | torch.Tensor,
        span: int | torch.Tensor,
        batch_size: int,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """The windows of a batch among the drawn ones; no operation waits for the device.

        Args:
            data: The storage, (time, worlds).
            draw: (candidates,) int64, from [0, span · worlds): uniform.
            oldest: The first time that a window may start at.
            span: How many times a window may start at.

        Returns:
            Time and world of each step, (batch_size, burn_in + length) both, and which windows cross an episode's
            start, or have a marked step, though they should not, (batch_size,) bool: none where there are enough whole
            ones, ``None`` where all may.
        """
        (capacity, worlds), device = data.shape[:2], draw.device
        world, start = draw % worlds, torch.div(draw, worlds, rounding_mode="floor")
        steps = torch.arange(self.length, device=device)
        time = (start.unsqueeze(1) + oldest + steps) % capacity
        crossing = None
        if self._whole:
            starts = data.get(BOUNDARY)[time[:, 1:], world.unsqueeze(1)].flatten(1)
            if self.moved:
                start = self._moved(start, starts, span)
                time = (start.unsqueeze(1) + oldest + steps) % capacity
                starts = data.get(BOUNDARY)[time[:, 1:], world.unsqueeze(1)].flatten(1)
            crossing = starts.any(1)
        if self.marks:
            lost = data.get(OVERFLOW)[time, world.unsqueeze(1)].flatten(1).any(1)
            crossing = lost if crossing is None else crossing | lost
        if crossing is not None:
            # Stable: keeps the order of the draws, so the first batch_size whole windows are drawn as all are.
            order = torch.sort(crossing, stable=True).indices[:batch_size]
            start, time, world, crossing = start[order], time[order], world[order], crossing[order]
        if self.burn_in:
            earlier = start.unsqueeze(1) + torch.arange(-self.burn_in, 0, device=device)
            time = torch.cat(((earlier.clamp_min(0) + oldest) % capacity, time), 1)
        return time, world.unsqueeze(1).expand_as(time), crossing

    def _moved(self, start: torch.Tensor, starts: torch.Tensor, span: int | torch.Tensor) -> torch.Tensor:
        """Where windows (n,) with these starts of episodes after their first step (n, length - 1) begin instead.

        Where an episode starts if they have more of it than of the one before, else where they end with that one.
        """
        before = starts.long().argmax(1) + 1  # steps of the episode that it begins in
        moved = torch.where(2 * before <= self.length, start + before, start + before - self.length)
        return torch.where(starts.any(1) & (moved >= 0) & (moved < span), moved, start)

    def record_missing(self, crossing: torch.Tensor) -> None:
        """Keeps in mind whether a batch holds windows that are not whole, for :meth:`check`."""
        if crossing.device.type == "cpu":
            self._missing = crossing.any()
            self.check()
        else:  # asking now would wait for the device: kept for check()
            self._missing = crossing.any() if self._missing is None else self._missing | crossing.any()

    def check(self) -> None:
        """Raises if any batch since the last check could not be filled with whole windows; one host sync."""
        if self._missing is not None and bool(self._missing):
            raise UserError(
                f"too few episodes of at least {self.length} steps in the replay buffer; "
                "shorten the model's horizon, lengthen episodes, or collect more"
                + ("; where contacts are lost too often, raise env.max_contacts" if self.marks else "")
            )
        self._missing = None

    # What TorchRL asks of a sampler; there is no state besides the buffer's.
    def _empty(self) -> None: ...

    def dumps(self, path: Any) -> None: ...

    def loads(self, path: Any) -> None: ...

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None: ...


class WindowReplay(ReplayBuffer):
    """A replay buffer of windows: a share of them may get goals in hindsight, another may be demonstrations.

    Args:
        num_envs: Worlds of the batches that it is extended with.
        hindsight: Relabels each batch in place; ``None``: batches are as they were gathered.
        future: Adds frames that were reached later; ``None``: batches are windows alone.
        demonstrations: Replace windows in place; ``None``: batches are of this buffer alone.
        options: Options of TorchRL's buffer.
    """

    def __init__(
        self,
        *,
        num_envs: int,
        hindsight: Hindsight | None = None,
        future: FutureFrames | None = None,
        demonstrations: Demonstrations | None = None,
        **options: Any,
    ):
        super().__init__(**options)
        self.num_envs = num_envs
        self.hindsight, self.future, self.demonstrations = hindsight, future, demonstrations
        self.following = Following()
        self._warned_batch_size_conflict = True  # sample(8) is honoured: TorchRL need not warn of it

    def extend(self, data: Any, *, update_priority: bool | None = None) -> torch.Tensor:
        """Keeps a batch (worlds, time) of the collector, behind the one before.

        Raises:
            UserError: It has another shape, lacks an entry, or, on the CPU, does not go on where the last one ended.
        """
        shape = tuple(data.shape)
        if len(shape) != 2 or shape[0] != self.num_envs:
            raise UserError(
                f"the replay buffer: extend with the collector's batch (worlds, time), ({self.num_envs}, …) here, not "
                f"{shape}"
            )
        if data.get(BOUNDARY, None) is None:
            raise UserError(
                f"the replay buffer: the batch has no {BOUNDARY}, which marks first steps of episodes; franka_wm.envs "
                "gives it, elsewhere TorchRL's InitTracker"
            )
        if len(self) == 0:
            self.following.forget()
        elif (key := self._lacking(data)) is not None:
            name = key if isinstance(key, str) else ".".join(key)
            raise UserError(f"the replay buffer: the batch has no {name}, which those before have")
        self.following.check(data)
        index = super().extend(data, update_priority=update_priority)
        self.following.keep(data)
        return index

    def _lacking(self, data: Any) -> Any:
        """A key of what is kept that a batch does not have."""
        storage: Any = self.storage
        kept = [*storage._storage.keys(True, True), *(("next", key) for key in storage.images)]
        there = set(data.keys(True, True))
        return next((key for key in kept if key not in there), None)

    def sample(self, batch_size: int | None = None, return_info: bool = False) -> Any:
        batch, info = super().sample(batch_size, return_info=True)
        time, world = info["index"]
        self.complete(batch, time, world, newest_step(self))
        return (batch, info) if return_info else batch

    def complete(
        self, batch: Any, time: torch.Tensor, world: torch.Tensor, newest: int | torch.Tensor
    ) -> None:
        """Adds to windows (B, H) of these times and worlds goals in hindsight, later frames, demonstrations.

        No operation waits for the device.
        """
        storage = cast(Any, self.storage)
        if cast(WindowSampler, self.sampler).burn_in:
            begin_where_repeated(batch, time)
        if self.hindsight is not None:
            self.hindsight(batch, storage._storage, time, world, newest)
        if self.future is not None:
            self.future(batch, storage, time, world, newest)
        if self.demonstrations is not None:
            self.demonstrations(batch)


def begin_where_repeated(batch: Any, time: torch.Tensor) -> None:
    """Marks steps of windows (B, H) as first ones of an episode where the step before them has the same time (B, H).

    There the oldest step stands for those before it.
    """
    batch.get(BOUNDARY)[:, 1:] |= (time[:, 1:] == time[:, :-1]).unsqueeze(-1)


def newest_step(replay: ReplayBuffer) -> int:
    """Time of the step that was written last, in a storage of (time, worlds)."""
    cursor: int = replay.writer._cursor  # type: ignore[union-attr]
    return (cursor - 1) % replay.storage._storage.shape[0]  # type: ignore[union-attr]


def make_replay(
    *,
    capacity: int,
    num_envs: int,
    window: int,
    batch_size: int,
    device: torch.device | str,
    cross_episode: bool = False,
    moved: bool = False,
    burn_in: int = 0,
    frame_stack: int = 1,
    stacked: Sequence[str] = (),
    hindsight: Hindsight | None = None,
    future: FutureFrames | None = None,
    demonstrations: Demonstrations | None = None,
    episode_length: int = 0,
    marks: bool = False,
) -> WindowReplay:
    """A buffer of (time, worlds) that is extended with the collector's (worlds, time) batches.

    Args:
        capacity: Transitions in all; rounded down to a whole number of steps per world.
        num_envs: Worlds.
        window: Transitions per sampled window, H.
        batch_size: Windows per sample.
        device: Where everything lives.
        cross_episode: Windows may go on past the end of an episode, see :class:`WindowSampler`.
        moved: Windows are moved into an episode, see there.
        burn_in: Steps in front of each window, see there.
        frame_stack: Images in each observation under ``stacked``, as ``env.frame_stack``: each is kept once, and
            samples have stacks again.
        stacked: Keys of such observations.
        hindsight: Relabels a share of each batch with goals that were reached later.
        future: Adds frames that were reached later.
        demonstrations: Take the place of a share of each batch.
        episode_length: Steps of an episode, where it is known: windows of more than half of it are seldom whole, so
            more of them must be drawn; and how many last images there is room for at first.
        marks: The data says in which steps contacts were lost, see :class:`WindowSampler`.

    Returns:
        A ``ReplayBuffer`` whose samples have batch size (batch_size, burn_in + window).
    """
    check_whole("num_envs", num_envs)
    check_whole("batch_size", batch_size)
    steps, before = capacity // num_envs, frame_stack - 1 if stacked else 0
    if steps <= window + before:
        raise UserError(
            f"replay capacity {capacity} is {steps} steps for each of {num_envs} worlds, windows have {window}"
            f"{f', and {before} before them' if before else ''}; use at least {num_envs * (window + before + 1)}"
        )
    writer = RoundRobinWriter()
    oversample = WindowSampler.OVERSAMPLE
    if window <= episode_length < 2 * window and not moved:
        oversample = math.ceil(oversample * episode_length / (episode_length - window + 1))
    storage = ImageStorage(
        steps * num_envs,
        episode_length=episode_length,
        frame_stack=frame_stack,
        stacked=stacked if before else (),
        device=device,
    )
    return WindowReplay(
        num_envs=num_envs,
        hindsight=hindsight,
        future=future,
        demonstrations=demonstrations,
        storage=storage,
        sampler=WindowSampler(
            writer,
            length=window,
            oversample=oversample,
            cross_episode=cross_episode,
            moved=moved,
            before=before,
            burn_in=burn_in,
            marks=marks,
        ),
        writer=writer,
        batch_size=batch_size,
        dim_extend=1,
    )
