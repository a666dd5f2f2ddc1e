"""A small decoder, trained on the side on frozen latents: for looking only, nothing else uses it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

if TYPE_CHECKING:
    from franka_wm.models.base import WorldModel

SIZES = (32, 64)
"""Sides of the images that it can draw [px]."""

WIDTH = 96
"""Channels at 4 × 4; halved at every doubling, at least 24."""


class Decoder(nn.Module):
    """Latents to images: a linear layer to 4 × 4, then doubled in size and convolved until the image is full.

    It draws the difference from the training images' mean, so that a still background costs nothing.

    Args:
        latent_dim: D.
        size: Side of the image [px], 32 or 64.

    Raises:
        ValueError: Another size.
    """

    mean: Tensor
    std: Tensor
    background: Tensor

    def __init__(self, latent_dim: int, *, size: int):
        super().__init__()
        if size not in SIZES:
            raise ValueError(f"size={size}: must be one of {SIZES}")
        self.size = size
        self.register_buffer("mean", torch.zeros(latent_dim))
        self.register_buffer("std", torch.ones(latent_dim))
        self.register_buffer("background", torch.zeros(3, size, size))
        self.start = nn.Sequential(
            nn.Linear(latent_dim, 256), nn.SiLU(), nn.Linear(256, WIDTH * 16), nn.SiLU()
        )
        layers: list[nn.Module] = []
        channels, side = WIDTH, 4
        while 2 * side < size:
            narrower, side = max(24, channels // 2), side * 2
            layers += [nn.Upsample(scale_factor=2), nn.Conv2d(channels, narrower, 3, padding=1), nn.SiLU()]
            channels = narrower
        # The last doubling by rearranging channels: a convolution at full size would cost more than all others.
        self.grow = nn.Sequential(*layers, nn.Conv2d(channels, 12, 3, padding=1), nn.PixelShuffle(2))

    def forward(self, z: Tensor) -> Tensor:
        """(n, D) → (n, 3, S, S), about [0, 1], not clipped."""
        x = self.start((z - self.mean) / self.std).view(-1, WIDTH, 4, 4)
        return self.background + self.grow(x)

    @torch.no_grad()
    def draw(self, z: Tensor) -> Tensor:
        """(..., D) → images (..., S, S, 3) uint8."""
        flat = self(z.reshape(-1, z.shape[-1]))
        images = (flat.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1)
        return images.reshape(*z.shape[:-1], self.size, self.size, 3)


def train_decoder(latents: Tensor, images: Tensor, *, steps: int = 600) -> Decoder:
    """Fits a decoder to pairs of latent and image. The latents are taken as they are: no gradient leaves here.

    Args:
        latents: (n, D).
        images: (n, S, S, 3) uint8, S as in :data:`SIZES`.
        steps: Updates; 600 take some 10 to 20 s on two CPU cores at 64 × 64.

    Returns:
        In evaluation mode.

    Raises:
        ValueError: Shapes that do not fit.
    """
    if images.dim() != 4 or images.shape[0] != latents.shape[0] or images.dtype != torch.uint8:
        raise ValueError(
            f"latents {tuple(latents.shape)} and images {tuple(images.shape)} {images.dtype} do not fit: "
            "(n, D) and (n, S, S, 3) uint8 are needed"
        )
    device = latents.device
    z = latents.detach().float()
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []), torch.enable_grad():
        torch.manual_seed(0)
        decoder = Decoder(z.shape[-1], size=images.shape[1]).to(device)
        decoder.mean.copy_(z.mean(0))
        decoder.std.copy_(z.std(0).clamp_min(1e-4))
        pixels = images.to(device).permute(0, 3, 1, 2)
        decoder.background.copy_(pixels.float().mean(0) / 255)
        optimizer = torch.optim.Adam(decoder.parameters(), lr=6e-3)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        for _ in range(steps):
            index = torch.randint(len(z), (16,), device=device)
            loss = F.mse_loss(decoder(z[index]), pixels[index].float() / 255)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return decoder.eval().requires_grad_(False)


def decoder_error(decoder: Decoder, latents: Tensor, images: Tensor) -> dict[str, float]:
    """Mean squared error of the decoder's images and of the mean image, of values in [0, 1].

    Args:
        latents: (n, D), not trained on.
        images: (n, S, S, 3) uint8.

    Returns:
        ``error``, and ``mean_image``, the error of always drawing the training images' mean.
    """
    truth = images.to(latents.device).permute(0, 3, 1, 2).float() / 255
    with torch.no_grad():
        drawn = torch.cat([decoder(part) for part in latents.split(256)])
    return {
        "error": float((drawn - truth).square().mean()),
        "mean_image": float((decoder.background - truth).square().mean()),
    }


class Imagined(NamedTuple):
    """What :func:`imagined_beside_real` gives."""

    strip: Tensor
    """(2·S, S·(H + 1), 3) uint8: above what happened, below what the model imagined, step by step."""
    frames: Tensor
    """(H + 1, S, 2·S, 3) uint8: the same as a film, real on the left."""


@torch.no_grad()
def imagined_beside_real(
    model: WorldModel, decoder: Decoder, latent: Tensor, actions: Tensor, images: Tensor
) -> Imagined:
    """Unrolls a model from one latent and draws what it imagines beside what happened.

    Args:
        model: With ``next``, and ``embed`` where the family has it: the decoder reads what it gives.
        decoder: Decoder of :func:`train_decoder`.
        latent: (Z), at the first image.
        actions: (H, A), or (H) discrete ones, that were taken.
        images: (H + 1, S, S, 3) uint8, what happened.

    Raises:
        ValueError: Another number or size of images.
    """
    steps, size = actions.shape[0], decoder.size
    if images.shape != (steps + 1, size, size, 3):
        raise ValueError(
            f"images are {tuple(images.shape)}; {steps} actions need ({steps + 1}, {size}, {size}, 3)"
        )
    imagined = [latent.unsqueeze(0)]
    for t in range(steps):
        imagined.append(model.next(imagined[-1], actions[t : t + 1]))
    drawn = decoder.draw(model.embed(torch.cat(imagined))).cpu()
    real = images.cpu()
    strip = torch.cat([row.permute(1, 0, 2, 3).reshape(size, -1, 3) for row in (real, drawn)])
    return Imagined(strip, torch.cat([real, drawn], 2))
