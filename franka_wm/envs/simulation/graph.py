"""Launches, recorded once and replayed as one graph."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager

import torch
import warp as wp


class Recorder:
    """Records what functions launch, and replays it on the stream that torch is using.

    Args:
        device: ``"cpu"`` or ``"cuda:k"``.
    """

    def __init__(self, device: str):
        self.device = wp.get_device(device)
        self._torch = torch.device(device)

    def record(
        self,
        launches: Callable[[], None],
        keep: Iterable[wp.array],
        warm_up: Callable[[], None],
        restored: Callable[[], None],
    ) -> wp.Graph:
        """Records ``launches``; whatever it does to the arrays in ``keep`` is undone.

        The kernels are compiled, and the solver's buffers allocated, by one run outside the capture, on the
        real arrays; hence the backup.

        Args:
            launches: What to record; it only launches.
            keep: Every array that a launch may change and that outlives it.
            warm_up: Called first, so that even what only some steps run is compiled before the capture.
            restored: Called at the end, when the arrays are as they were.
        """
        arrays = [array for array in keep if array is not None and array.size]
        backup = [wp.clone(array) for array in arrays]
        with wp.ScopedDevice(self.device):
            if self.device.is_cuda:
                torch.cuda.synchronize(self._torch)
            warm_up()
            launches()
            with wp.ScopedCapture(device=self.device) as capture:
                launches()
            for array, copy in zip(arrays, backup, strict=True):
                wp.copy(array, copy)
            restored()
            if self.device.is_cuda:
                wp.synchronize_device(self.device)
        assert capture.graph is not None
        return capture.graph

    def replay(self, graph: wp.Graph) -> None:
        """Runs the graph once; no host sync."""
        if self.device.is_cuda:
            # Warp's own stream does not wait for torch's: launch on the one torch is using.
            wp.capture_launch(graph, stream=wp.stream_from_torch(torch.cuda.current_stream(self._torch)))
        else:
            wp.capture_launch(graph)

    def on_stream_of_torch(self) -> AbstractContextManager:
        """Warp launches inside in the order of torch's own work."""
        if not self.device.is_cuda:
            return wp.ScopedDevice(self.device)
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self._torch)))
