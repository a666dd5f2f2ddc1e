"""A small model with every kind of state, and checkpoints of it."""

from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictParams
from torch import Tensor, nn

from franka_wm.training.checkpoint import save_checkpoint


class Small(nn.Module):
    """Weights, a buffer, a tied weight, an integer buffer, and a TensorDict of parameters."""

    def __init__(self, hidden: int = 16) -> None:
        super().__init__()
        self.first = nn.Linear(20, hidden)
        self.norm = nn.BatchNorm1d(hidden)
        self.second = nn.Linear(hidden, hidden)
        self.tied = nn.Linear(hidden, hidden, bias=False)
        self.tied.weight = self.second.weight
        heads = TensorDict(
            {"q": {"weight": torch.randn(5, hidden)}, "bias": torch.zeros(5, 1)}, batch_size=[5]
        )
        self.heads = TensorDictParams(heads)

    def forward(self, x: Tensor) -> Tensor:
        """(B, 20) -> (B, 5)"""
        h = self.tied(self.second(torch.relu(self.norm(self.first(x)))))
        return h @ self.heads["q", "weight"].T + self.heads["bias"].T


def train(model: nn.Module, optimizer: torch.optim.Optimizer, steps: int) -> None:
    """A few updates whose data comes from the global generator, so that RNG state matters too."""
    device = next(model.parameters()).device
    for _ in range(steps):
        optimizer.zero_grad()
        model(torch.randn(8, 20).to(device)).square().mean().backward()
        optimizer.step()


def save(folder: Path, model: nn.Module | None = None, *, step: int = 0, **others) -> Path:
    return save_checkpoint(
        folder,
        model=Small() if model is None else model,
        config={"env": {"name": "reach"}, "seed": 3},
        counters={"env_steps": step},
        **others,
    )


def some_replay() -> TensorDict:
    return TensorDict(
        {
            "state": torch.randn(6, 4, 20),
            "pixels": torch.randint(0, 256, (6, 4, 8, 8, 3), dtype=torch.uint8),
            "half": torch.randn(6, 4, 2).bfloat16(),
            "next": {"done": torch.rand(6, 4, 1) > 0.5, "stats": {"length": torch.arange(24).view(6, 4, 1)}},
        },
        batch_size=[6, 4],
    )
