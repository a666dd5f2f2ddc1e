"""Launches, recorded once and replayed as one graph."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress

import torch
import warp as wp

from franka_wm.errors import UserError

Function = Callable[[], None]
Recording = list[wp.Graph | Function]
"""One graph; on the CPU, where torch cannot be recorded, graphs with functions in torch between them."""


class Recorder:
    """Records what functions launch, and replays it on the stream that torch is using.

    Args:
        device: ``"cpu"`` or ``"cuda:k"``.
    """

    def __init__(self, device: str):
        self.device = wp.get_device(device)
        self._torch = torch.device(device)
        self._pieces: Recording | None = None  # of the recording under way
        # Replays write where torch's operations wrote while they were recorded: nothing else may live there.
        # A pool belongs to the device that is current when it is made.
        with torch.cuda.device(self._torch) if self.device.is_cuda else nullcontext():
            self._pool = torch.cuda.MemPool() if self.device.is_cuda else None
            # Torch has 32 streams and gives them in turn. Products keep scratch memory by stream, and the graphs of
            # several tasks run side by side: with one stream for all graphs of a recorder, fewer recorders share one.
            self._stream = torch.cuda.Stream() if self.device.is_cuda else None

    def record(
        self, launches: Function, keep: Iterable[wp.array], warm_up: Function, restored: Function
    ) -> Recording:
        """Records ``launches``; whatever it does to the arrays in ``keep`` is undone.

        The kernels are compiled, and the solver's buffers allocated, by one run outside the capture, on the
        real arrays; hence the backup.

        Args:
            launches: What to record; it only launches, and calls :meth:`run`.
            keep: Every array that a launch may change and that outlives it.
            warm_up: Called first, so that even what only some steps run is compiled before the capture.
            restored: Called at the end, when the arrays are as they were.
        """
        arrays = [array for array in keep if array is not None and array.size]
        backup = [wp.clone(array) for array in arrays]
        with self._one_stream():
            warm_up()
            launches()
            recording = self._capture(launches)
            for array, copy in zip(arrays, backup, strict=True):
                wp.copy(array, copy)
            restored()
        return recording

    def run(self, function: Function) -> None:
        """Calls a function in torch among launches: on CUDA it is recorded, on the CPU called in every replay.

        Raises:
            UserError: It cannot be recorded.
        """
        if self._pieces is None:  # nothing is recorded yet
            function()
        elif self.device.is_cuda:
            try:
                function()
            except RuntimeError as error:
                raise UserError(
                    f"{error}: on a GPU a task in torch must not wait for the device (.item(), if) or copy from the "
                    "host (torch.tensor)"
                ) from error
        else:
            self._pieces += [wp.capture_end(self.device), function]
            wp.capture_begin(self.device)

    def replay(self, recording: Recording) -> None:
        """Runs what was recorded once; no host sync."""
        # Warp's own stream does not wait for torch's: launch on the one torch is using.
        stream = wp.stream_from_torch(torch.cuda.current_stream(self._torch)) if self.device.is_cuda else None
        for piece in recording:
            if isinstance(piece, wp.Graph):
                wp.capture_launch(piece, stream=stream)
            else:
                piece()

    def on_stream_of_torch(self) -> AbstractContextManager:
        """Warp launches inside in the order of torch's own work."""
        if not self.device.is_cuda:
            return wp.ScopedDevice(self.device)
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self._torch)))

    @contextmanager
    def _one_stream(self) -> Iterator[None]:
        """Torch and Warp on one stream that can be captured, after and before everything else on the device."""
        if not self.device.is_cuda:
            with wp.ScopedDevice(self.device):
                yield
            return
        torch.cuda.synchronize(self._torch)
        with torch.cuda.stream(self._stream), self.on_stream_of_torch():
            yield
        wp.synchronize_device(self.device)

    def _capture(self, launches: Function) -> Recording:
        self._pieces = pieces = []
        with (
            torch.cuda.use_mem_pool(self._pool, self._torch) if self._pool else nullcontext(),
            _no_collection(),
        ):
            wp.capture_begin(self.device)
            try:
                launches()
            except BaseException:
                self._pieces = None
                with suppress(
                    RuntimeError
                ):  # a broken capture ends with an error; what broke it is to be told
                    wp.capture_end(self.device)
                raise
            self._pieces = None
            return [*pieces, wp.capture_end(self.device)]


@contextmanager
def _no_collection() -> Iterator[None]:
    """Garbage stays: a memory pool of torch's that is freed while something is captured aborts the process."""
    on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()
