"""Seeds by purpose."""

import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from franka_wm import models
from franka_wm.models.layers import GaussianPolicy
from franka_wm.policies.scripted import RandomDiscretePolicy, SmoothRandomPolicy
from franka_wm.seeding import (
    derive_seed,
    drawing_for,
    evaluation_seed,
    restore_generator,
    seeded,
    share_of_worlds,
)


def test_the_same_purpose_and_seed_give_the_same_number_in_every_process():
    assert derive_seed("evaluation", 0) == 1277629110


def test_purposes_seeds_and_parts_are_told_apart():
    asked = [
        (p, s, *more) for p in ("a", "b") for s in range(50) for more in ((), (1,), ("1x",), (1, 2), (12,))
    ]
    assert len({derive_seed(*one) for one in asked}) == len(asked)


def test_every_seed_fits_into_31_bits():
    seeds = [derive_seed("training", seed) for seed in range(1000)]
    assert all(0 <= seed < 2**31 for seed in seeds)
    every = 0
    for seed in seeds:
        every |= seed
    assert every == 2**31 - 1  # and every bit is used


class Draws:
    """A policy of one's own, with a generator of its own."""

    def __init__(self) -> None:
        self.generator = torch.Generator().manual_seed(77)


class Modules(nn.Module):
    """A policy whose part has the generator."""

    def __init__(self) -> None:
        super().__init__()
        self.part = nn.Linear(1, 1)
        self.part.generator = torch.Generator().manual_seed(78)  # pyright: ignore[reportArgumentType]


def drawn(*generators: torch.Generator) -> list[float]:
    """A number of every source."""
    own = [torch.rand(1, generator=generator).item() for generator in generators]
    return [torch.rand(1).item(), random.random(), np.random.rand(), *own]


def test_what_is_seeded_repeats_and_leaves_no_trace() -> None:
    """The numbers after are those that would have come without; also where the work inside failed."""
    plain, module = Draws(), Modules()
    own = plain.generator, module.part.generator
    for source in (torch.manual_seed, random.seed, np.random.seed):
        source(5)
    expected = [drawn(*own) for _ in range(3)]
    for source in (torch.manual_seed, random.seed, np.random.seed):
        source(5)
    for generator, seed in zip(own, (77, 78), strict=True):
        generator.manual_seed(seed)

    assert drawn(*own) == expected[0]
    inside = []
    for seed in (3, 3, 4):
        with seeded(seed, plain, module, lambda observation: observation):
            inside.append(drawn(*own))
    assert inside[0] == inside[1] and not set(inside[0]) & set(inside[2])
    assert drawn(*own) == expected[1]
    with pytest.raises(KeyError), seeded(3, plain, module):
        drawn(*own)
        raise KeyError
    assert drawn(*own) == expected[2]


def test_the_seed_of_the_evaluation_is_that_of_its_purpose() -> None:
    assert evaluation_seed(4) == derive_seed("evaluation", 4)


def test_a_generator_of_another_kind_of_device_is_left_alone() -> None:
    generator = torch.Generator().manual_seed(3)
    before = generator.get_state()
    assert not restore_generator(generator, torch.zeros(16, dtype=torch.uint8))  # as of a GPU
    assert torch.equal(generator.get_state(), before)
    torch.rand(5, generator=generator)
    assert restore_generator(generator, before) and torch.equal(generator.get_state(), before)


def _acting() -> dict[str, Callable[[int], torch.Tensor]]:
    """Name -> actions of so many worlds, drawn."""
    gaussian = GaussianPolicy(latent_dim=4, hidden=[8], action_dim=2)
    small: dict[str, Any] = dict(hidden_dim=16, codes=3, classes=4, blocks=2, encoder_layers=2, bins=41)
    dreamer: Any = models.make(
        "dreamer", observation_sizes={"state": 3}, action_dim=2, discount=0.9, deter_dim=16, **small
    )

    def started(count: int) -> TensorDict:
        return TensorDict({"is_init": torch.ones(count, 1, dtype=torch.bool)}, [count])

    return {
        "random": lambda count: SmoothRandomPolicy(2)(started(count))["action"],
        "discrete": lambda count: RandomDiscretePolicy(1000)(started(count))["action"],
        "candidates": lambda count: gaussian(torch.ones(count, 3, 4)),
        "flat": lambda count: gaussian(torch.ones(count * 3, 4)).view(count, 3, 2),
        "dreamer": lambda count: dreamer.policy(torch.ones(count, 3, dreamer.latent_dim)),
    }


@pytest.mark.parametrize("name", ["random", "discrete", "candidates", "flat", "dreamer"])
def test_worlds_draw_alike_however_they_are_divided(name) -> None:
    draw = _acting()[name]
    torch.manual_seed(0)
    together = draw(5)
    parts = []
    for first, count in ((0, 3), (3, 2)):
        torch.manual_seed(0)
        with drawing_for(first, count, 5):
            parts.append(draw(count))
    torch.testing.assert_close(torch.cat(parts), together, rtol=0, atol=1e-6)
    assert (together[0] != together[3]).any() and share_of_worlds() is None
