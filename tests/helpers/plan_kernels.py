"""What tests of the kernels of a plan share: a process that runs them, networks, and who was called.

Triton's interpreter runs kernels on a CPU, in a process that asks for it before Triton is imported.
"""

import os

import pytest
import torch
from torch import nn

from franka_wm.models import fused
from franka_wm.models.tdmpc2 import TDMPC2

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
runs_kernels = pytest.mark.skipif(not INTERPRETED, reason="runs in a process with Triton's interpreter")


def recorded(monkeypatch):
    """Names of the kernels' functions, as they are called."""
    seen = []
    for name in ("linear", "normed_linear", "expectation", "ensemble"):
        plain = getattr(fused, name)
        monkeypatch.setattr(fused, name, lambda *a, _f=plain, _n=name, **k: (seen.append(_n), _f(*a, **k))[1])
    return seen


def shaken(module: nn.Module) -> nn.Module:
    """Other weights than those it begins with, of which some are zero or one."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return module


def model(**options) -> TDMPC2:
    sizes = {"latent_dim": 24, "encoder_dim": 20, "hidden_dim": 40, "episode_length": 50, "num_q": 3}
    made = TDMPC2(action_dim=3, **{"observation_sizes": {"state": 5}, **sizes, **options})
    return shaken(made).eval()  # pyright: ignore[reportReturnType]
