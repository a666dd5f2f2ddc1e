"""One gradient update: loss, backward, clip, optimiser, targets; on CUDA as one captured graph."""

from __future__ import annotations

import math
from contextlib import nullcontext
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torch import nn

from franka_wm import processes
from franka_wm.console import announced
from franka_wm.errors import UserError
from franka_wm.models.check import check_groups, check_losses
from franka_wm.models.precision import lowered
from franka_wm.options import PRECISIONS
from franka_wm.training.settings.groups import SCHEDULES

if TYPE_CHECKING:
    from franka_wm.models.base import WorldModel


class Learner:
    """Updates a world model from windows of experience.

    The model gives ``loss(batch)``, ``parameter_groups(lr)`` (each with a ``clip`` group) and
    ``after_update()``; the learner knows nothing of its family. Nothing in :meth:`update` waits for the
    device: metrics are summed there and read by :meth:`metrics`.

    On CUDA, the first updates run eagerly, then the whole update (loss, backward, gradient clipping, Adam,
    target networks) is captured once and replayed; only the batch is copied into fixed tensors.

    Under several processes each has a part of the batch; their gradients are averaged inside the update.

    Args:
        model: On its device.
        lr: Learning rate.
        grad_clip: Largest gradient norm of each clip group; the norm before clipping is a metric.
        capture: Capture the update as a CUDA graph; ``None``: on CUDA.
        compile: Compile the loss with ``torch.compile`` first; takes a minute at the start.
        precision: ``float32``, or ``bfloat16``: the loss runs under autocast, weights and optimiser stay float32.
        schedule: ``constant``, or ``cosine``: down to zero at ``total_updates``.
        warmup: Updates over which the learning rate rises from zero.
        total_updates: Updates of the whole run; needed by ``cosine``.
    """

    EAGER_UPDATES = 4
    """Before the capture: they let cuBLAS, autograd and the optimiser allocate what a graph may not."""

    def __init__(
        self,
        model: WorldModel,
        *,
        lr: float = 3e-4,
        grad_clip: float = 20.0,
        capture: bool | None = None,
        compile: bool = False,
        precision: str = "float32",
        schedule: str = "constant",
        warmup: int = 0,
        total_updates: int | None = None,
    ):
        if precision not in PRECISIONS:
            raise UserError(f"precision={precision!r}: must be one of {', '.join(PRECISIONS)}")
        if schedule not in SCHEDULES:
            raise UserError(f"schedule={schedule!r}: must be one of {', '.join(SCHEDULES)}")
        if schedule == "cosine" and total_updates is None:
            raise UserError("schedule=cosine needs total_updates, at whose end the learning rate is zero")
        if not lr > 0 or not grad_clip > 0:
            raise UserError(f"lr={lr}, grad_clip={grad_clip}: both must be above 0")
        groups = check_groups(model, model.parameter_groups(lr))
        self.model = model
        self.device = next(model.parameters()).device
        on_cuda = self.device.type == "cuda"
        self.capture = on_cuda if capture is None else capture
        if self.capture and not on_cuda:
            raise UserError(
                "capture=true needs device=cuda; leave it at null to capture where it is possible"
            )
        self.lr, self.grad_clip = lr, grad_clip
        with torch.no_grad():
            for x in model.state_dict().values():
                if isinstance(x, torch.Tensor):
                    processes.broadcast(x)
        self._clip_groups: dict[str, list[nn.Parameter]] = {}
        for group in groups:
            self._clip_groups.setdefault(group.get("clip", "model"), []).extend(group["params"])
        self.schedule, self.warmup, self.total_updates = schedule, warmup, total_updates
        self._scheduled = schedule != "constant" or warmup > 0
        if self._scheduled and on_cuda:  # a captured graph must read the present rate, not the first
            for group in groups:
                group["lr"] = torch.tensor(float(group.get("lr", lr)), device=self.device)
        # Without weight decay, the default of every group, AdamW is Adam.
        self.optimizer = torch.optim.AdamW(groups, lr=lr, weight_decay=0.0, fused=True, capturable=on_cuda)
        self.rates = [float(group["lr"]) for group in self.optimizer.param_groups]
        self.precision = precision
        self._loss = model.compiled_loss() if compile else model.loss
        self._compiled = compile
        self.updates = 0
        self._names: list[str] = []
        self._sums: torch.Tensor | None = None
        self._summed = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._batch: TensorDictBase | None = None
        self._seen = 0

    def update(self, batch: TensorDictBase, *, static: bool = False) -> None:
        """One update from ``batch`` of batch size (B, H); no host sync.

        Args:
            static: Every batch lies in the memory of this one: a captured update reads it there.
        """
        if self._scheduled:
            self._set_rates()
        if self.capture:
            batch = self._kept(batch, static)
        if self._graph is None and self.capture and self._seen >= self.EAGER_UPDATES:
            self._record(batch)
        if self._graph is not None:
            self._graph.replay()
        else:
            compiles = self._compiled and not self._seen
            with announced("compiling the loss") if compiles else nullcontext():
                self._warm_up(batch)
        self._seen += 1
        self._summed += 1
        self.updates += 1

    def _warm_up(self, batch: TensorDictBase) -> None:
        """An update that is not captured, on the kind of stream that a capture will use."""
        self.optimizer.zero_grad(set_to_none=True)
        if not self.capture:
            return self._eager(batch)
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            self._eager(batch)
        torch.cuda.current_stream().wait_stream(stream)

    def rate(self, update: int) -> float:
        """The learning rate at an update, relative to the one given."""
        factor = min(1.0, (update + 1) / self.warmup) if self.warmup else 1.0
        if self.schedule == "cosine":
            assert self.total_updates is not None
            past = max(0, update - self.warmup) / max(1, self.total_updates - self.warmup)
            factor *= 0.5 * (1.0 + math.cos(math.pi * min(1.0, past)))
        return factor

    def use_rates(self) -> None:
        """Goes back to the learning rates that were asked for, after an optimiser's state was loaded.

        A schedule sets them at every update anyway.
        """
        if self._scheduled:
            return
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            if isinstance(group["lr"], torch.Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    def _set_rates(self) -> None:
        factor = self.rate(self.updates)
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            if isinstance(group["lr"], torch.Tensor):
                group["lr"].fill_(rate * factor)
            else:
                group["lr"] = rate * factor

    def metrics(self) -> dict[str, float]:
        """Means of losses and gradient norms since the last call, over all processes; one host sync."""
        if self._sums is None or not self._summed:
            return {}
        values = processes.mean(self._sums / self._summed).tolist()
        self._sums.zero_()
        self._summed = 0
        return dict(zip(self._names, values, strict=True))

    def broken(self) -> list[str]:
        """What was not finite since the last :meth:`metrics`: the loss, norms of gradients; one host sync."""
        if self._sums is None:
            return []
        finite = dict(zip(self._names, self._sums.isfinite().tolist(), strict=True))
        return [name for name, fine in finite.items() if not fine and name.startswith(("loss", "grad_norm_"))]

    def _eager(self, batch: TensorDictBase) -> None:
        low = self.precision == "bfloat16"
        # No cache of cast weights: it would hold tensors of one captured update into the next.
        casts = torch.autocast(self.device.type, torch.bfloat16, enabled=low, cache_enabled=False)
        with casts, lowered(self.model, torch.bfloat16) if low else nullcontext():
            losses = self._loss(batch)
        check_losses(self.model, losses)
        losses.get("loss").backward()
        processes.average_gradients(p for group in self._clip_groups.values() for p in group)
        values = {name: value for name, value in losses.items()}
        for name, parameters in self._clip_groups.items():
            values[f"grad_norm_{name}"] = nn.utils.clip_grad_norm_(parameters, self.grad_clip, foreach=True)
        self.optimizer.step()
        self.model.after_update()
        with torch.no_grad():
            row = torch.stack([value.detach().float().reshape(()) for value in values.values()])
            if self._sums is None:
                self._names = list(values)
                self._sums = torch.zeros_like(row)
            self._sums += row

    def _kept(self, batch: TensorDictBase, static: bool) -> TensorDictBase:
        """The batch in the memory that a captured update reads.

        Updates before it read it, too: a compiled loss is compiled again for other strides, which no capture allows.
        """
        if static and batch is not self._batch:  # what was captured reads the memory of before
            self._batch, self._graph = batch, None
        elif self._batch is None:
            self._batch = batch.clone()
        elif batch is not self._batch:
            self._batch.update_(batch.select(*self._batch.keys(True, True)))
        return self._batch

    def _record(self, batch: TensorDictBase) -> None:
        """Captures the update. Capturing runs nothing, so no update is lost or counted twice."""
        self.optimizer.zero_grad(set_to_none=True)
        graph = torch.cuda.CUDAGraph()
        # NCCL has a thread of its own, which looks after it meanwhile.
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self._eager(batch)
        self._graph = graph
