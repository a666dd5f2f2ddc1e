"""Vector observations, concatenated and standardised at a model's input."""

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn


def copy_statistics(to_mean: Tensor, to_std: Tensor, mean: Tensor, std: Tensor) -> None:
    """Checks a mean and a standard deviation and copies them, in place: a captured CUDA graph sees the new values.

    Args:
        to_mean, to_std: (size,) buffers of a model.
        mean, std: (size,), in the units of the observations; a deviation of zero becomes 1, which centres only.

    Raises:
        ValueError: a wrong shape, a value that is not finite, or a negative standard deviation.
    """
    for name, value in (("mean", mean), ("std", std)):
        if value.shape != to_mean.shape:
            raise ValueError(f"{name} must have shape {tuple(to_mean.shape)}, got {tuple(value.shape)}")
        if not bool(torch.isfinite(value).all()):
            raise ValueError(f"{name} of the observations must be finite")
    if bool((std < 0).any()):
        raise ValueError("std of the observations must not be negative")
    to_mean.copy_(mean)
    to_std.copy_(torch.where(std > 1e-6, std, torch.ones_like(std)))


class Vectors(nn.Module):
    """Concatenates vector observations in a fixed order and standardises them: (s - mean) / std.

    The statistics are saved with the weights and never trained; until they are set they are the identity.

    Args:
        sizes: observation key -> size of its last dimension; may be empty.

    Raises:
        ValueError: a size below 1.
    """

    observation_mean: Tensor
    observation_std: Tensor

    def __init__(self, sizes: Mapping[str, int]) -> None:
        super().__init__()
        self.sizes = {str(key): int(size) for key, size in sizes.items()}
        if self.sizes and min(self.sizes.values()) < 1:
            raise ValueError(f"observation_sizes must be 1 or more each, got {self.sizes}")
        self.size = sum(self.sizes.values())
        self.register_buffer("observation_mean", torch.zeros(self.size))
        self.register_buffer("observation_std", torch.ones(self.size))

    def forward(self, observation: TensorDictBase) -> Tensor:
        """Observations with the keys of `sizes` -> (..., size), float."""
        x = torch.cat([observation.get(key) for key in self.sizes], dim=-1)
        return (x.to(self.observation_mean.dtype) - self.observation_mean) / self.observation_std

    @torch.no_grad()
    def set_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Set mean and standard deviation, each (size,); a feature of zero deviation is centred only.

        Raises:
            ValueError: a wrong shape, a value that is not finite, or a negative standard deviation.
        """
        copy_statistics(self.observation_mean, self.observation_std, mean, std)
