"""Seeds that never meet: each purpose of a run draws from its own."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import nn


def derive_seed(purpose: str, seed: int, *parts: int | str) -> int:
    """Seed of one purpose, from a run's seed, by hashing.

    Arithmetic (`seed + steps`) can meet the seed of another purpose or another run; a hash of what the numbers are for
    cannot, but for chance (1 in 2³¹).

    Args:
        purpose: What the numbers are for: `evaluation`, `training`, `policy`, …
        seed: The run's.
        parts: What else tells draws of this purpose apart: a rank, a count of resumes, a policy's name.

    Returns:
        A whole number in [0, 2³¹), which Warp, NumPy and torch all take.
    """
    text = "\x1f".join([purpose, str(int(seed)), *map(str, parts)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") & 0x7FFF_FFFF


def evaluation_seed(seed: int) -> int:
    """Seed of the held-out episodes of the run with this seed: worlds and goals are not those of its training."""
    return derive_seed("evaluation", seed)


@contextmanager
def seeded(seed: int, *policies: Any) -> Iterator[None]:
    """Random numbers of torch, NumPy and Python, and of the policies' own generators, from ``seed``.

    The global ones of torch (CPU and CUDA), NumPy and Python go on afterwards as if nothing had been drawn; nothing
    waits for the device.
    """
    devices = list(range(torch.cuda.device_count())) if torch.cuda.is_initialized() else []
    others = random.getstate(), np.random.get_state()
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(seed)
        random.seed(seed)
        np.random.seed(seed)
        for policy in policies:
            for module in policy.modules() if isinstance(policy, nn.Module) else (policy,):
                for value in vars(module).values() if hasattr(module, "__dict__") else ():
                    if isinstance(value, torch.Generator):
                        value.manual_seed(seed)
        try:
            yield
        finally:
            random.setstate(others[0])
            np.random.set_state(others[1])
