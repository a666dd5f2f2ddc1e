"""Images as tensors: uint8 (..., height, width, channels), as the environment emits them.

All of it is device-side tensor code with static shapes.
"""

import math
from collections.abc import Iterable, Mapping, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

ImageSize = tuple[int, int, int]
"""(height, width, channels)."""


def check_images(images: Tensor) -> Tensor:
    """`images` itself.

    Raises:
        ValueError: they are not uint8. A float image says nothing about its range.
    """
    if images.dtype != torch.uint8:
        raise ValueError(f"images must be uint8 of shape (..., height, width, channels), got {images.dtype}")
    return images


def check_image_sizes(image_sizes: Mapping[str, Sequence[int]] | None) -> dict[str, ImageSize]:
    """Image key -> (height, width, channels), as plain integers.

    Raises:
        ValueError: a size that is not three numbers of at least 1.
    """
    sizes: dict[str, ImageSize] = {}
    for key, size in (image_sizes or {}).items():
        values = tuple(int(n) for n in size)
        if len(values) != 3 or min(values) < 1:
            raise ValueError(f"image_sizes[{key!r}] must be (height, width, channels), got {size}")
        sizes[str(key)] = values
    return sizes


def shared_image_size(image_sizes: Mapping[str, ImageSize]) -> ImageSize:
    """Size that all images have, for families whose cameras share an encoder.

    Raises:
        ValueError: no image, or images of several sizes.
    """
    if not image_sizes:
        raise ValueError("image_sizes needs at least one image: set observations=[pixels]")
    if len(set(image_sizes.values())) > 1:
        raise ValueError(f"all images must have one size to share an encoder, got {dict(image_sizes)}")
    return next(iter(image_sizes.values()))


def stack_cameras(observation: TensorDictBase, keys: Iterable[str]) -> Tensor:
    """Images of all keys: (..., V, height, width, C) uint8."""
    return torch.stack([check_images(observation.get(key)) for key in keys], dim=-4)


class RandomShift(nn.Module):
    """Shift images by up to `pad` pixels in each direction, edges repeated (DrQ, arXiv:2004.13649).

    (N, ..., height, width, channels) -> the same shape and dtype. Each of the N entries gets its own shift. All images
    inside an entry (the frames of a window, say) get the same one, so that motion between them is kept. Acts in
    training mode only. Drawn on the device, as one gather.

    Raises:
        ValueError: `pad` is negative.
    """

    def __init__(self, pad: int = 3) -> None:
        super().__init__()
        if pad < 0:
            raise ValueError(f"pad must be at least 0, got {pad}")
        self.pad = pad

    def forward(self, images: Tensor) -> Tensor:
        if not self.training or self.pad == 0:
            return images
        count, (height, width, channels) = images.shape[0], images.shape[-3:]
        device = images.device
        flat = images.reshape(count, -1, height * width, channels)
        shift = torch.randint(-self.pad, self.pad + 1, (2, count, 1), device=device)
        # An index past an edge is the edge's: padding by repetition holds the same there.
        rows = (torch.arange(height, device=device) + shift[0]).clamp(0, height - 1)
        columns = (torch.arange(width, device=device) + shift[1]).clamp(0, width - 1)
        index = (rows.unsqueeze(-1) * width + columns.unsqueeze(-2)).reshape(count, 1, -1, 1)
        return flat.gather(2, index.expand(-1, flat.shape[1], -1, channels)).reshape(images.shape)

    def extra_repr(self) -> str:
        return f"pad={self.pad}"


def random_crops(clips: Tensor, count: int, scale: tuple[float, float], size: tuple[int, int]) -> Tensor:
    """Random crops of clips, resized bilinearly; all frames of a clip are cropped alike.

    Args:
        clips: (N, T, height, width, C) uint8.
        count: crops of each clip.
        scale: range of a crop's area, relative to the image; its aspect ratio is in [3/4, 4/3].
        size: (height, width) of the result.

    Returns:
        (count, N, T, *size, C) uint8.
    """
    n, frames, height, width, channels = clips.shape
    device = clips.device
    u = torch.rand(4, count * n, device=device)
    area = scale[0] + (scale[1] - scale[0]) * u[0]
    ratio = torch.exp(math.log(4 / 3) * (2.0 * u[1] - 1.0))
    part = [(area * ratio).sqrt().clamp(max=1.0), (area / ratio).sqrt().clamp(max=1.0)]  # of x and y
    centre = [(1.0 - p) * (2.0 * v - 1.0) for p, v in zip(part, u[2:], strict=True)]
    zero = torch.zeros_like(area)
    theta = torch.stack((part[0], zero, centre[0], zero, part[1], centre[1]), -1).view(-1, 2, 3)
    images = clips.permute(0, 1, 4, 2, 3).reshape(n, frames * channels, height, width).float()
    images = images.expand(count, -1, -1, -1, -1).flatten(0, 1)
    grid = F.affine_grid(theta, [count * n, frames * channels, *size], align_corners=False)
    crops = F.grid_sample(images, grid, padding_mode="border", align_corners=False)
    crops = crops.round().clamp(0, 255).to(torch.uint8).view(count, n, frames, channels, *size)
    return crops.permute(0, 1, 2, 4, 5, 3)
