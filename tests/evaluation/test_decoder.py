"""The decoder draws what latents hold, and nothing else changes by looking."""

from __future__ import annotations

import pytest
import torch

from franka_wm.evaluation.decoder import (
    Decoder,
    decoder_error,
    imagined_beside_real,
    train_decoder,
)

SIZE = 32


def square_at(position: torch.Tensor) -> torch.Tensor:
    """Pictures (..., 32, 32, 3) of a bright square whose centre is at `position` (..., 2) in [0, 1]."""
    cells = torch.linspace(0, 1, SIZE)
    rows = (cells - position[..., 0, None]).abs() < 0.15
    columns = (cells - position[..., 1, None]).abs() < 0.15
    square = (rows[..., :, None] & columns[..., None, :]).unsqueeze(-1)
    return torch.where(square, torch.tensor([220, 120, 40]), torch.tensor([30, 30, 60])).to(torch.uint8)


@pytest.fixture(scope="module")
def trained() -> tuple[Decoder, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    z = torch.rand(500, 2, generator=generator)
    return train_decoder(z[:400], square_at(z[:400]), steps=250), z[400:]


def test_it_reconstructs_pictures_that_it_has_not_seen(trained) -> None:
    decoder, z = trained
    errors = decoder_error(decoder, z, square_at(z))
    assert errors["error"] < 0.5 * errors["mean_image"]


def test_latents_that_say_nothing_give_the_mean_image() -> None:
    generator = torch.Generator().manual_seed(1)
    z, where = torch.randn(300, 4, generator=generator), torch.rand(300, 2, generator=generator)
    decoder = train_decoder(z[:200], square_at(where[:200]), steps=60)
    errors = decoder_error(decoder, z[200:], square_at(where[200:]))
    assert errors["error"] > 0.9 * errors["mean_image"]


def test_imagined_beside_real(trained, point_model) -> None:
    decoder, _ = trained
    start, actions = torch.tensor([0.3, 0.3]), torch.full((4, 2), 0.1)
    way = start + torch.cat((torch.zeros(1, 2), actions.cumsum(0)))
    strip, frames = imagined_beside_real(point_model, decoder, start, actions, square_at(way))
    assert strip.shape == (2 * SIZE, 5 * SIZE, 3) and strip.dtype == torch.uint8
    assert frames.shape == (5, SIZE, 2 * SIZE, 3) and frames.dtype == torch.uint8
    for t in range(5):
        real, imagined = strip[:SIZE, t * SIZE : (t + 1) * SIZE], strip[SIZE:, t * SIZE : (t + 1) * SIZE]
        assert torch.equal(real, square_at(way[t]))
        assert torch.equal(torch.cat((real, imagined), 1), frames[t])
    # The model is exact, so what it imagines is nearer to what happened than to what was there at first.
    last = strip[SIZE:, 4 * SIZE :].float()
    assert (last - square_at(way[4])).abs().mean() < 0.5 * (last - square_at(way[0])).abs().mean()


def test_looking_changes_no_random_numbers_and_no_latents() -> None:
    z = torch.rand(20, 2, requires_grad=True)
    pictures = square_at(z.detach())
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    first = train_decoder(z, pictures, steps=2)
    assert torch.equal(torch.rand(3), expected)
    assert z.grad is None
    second = train_decoder(z, pictures, steps=2)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))


def test_sizes(trained, point_model) -> None:
    assert Decoder(5, size=64).draw(torch.zeros(2, 3, 5)).shape == (2, 3, 64, 64, 3)
    with pytest.raises(ValueError, match="size=48"):
        Decoder(5, size=48)
    with pytest.raises(ValueError, match="do not fit"):
        train_decoder(torch.zeros(3, 2), torch.zeros(4, 32, 32, 3, dtype=torch.uint8))
    with pytest.raises(ValueError, match="3 actions need"):
        imagined_beside_real(
            point_model, trained[0], torch.zeros(2), torch.zeros(3, 2), square_at(torch.zeros(3, 2))
        )
