"""Vector observations, concatenated and standardised at a model's input."""

from collections.abc import Iterable, Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn


class ObservationNormalizer(nn.Module):
    """Concatenate vector observations in a fixed order and standardise them: (s - mean) / std.

    The statistics are saved with the weights and never trained. Until they are set they are the identity.

    Args:
        sizes: observation key -> size of its last dimension; may be empty.

    Raises:
        ValueError: a size below 1.
    """

    observation_mean: Tensor
    observation_std: Tensor

    def __init__(self, sizes: Mapping[str, int] | None) -> None:
        super().__init__()
        self.sizes = check_sizes(sizes)
        self.size = sum(self.sizes.values())
        register_statistics(self, self.size)

    def forward(self, observation: TensorDictBase) -> Tensor:
        """Observations with the keys of `sizes` -> (..., size), float."""
        return standardize(concatenate(observation, self.sizes), self.observation_mean, self.observation_std)

    def set_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Set mean and standard deviation, see `copy_statistics`."""
        copy_statistics(self.observation_mean, self.observation_std, mean, std)


def check_sizes(sizes: Mapping[str, int] | None) -> dict[str, int]:
    """Vector key -> size, as plain integers.

    Raises:
        ValueError: a size below 1.
    """
    found = {str(key): int(size) for key, size in (sizes or {}).items()}
    if min(found.values(), default=1) < 1:
        raise ValueError(f"observation_sizes must be 1 or more each, got {found}")
    return found


def register_statistics(module: nn.Module, size: int) -> None:
    """Give `module` the buffers `observation_mean` and `observation_std` (size,): the identity."""
    module.register_buffer("observation_mean", torch.zeros(size))
    module.register_buffer("observation_std", torch.ones(size))


def concatenate(observation: TensorDictBase, keys: Iterable[str]) -> Tensor:
    """Vectors of all keys side by side, (..., sum of sizes)."""
    return torch.cat([observation.get(key) for key in keys], dim=-1)


def standardize(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """(x - mean) / std in the precision of `mean`.

    Raises:
        ValueError: the last dimensions of `x` and `mean` differ.
    """
    if x.shape[-1] != mean.shape[-1]:
        raise ValueError(
            f"the model reads {mean.shape[-1]} numbers of an observation, here are {x.shape[-1]}; is it another "
            "environment than the model's?"
        )
    return (x.to(mean.dtype) - mean) / std


@torch.no_grad()
def copy_statistics(to_mean: Tensor, to_std: Tensor, mean: Tensor, std: Tensor) -> None:
    """Check a mean and a standard deviation and copy them in place: a captured CUDA graph sees the new values.

    Args:
        to_mean, to_std: (size,) buffers of a model.
        mean, std: (size,), in the units of the observations. A deviation of zero becomes 1, which centres only.

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
