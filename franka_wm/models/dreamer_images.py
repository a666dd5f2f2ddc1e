"""The convolutions that read images for Dreamer; what draws them is `ConvDecoder`.

Everything here is device-side tensor code with static shapes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models.images import ImageSize, check_images, shared_image_size
from franka_wm.models.layers import RMSNorm


class PixelEncoder(nn.Module):
    """Features of the images of all cameras: four times, a 3 × 3 convolution of an image half as large.

    The counterpart of `ConvDecoder`: what four pixels hold is laid out as one pixel with four times as many channels
    (arXiv:1609.05158), so each convolution sees 6 × 6 pixels in steps of 2. DreamerV3's sees 5 × 5 in steps of 1, and
    of four results the largest goes on. Normalised pixel by pixel, SiLU. 64 × 64 pixels become 4 × 4.

    (..., height, width, C) uint8 -> (..., features); C: the channels of all cameras side by side, as DreamerV3's.

    Args:
        image_sizes: image key -> (height, width, channels), the same of all. Sides that are no multiples of 16 are
            filled up with what is zero after centring.
        channels: of the first convolution; those after it have 1.5, 2 and 2 times as many, as DreamerV3's.
        standardize: subtract a mean image and divide by one deviation, see `set_statistics`.

    Raises:
        ValueError: no image, or images of several sizes.
    """

    def __init__(
        self, image_sizes: Mapping[str, ImageSize], *, channels: int = 32, standardize: bool = False
    ) -> None:
        super().__init__()
        height, width, each = shared_image_size(image_sizes)
        self.keys = tuple(image_sizes)
        inputs = each * len(self.keys)
        self.image_size = (height, width, inputs)
        self.added = (-height % 16, -width % 16)
        widths = [channels, 3 * channels // 2, 2 * channels, 2 * channels]
        self.features = widths[-1] * (-(-height // 16)) * (-(-width // 16))
        self.convolutions = nn.ModuleList(
            nn.Conv2d(4 * a, b, 3, padding=1) for a, b in zip([inputs, *widths[:-1]], widths, strict=True)
        )
        self.norms = nn.ModuleList(RMSNorm(each, eps=1e-4) for each in widths)
        self.standardizes = standardize
        if standardize:
            self.register_buffer("mean", torch.full(self.image_size, 0.5))
            self.register_buffer("std", torch.ones(()))

    mean: Tensor
    std: Tensor

    @torch.no_grad()
    def set_statistics(self, moments: Mapping[str, Sequence[Tensor]]) -> None:
        """Standardise with the mean and deviation (height, width, c) of each key's images in [0, 1].

        Of stacks of frames c may be that of one frame. See `ConvEncoder.set_statistics`.
        """
        each = self.image_size[-1] // len(self.keys)
        mean, std = (
            torch.cat(
                [moments[key][n].repeat(1, 1, each // moments[key][n].shape[-1]) for key in self.keys], -1
            )
            for n in (0, 1)
        )
        self.mean.copy_(mean)
        deviation = std.square().mean().sqrt()
        self.std.copy_(torch.where(deviation > 1.0 / 255.0, deviation, 1.0))  # nothing moved: centred only

    def images(self, observation: TensorDictBase) -> Tensor:
        """The images of all cameras (..., height, width, C), uint8: their channels side by side."""
        return torch.cat([check_images(observation.get(key)) for key in self.keys], dim=-1)

    def forward(self, images: Tensor) -> Tensor:
        x = images.reshape(-1, *images.shape[-3:]).to(next(self.parameters()).dtype) / 255.0
        x = (x - self.mean) / self.std if self.standardizes else x - 0.5
        if any(self.added):
            x = F.pad(x, (0, 0, 0, self.added[1], 0, self.added[0]))
        # Channels last throughout: what convolutions on a GPU take and give without a copy.
        for norm, convolution in zip(self.norms, self.convolutions, strict=True):
            # (N, 2 rows, 2 columns, channels) -> (N, rows, columns, 4 · channels)
            x = x.unflatten(2, (-1, 2)).unflatten(1, (-1, 2)).transpose(2, 3).flatten(3)
            x = F.silu(norm(convolution(x.movedim(-1, 1)).movedim(1, -1)))
        return x.reshape(*images.shape[:-3], self.features)
