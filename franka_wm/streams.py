"""Parts of one computation that run at the same time on a GPU."""

from __future__ import annotations

from types import TracebackType

import torch
from torch import Tensor

_STREAMS: dict[tuple[torch.device, int], torch.cuda.Stream] = {}


class side_stream:
    """Launch what runs inside on another CUDA stream, at the same time as what follows. Off CUDA it does nothing.

    Small matrix products leave most of a large GPU idle, so independent parts may share it. In a captured graph such
    parts are branches. The backward pass of each part runs on its own stream, too::

        with side_stream(x) as part:
            y = f(x)
        z = g(x)
        part.join(y)
        return y + z

    Args:
        *inputs: tensors from outside that are read inside. Their memory is not used again before that.
        lane: number of the stream. Parts that are open at the same time need lanes of their own.
    """

    def __init__(self, *inputs: Tensor, lane: int = 0) -> None:
        self.inputs, self.lane = inputs, lane
        self.stream: torch.cuda.Stream | None = None

    def __enter__(self) -> side_stream:
        if torch.compiler.is_compiling() or self.inputs[0].device.type != "cuda":
            return self
        device = self.inputs[0].device
        if (device, self.lane) not in _STREAMS:
            _STREAMS[device, self.lane] = torch.cuda.Stream(device)
            # Parts share parameters. Autograd sums their gradients on one stream and waits for the others.
            torch.autograd.graph.set_warn_on_accumulate_grad_stream_mismatch(False)
        self.stream = _STREAMS[device, self.lane]
        self.outside = torch.cuda.current_stream(device)
        self.stream.wait_stream(self.outside)
        for tensor in self.inputs:
            tensor.record_stream(self.stream)
        self.context = torch.cuda.stream(self.stream)
        self.context.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.stream is not None:
            self.context.__exit__(kind, error, trace)

    def join(self, *outputs: Tensor) -> None:
        """Let what follows wait for the part; it may then read `outputs`, which the part made."""
        if self.stream is None:
            return
        self.outside.wait_stream(self.stream)
        for tensor in outputs:
            tensor.record_stream(self.outside)
