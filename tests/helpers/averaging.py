"""What two processes find out about the averaging of gradients; `tests/processes/test_gradients.py` reads it."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from torch import distributed, nn

from franka_wm import processes

LAYERS, SIZE = 5, 8


def averaged(folder: Path) -> None:
    """What one process does: four backward passes, in the third of which a layer does not learn."""
    distributed.init_process_group("gloo")
    rank = processes.rank()
    processes.GradientAverage.MESSAGE = 2 * 4 * SIZE * SIZE  # two layers
    torch.manual_seed(0)
    layers = [nn.Linear(SIZE, SIZE, bias=False) for _ in range(LAYERS)]
    weights = [layer.weight for layer in layers]
    average = processes.GradientAverage(weights)
    torch.manual_seed(1 + rank)
    passes = []
    for k in range(4):
        learning = [layer for j, layer in enumerate(layers) if k != 2 or j != 1]
        for weight in weights:
            weight.grad = None
        loss = nn.Sequential(*learning)(torch.randn(3, SIZE)).square().mean()
        own = torch.autograd.grad(loss, [layer.weight for layer in learning], retain_graph=True)
        average.begin()
        loss.backward()
        started = average.started
        average.finish()
        wanted = [torch.stack(both).mean(0) for both in zip(*processes.objects(own), strict=True)]
        found = [layer.weight.grad for layer in learning]
        same = all(
            torch.allclose(x, y, rtol=1e-5, atol=0)
            for x, y in zip(found, wanted, strict=True)
            if x is not None
        )
        idle = [weight.grad is None for weight in weights].count(True)
        passes.append({"started": started, "same": same, "idle": idle})
    before = [x.grad.clone() for x in weights if x.grad is not None]
    nn.Sequential(*layers)(torch.randn(3, SIZE)).sum().backward()  # of something that only looks on
    alone = [not torch.equal(x.grad, y) for x, y in zip(weights, before, strict=True) if x.grad is not None]
    found = processes.objects({"passes": passes, "outside": average.started, "alone": all(alone)})
    if rank == 0:
        (folder / "found.json").write_text(json.dumps(found))
    processes.leave()
