"""A toy world for the models of pictures: a bright dot on a dark square, which an action shifts."""

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from plan_kernels import recorded

SIDE = 16
STEP = 3.0  # pixels at full action


def draw(position: Tensor, side: int = SIDE) -> Tensor:
    """Dots at (..., 2) pixel positions -> pictures (..., side, side, 3) uint8."""
    place = torch.arange(side, dtype=torch.float32)
    dy = (place - position[..., 0:1]).square().unsqueeze(-1)
    dx = (place - position[..., 1:2]).square().unsqueeze(-2)
    bright = 255.0 * torch.exp(-(dy + dx) / (2 * 1.5**2))
    return bright.round().to(torch.uint8).unsqueeze(-1).expand(*bright.shape, 3).contiguous()


def move(position: Tensor, action: Tensor, side: int = SIDE) -> Tensor:
    """Where an action in [-1, 1] takes a dot; it stops at the border."""
    return (position + STEP * action).clamp(2.0, side - 3.0)


def windows(batch: int, horizon: int, side: int = SIDE) -> TensorDict:
    """Random windows [B, H] of pictures, the position as a vector in [-1, 1], and random actions."""
    positions = [2.0 + (side - 5.0) * torch.rand(batch, 2)]
    actions = torch.rand(batch, horizon, 2) * 2 - 1
    for t in range(horizon):
        positions.append(move(positions[-1], actions[:, t], side))
    where = torch.stack(positions, 1)
    pixels, scaled = draw(where, side), where / (side / 2) - 1
    return TensorDict(
        {
            "pixels": pixels[:, :-1],
            "position": scaled[:, :-1],
            "action": actions,
            "next": {
                "pixels": pixels[:, 1:],
                "position": scaled[:, 1:],
                "reward": -scaled[:, 1:].norm(dim=-1, keepdim=True),
                "terminated": torch.zeros(batch, horizon, 1, dtype=torch.bool),
            },
        },
        batch_size=[batch, horizon],
    )


@pytest.fixture(scope="session")
def dots() -> SimpleNamespace:
    """`draw`, `move` and `windows` of the toy world, and its `size` and `side`."""
    return SimpleNamespace(draw=draw, move=move, windows=windows, size=(SIDE, SIDE, 3), side=SIDE)


@pytest.fixture
def seeded() -> None:
    """The same random numbers each time."""
    torch.manual_seed(0)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the functions of `franka_wm.models.fused` that layers call, as they do."""
    return recorded(monkeypatch)
