"""TD-MPC2's encoder of images, and of images with vectors."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from franka_wm.models.backbone import Backbone
from franka_wm.models.images import shared_image_size
from franka_wm.models.layers import NormedLinear, SimNorm, initialize
from franka_wm.models.vision import ConvEncoder


class ImageEncoder(nn.Module):
    """Images, and vectors if there are any -> z (..., latent_dim), simplices of `simnorm_dim`.

    Each image goes through convolutions of its own (or all through one pretrained vision transformer),
    vectors through `NormedLinear` layers; the features side by side go through one more, with SimNorm. One
    image whose features are as many as the latent's go to SimNorm directly, as published.

    Args:
        image_sizes: image key -> (height, width, channels).
        observation_dim: size of the vectors together; 0: none.
        hidden: widths of the layers over vectors.
        channels: of the convolutions.
        encoder_from, architecture, grid: see `Backbone`.
        freeze: do not train the pretrained transformer.
        standardize: images of the convolutions, see `ConvEncoder`.
    """

    def __init__(
        self,
        *,
        image_sizes: Mapping[str, tuple[int, int, int]],
        observation_dim: int,
        hidden: Sequence[int],
        latent_dim: int,
        simnorm_dim: int,
        channels: int = 32,
        encoder_from: str | Path | None = None,
        architecture: Sequence[int] | None = None,
        grid: int | None = 4,
        freeze: bool = False,
        standardize: bool = False,
    ) -> None:
        super().__init__()
        self.keys, self.frozen = list(image_sizes), freeze
        self.backbone = self.convolutions = None
        if encoder_from is not None or architecture is not None:
            size = shared_image_size(image_sizes)
            self.backbone = Backbone(size, grid=grid, encoder_from=encoder_from, architecture=architecture)
            features = len(self.keys) * self.backbone.tokens * self.backbone.width
            if freeze:
                self.backbone.requires_grad_(False).eval()
        else:
            convolutions = [
                ConvEncoder(size, channels=channels, standardize=standardize) for size in image_sizes.values()
            ]
            self.convolutions = nn.ModuleList(convolutions)
            features = sum(conv.features for conv in convolutions)
        layers = []
        for width in hidden if observation_dim else ():
            layers.append(NormedLinear(observation_dim, width))
            observation_dim = width
        self.vectors = nn.Sequential(*layers)
        initialize(self.vectors)
        self.direct = self.backbone is None and not layers and features == latent_dim
        simnorm = SimNorm(simnorm_dim)
        self.join: nn.Module = simnorm
        if not self.direct:
            self.join = NormedLinear(
                features + (observation_dim if layers else 0), latent_dim, activation=simnorm
            )
            initialize(self.join)

    def train(self, mode: bool = True) -> "ImageEncoder":
        """Set the mode; a frozen backbone stays in evaluation mode."""
        super().train(mode)
        if self.frozen and self.backbone is not None:
            self.backbone.eval()
        return self

    def forward(self, images: Mapping[str, Tensor], vectors: Tensor | None = None) -> Tensor:
        """Images (..., height, width, C) uint8 by key, vectors (..., observation_dim) -> (..., latent_dim)."""
        if self.backbone is None:
            assert self.convolutions is not None
            parts = [conv(images[key]) for key, conv in zip(self.keys, self.convolutions, strict=True)]
        else:
            stacked = torch.stack([images[key] for key in self.keys], dim=-4)
            with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
                tokens = self.backbone(stacked.flatten(0, -4))
            parts = [tokens.reshape(*stacked.shape[:-4], -1)]
        if len(self.vectors):
            assert vectors is not None
            parts.append(self.vectors(vectors))
        return self.join(parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1))

    def rebuild(self) -> dict[str, Any]:
        """Arguments of TD-MPC2 that rebuild this without the pretrained checkpoint."""
        return {} if self.backbone is None else self.backbone.rebuild()
