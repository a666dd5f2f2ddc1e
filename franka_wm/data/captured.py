"""A batch of windows as one CUDA graph: drawing and gathering it is dozens of small operations."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer

from franka_wm.data.replay import WindowReplay, WindowSampler, newest_step


class CapturedSampling:
    """Calls give a batch of a replay buffer's windows: eagerly at first, then by replaying one CUDA graph.

    The distribution is :class:`~franka_wm.data.replay.WindowSampler`'s; where the present experience begins and ends is
    read from the device by the graph and written before each replay, so the buffer may grow and wrap around.

    A captured batch lies in the same memory in every call: the next one overwrites it.

    Args:
        replay: From :func:`~franka_wm.data.replay.make_replay`, on a CUDA device.
    """

    EAGER_CALLS = 2
    """Before the capture: they let libraries allocate what a graph may not."""

    def __init__(self, replay: ReplayBuffer):
        self.replay = replay
        self._calls = 0
        self._memory: tuple[int, ...] | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._batch: TensorDictBase | None = None
        self._crossing: torch.Tensor | None = None

    def __call__(self) -> TensorDictBase:
        """A batch of batch size (batch_size, burn_in + length); no host sync.

        Raises:
            UserError: There are fewer steps than a window has.
        """
        storage: Any = self.replay.storage
        sampler = self.replay.sampler
        assert isinstance(sampler, WindowSampler)
        span, oldest = sampler.bounds(storage)
        data = storage._storage
        if (memory := storage.memory) != self._memory:
            self._choices = torch.ones((), dtype=torch.float64, device=data.device)
            self._oldest = torch.zeros((), dtype=torch.int64, device=data.device)
            self._newest = torch.zeros((), dtype=torch.int64, device=data.device)
            self._memory, self._graph = memory, None
        self._choices.fill_(span * data.shape[1])
        self._oldest.fill_(oldest)
        self._newest.fill_(newest_step(self.replay))
        if self._graph is None and self._calls >= self.EAGER_CALLS:
            self._graph = self._record(data, sampler)
        self._calls += 1
        if (
            self._graph is None
        ):  # by the same draws as the graph's: a resumed run, eager again, gets the same batches
            self._draw(data, sampler)
        else:
            self._graph.replay()
        assert self._batch is not None
        if self._crossing is not None:
            sampler.record_missing(self._crossing)
        return self._batch

    def is_static(self, batch: TensorDictBase) -> bool:
        """Whether later batches will lie in the memory of this one."""
        return self._graph is not None and batch is self._batch

    def _record(self, data: object, sampler: WindowSampler) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self._draw(data, sampler)
        return graph

    def _draw(self, data: Any, sampler: WindowSampler) -> None:
        """Draws a batch; everything that changes from call to call is read from tensors."""
        size = self.replay._batch_size
        assert size is not None
        uniform = torch.rand(sampler.candidates(size), dtype=torch.float64, device=data.device)
        # The largest product rounds up to the number of choices itself for huge buffers only; hence the bound.
        draw = torch.minimum(uniform * self._choices, self._choices - 1.0).long()
        time, world, crossing = sampler.choose(data, draw, self._oldest, self._choices / data.shape[1], size)
        storage: Any = self.replay.storage
        self._batch = storage.windows(time, world)
        if isinstance(self.replay, WindowReplay):
            self.replay.complete(self._batch, time, world, self._newest)
        self._crossing = crossing
