"""Seeds that never meet: each purpose of a run draws from its own."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import nn

from franka_wm import processes


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
    """Seed that a run's evaluation worlds start with, before anybody plays in them.

    Held-out episodes are those of `franka_wm.evaluation.protocol.held_out_seeds`, the same for every run.
    """
    return derive_seed("evaluation", seed)


@contextmanager
def seeded(seed: int, *policies: Any) -> Iterator[None]:
    """Random numbers of torch, NumPy and Python, and of the policies' own generators, from ``seed``.

    All go on afterwards as if nothing had been drawn; nothing waits for the device.
    """
    devices = list(range(torch.cuda.device_count())) if torch.cuda.is_initialized() else []
    others = random.getstate(), np.random.get_state()
    parts = [p for one in policies for p in (one.modules() if isinstance(one, nn.Module) else (one,))]
    held = [value for part in parts for value in getattr(part, "__dict__", {}).values()]
    generators = [(value, value.get_state()) for value in held if isinstance(value, torch.Generator)]
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(seed)
        random.seed(seed)
        np.random.seed(seed)
        for generator, _ in generators:
            generator.manual_seed(seed)
        try:
            yield
        finally:
            random.setstate(others[0])
            np.random.set_state(others[1])
            for generator, state in generators:
                generator.set_state(state)


_share: tuple[int, int, int] | None = None


def share_of_worlds() -> tuple[int, int, int] | None:
    """First, count and whole of :func:`drawing_for`; a captured graph that draws depends on them."""
    return _share


@contextmanager
def drawing_for(first: int, count: int, whole: int) -> Iterator[None]:
    """Inside, :func:`of_worlds` gives ``count`` worlds, from number ``first``, their part of what ``whole`` draw.

    So a world acts upon the same random numbers, however many processes play the others.
    """
    global _share
    before, _share = _share, (first, count, whole)
    try:
        yield
    finally:
        _share = before


def of_worlds(draw: Callable[[tuple[int, ...]], torch.Tensor], shape: Sequence[int]) -> torch.Tensor:
    """Random numbers (worlds, …), or (worlds × n, …), by which these worlds act: ``draw(shape)``.

    Where the worlds of an evaluation are divided, all are drawn, of which these worlds' are kept.
    """
    if _share is None or _share[1] == _share[2]:
        return draw(tuple(shape))
    first, count, whole = _share
    each = shape[0] // count
    return draw((each * whole, *shape[1:]))[each * first : each * (first + count)]


def normal_like(x: torch.Tensor) -> torch.Tensor:
    """Normal numbers of the shape, type and device of ``x`` (worlds, …), as :func:`of_worlds` gives them."""
    return of_worlds(lambda shape: torch.randn(shape, dtype=x.dtype, device=x.device), x.shape)


def restore_generator(generator: torch.Generator, state: torch.Tensor) -> bool:
    """Puts a generator where ``state`` was taken; ``False`` where that was another kind of device's."""
    if state.shape != generator.get_state().shape:
        return False
    generator.set_state(state)
    return True


def random_state() -> dict[str, object]:
    """The global generators of torch (CPU and CUDA), NumPy and Python; of several processes, each has one GPU."""
    return {
        "torch": torch.get_rng_state(),
        # Asking for it would start CUDA in a process that has not used it.
        "cuda": [torch.cuda.get_rng_state(k) for k in _own_gpus()] if torch.cuda.is_initialized() else [],
        "numpy": np.random.get_state(legacy=True),
        "python": random.getstate(),
    }


def restore_random_state(state: Mapping[str, Any]) -> None:
    """Puts the generators where :func:`random_state` found them; those of the GPUs that are there."""
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    torch.set_rng_state(state["torch"])
    if torch.cuda.is_available():
        for device, one in zip(_own_gpus(), state["cuda"], strict=False):
            torch.cuda.set_rng_state(one, device)


def _own_gpus() -> list[int]:
    several = processes.count() > 1
    return [torch.cuda.current_device()] if several else list(range(torch.cuda.device_count()))
