"""Parts of one computation that run at the same time on a GPU."""

from __future__ import annotations

from types import TracebackType

import torch
from torch import Tensor

_LANES: dict[tuple[torch.device, int], torch.cuda.Stream] = {}


class beside:
    """What runs inside is launched on another CUDA stream, beside what follows. Off CUDA nothing is different.

    Small products of matrices leave most of a large GPU idle, and what does not depend on each other may share it. In
    a captured graph such parts are branches. The backward pass of each part runs on its own stream, too::

        with beside(x) as part:
            y = f(x)
        z = g(x)
        part.join(y)
        return y + z

    Args:
        *inputs: tensors from outside that are read inside. Their memory is not used again before that.
        lane: parts that are open at the same time need lanes of their own.
    """

    def __init__(self, *inputs: Tensor, lane: int = 0) -> None:
        self.inputs, self.lane = inputs, lane
        self.stream: torch.cuda.Stream | None = None

    def __enter__(self) -> beside:
        if torch.compiler.is_compiling() or self.inputs[0].device.type != "cuda":
            return self
        device = self.inputs[0].device
        if (device, self.lane) not in _LANES:
            _LANES[device, self.lane] = torch.cuda.Stream(device)
            # Parts share parameters, whose gradients are summed on one stream: meant, and waited for by autograd.
            torch.autograd.graph.set_warn_on_accumulate_grad_stream_mismatch(False)
        self.stream = _LANES[device, self.lane]
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
        """What follows waits for the part, and may read `outputs`, which it made."""
        if self.stream is None:
            return
        self.outside.wait_stream(self.stream)
        for tensor in outputs:
            tensor.record_stream(self.outside)
