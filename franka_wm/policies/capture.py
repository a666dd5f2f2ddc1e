"""A decision as one CUDA graph: planning is thousands of small operations, and launching them takes the time."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from contextlib import suppress
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase

from franka_wm.errors import CaptureError

Work = Callable[[TensorDictBase], TensorDict]
"""Entries in, entries out: tensors of fixed shapes, nothing read back by the host."""


class _Graph(NamedTuple):
    graph: torch.cuda.CUDAGraph
    inputs: TensorDict
    outputs: TensorDict
    held: tuple[object, ...]


class GraphCache:
    """Calls work eagerly at first, then as a CUDA graph, one for each kind of input.

    A graph repeats the very operations on the very memory that it was captured with. So weights must be changed in
    place, as optimisers do, and what else decides on the operations (settings, modes) belongs into `key`. Work that
    reads values on the host cannot be captured.

    Noise of the default generator goes on from where it stands, and follows `torch.manual_seed`, in a graph too.

    Args:
        keep: how many graphs are kept; the one not used for longest goes first.
    """

    EAGER_CALLS = 2
    """Before the capture: they let libraries allocate what a graph may not."""

    def __init__(self, keep: int = 8) -> None:
        self.keep = keep
        self._seen: dict[
            Hashable, tuple[int, tuple[object, ...]]
        ] = {}  # with what is held: its ids stay its own
        self._graphs: OrderedDict[Hashable, _Graph] = OrderedDict()

    def __call__(
        self,
        work: Work,
        inputs: TensorDictBase,
        *,
        key: Hashable = None,
        held: tuple[object, ...] = (),
    ) -> TensorDict:
        """`work(inputs)`; from the third call of a kind on, by replaying a graph.

        Args:
            inputs: on a CUDA device; names, shapes and dtypes are part of the kind.
            key: what else is.
            held: objects that the graph reads from: the same objects are part of the kind, and are kept alive.

        Returns:
            Entries of their own memory: the next call does not overwrite them.

        Raises:
            CaptureError: the work cannot be captured.
        """
        shapes = tuple(
            (name, tuple(x.shape), x.dtype)
            for name, x in sorted(inputs.items(), key=lambda item: str(item[0]))
        )
        kind = (key, tuple(id(one) for one in held), shapes, _device(inputs))
        found = self._graphs.get(kind)
        if found is None:
            seen, _ = self._seen.get(kind, (0, ()))
            if seen < self.EAGER_CALLS:
                if len(self._seen) > 64:  # kinds that came once and never again
                    self._seen.clear()
                self._seen[kind] = seen + 1, held
                return _beside(work, inputs)
            found = self._graphs[kind] = _record(work, inputs, held)
            del self._seen[kind]
            while len(self._graphs) > self.keep:
                self._graphs.popitem(last=False)
        else:
            self._graphs.move_to_end(kind)
            for name, static in found.inputs.items():
                static.copy_(inputs.get(name))
        with torch.cuda.device(_device(inputs)):
            found.graph.replay()
        return found.outputs.clone()

    # A graph belongs to its process and its memory.
    def __deepcopy__(self, memo: dict[int, object]) -> GraphCache:
        return GraphCache(self.keep)

    def __reduce__(self) -> tuple[object, ...]:
        return GraphCache, (self.keep,)


def _beside(work: Work, inputs: TensorDictBase) -> TensorDict:
    """`work(inputs)` on a stream of its own, as the capture will be."""
    with torch.cuda.device(_device(inputs)):
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            outputs = work(inputs)
        torch.cuda.current_stream().wait_stream(stream)
    return outputs


def _device(inputs: TensorDictBase) -> torch.device:
    return next(iter(inputs.values())).device


def _record(work: Work, inputs: TensorDictBase, held: tuple[object, ...]) -> _Graph:
    static = TensorDict({name: x.clone() for name, x in inputs.items()}, batch_size=inputs.batch_size)
    graph, pool = torch.cuda.CUDAGraph(), torch.cuda.graph_pool_handle()
    device = _device(static)
    generator = torch.cuda.default_generators[device.index or 0]
    noise = generator.get_state()
    try:
        # Other threads (a live page, a data loader) may allocate meanwhile.
        with torch.cuda.device(device), torch.cuda.graph(graph, pool, capture_error_mode="thread_local"):
            outputs = work(static)
    except RuntimeError as error:
        # A capture that could not be ended goes on taking memory from its pool, which nobody frees.
        with suppress(RuntimeError):
            torch._C._cuda_endAllocateToPool(device.index or 0, pool)  # pyright: ignore[reportAttributeAccessIssue]
        # The generator believes that it is still being captured, and would refuse to draw from now on.
        fresh = torch.Generator(device)
        fresh.set_state(noise)
        generator.graphsafe_set_state(fresh.graphsafe_get_state())
        if isinstance(error, torch.OutOfMemoryError):
            raise
        raise CaptureError(
            "this decision cannot be captured as a CUDA graph, because something in it waits for the device or copies "
            f"from the host; mend it, or give capture=False (train.py: trainer.capture=false): {error}"
        ) from error
    return _Graph(graph, static, outputs, held)
