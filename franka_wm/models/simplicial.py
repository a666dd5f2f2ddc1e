"""Base class of TD-MPC2 and MuZero: an encoder of vectors and images to simplices, and its inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from franka_wm.errors import UserError
from franka_wm.models import fused
from franka_wm.models.base import WorldModel
from franka_wm.models.image_encoder import ImageEncoder
from franka_wm.models.images import ImageSize, RandomShift, check_image_sizes, check_images
from franka_wm.models.layers import SimNorm, TwoHotSymlog, mlp, reads_apart
from franka_wm.models.normalizer import (
    check_sizes,
    concatenate,
    copy_statistics,
    register_statistics,
    standardize,
)
from franka_wm.models.vision import ConvEncoder
from franka_wm.options import with_defaults


class SimplicialWorldModel(WorldModel):
    """World model of latents (..., `latent_dim`) that are simplices of `simnorm_dim` features.

    Args:
        observation_sizes: observation key -> size of its last dimension; encoded in this order. May be empty
            where there are images.
        image_sizes: image key -> (height, width, channels), uint8.
        latent_dim: size of z.
        simnorm_dim: features per simplex; divides `latent_dim`.
        encoder_dim: width of the encoder's hidden layers.
        encoder_layers: layers of the encoder, its output layer included.
        channels: channels of each convolution over images.
        random_shift: pixels by which images are shifted at most while training, in each direction.
        encoder_from, encoder_architecture, encoder_grid, freeze_encoder: of a pretrained vision transformer, see
            `ImageEncoder`.
        standardize_images: of the convolutions, see `set_image_statistics`; without effect on a pretrained transformer.
        action_masks: of K tasks (K, A), 1 where a task has the entry of an action. Then `task` (..., K), one-hot, is
            among the observations, and z carries its mask behind the `latent_dim` features. None: one task.

    Raises:
        ValueError: nothing to read.
    """

    observation_mean: Tensor
    observation_std: Tensor
    two_hot: TwoHotSymlog
    action_masks: Tensor | None

    def __init__(
        self,
        *,
        observation_sizes: Mapping[str, int] | None,
        image_sizes: Mapping[str, ImageSize] | None,
        latent_dim: int,
        simnorm_dim: int,
        encoder_dim: int,
        encoder_layers: int,
        channels: int,
        random_shift: int,
        encoder_from: str | Path | None = None,
        encoder_architecture: Sequence[int] | None = None,
        encoder_grid: int | None = None,
        freeze_encoder: bool = False,
        standardize_images: bool = False,
        action_masks: Sequence[Sequence[float]] | None = None,
    ) -> None:
        super().__init__()
        self.observation_sizes = check_sizes(observation_sizes)
        self.image_sizes = check_image_sizes(image_sizes)
        if not self.observation_keys:
            raise ValueError("give observation_sizes or image_sizes: there is nothing to read")
        self.latent_dim = latent_dim
        observation_dim = sum(self.observation_sizes.values())
        self.encoder: nn.Module
        if self.image_sizes:
            self.encoder = ImageEncoder(
                image_sizes=self.image_sizes,
                observation_dim=observation_dim,
                hidden=(encoder_dim,) * max(1, encoder_layers - 1),
                latent_dim=latent_dim,
                simnorm_dim=simnorm_dim,
                channels=channels,
                encoder_from=encoder_from,
                architecture=encoder_architecture,
                grid=encoder_grid,
                freeze=freeze_encoder,
                standardize=standardize_images,
            )
            if standardize_images and self.encoder.convolutions is not None:
                self.standardized_images = list(self.image_sizes)
        else:
            hidden = (encoder_dim,) * (encoder_layers - 1)
            self.encoder = mlp(observation_dim, hidden, latent_dim, output=SimNorm(simnorm_dim))
        self.random_shift = RandomShift(random_shift)
        register_statistics(self, observation_dim)
        if action_masks is None:
            self.action_masks = None
        elif "task" not in self.observation_sizes:
            raise ValueError(
                "these tasks have actions of different sizes, and which are a task's own is told by the observation "
                "task: add task to model.observations"
            )
        else:
            self.register_buffer("action_masks", torch.tensor(action_masks), persistent=False)

    @classmethod
    def validate(cls, options: Mapping[str, Any], *, window: int | None = None) -> None:
        super().validate(options, window=window)
        given = with_defaults(cls, options)
        latent, simplex = given.get("latent_dim"), given.get("simnorm_dim")
        if latent and simplex and latent % simplex:
            raise UserError(f"model.simnorm_dim={simplex}: must divide model.latent_dim={latent}")

    def set_observation_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Standardise vectors at the encoder's input from now on: (s - mean) / std.

        An addition to the papers: joint angles [rad], velocities [rad/s] and positions [m] differ in size by
        orders of magnitude. The statistics are saved with the weights and never trained. A feature of
        zero standard deviation is centred only.

        Args:
            mean, std: (sum of `observation_sizes`), in the order of `observation_sizes`, in the units of the
                observations.

        Raises:
            ValueError: a wrong shape, a value that is not finite, or a negative standard deviation.
        """
        copy_statistics(self.observation_mean, self.observation_std, mean, std)

    def set_image_statistics(self, moments: Mapping[str, Sequence[Tensor]]) -> None:
        """Standardise images of the convolutions from now on, as `ConvEncoder.set_statistics` does.

        An addition to the papers, of models with `standardize_images`; saved with the weights, never trained.

        Args:
            moments: mean and deviation (height, width, c) of each of `standardized_images`, of images in [0, 1].
        """
        assert isinstance(self.encoder, ImageEncoder) and self.encoder.convolutions is not None
        for key, encoder in zip(self.image_sizes, self.encoder.convolutions, strict=True):
            assert isinstance(encoder, ConvEncoder)
            mean, std = moments[key]
            encoder.set_statistics(mean, std)

    def encode(self, observation: TensorDictBase) -> Tensor:
        """Latents (..., latent_dim) of vectors, each (..., size), and images, each (..., height, width, C) uint8."""
        images = {key: check_images(observation.get(key)) for key in self.image_sizes}
        vectors = concatenate(observation, self.observation_sizes) if self.observation_sizes else None
        return self.encode_parts(images, vectors)

    def encode_parts(self, images: Mapping[str, Tensor], vectors: Tensor | None) -> Tensor:
        """Latents (..., latent_dim) of images by key and of all vectors side by side (..., observation_dim)."""
        raw = vectors
        if vectors is not None:
            vectors = standardize(vectors, self.observation_mean, self.observation_std)
        z = self.encoder(images, vectors) if self.image_sizes else self.encoder(vectors)
        if self.action_masks is None or raw is None:
            return z
        sizes = list(self.observation_sizes.values())
        task = raw.split(sizes, dim=-1)[list(self.observation_sizes).index("task")]
        return torch.cat((z, task.to(z.dtype) @ self.action_masks.to(z.dtype)), dim=-1)

    # Where tasks have actions of different sizes: what a task's action lacks counts nowhere.

    def features(self, z: Tensor) -> Tensor:
        """The features (..., latent_dim) of z, without the mask that it may carry."""
        return z if self.action_masks is None else z[..., : self.latent_dim]

    def used(self, z: Tensor) -> Tensor | None:
        """1 where the task of z has the entry of an action, else 0 (..., A); None: all have all."""
        return None if self.action_masks is None else z[..., self.latent_dim :]

    def masked(self, z: Tensor, action: Tensor) -> Tensor:
        """Actions (..., A) with 0 in the entries that the task of z has not."""
        return action if self.action_masks is None else action * z[..., self.latent_dim :]

    def joined(self, z: Tensor, action: Tensor, reader: nn.Module | None = None) -> Any:
        """What networks over both read: the features of z and the action, masked (..., latent_dim + A).

        Args:
            reader: the network; where kernels are used, one that can read both apart gets a `fused.Joined`.
        """
        parts = (self.features(z), self.masked(z, action))
        apart = reader is not None and fused.applies() and reads_apart(reader)
        return fused.Joined(*parts) if apart else torch.cat(parts, dim=-1)

    def following(self, z: Tensor, features: Tensor) -> Tensor:
        """The next z: new features (..., latent_dim), and the mask of z."""
        return (
            features
            if self.action_masks is None
            else torch.cat((features, z[..., self.latent_dim :].to(features.dtype)), -1)
        )

    def rebuild_overrides(self) -> dict[str, Any]:
        """Constructor arguments that replace a pretrained encoder's file, and the range of rewards and values."""
        encoder = self.encoder.rebuild() if isinstance(self.encoder, ImageEncoder) else {}
        return encoder | self.two_hot.rebuild()
