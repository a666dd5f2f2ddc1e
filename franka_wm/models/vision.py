"""Encoders of images and clips: a small convolutional one, and a vision transformer.

Images are uint8, channels last, (..., height, width, channels), as the environment emits them; they are
normalised here. Everything is device-side tensor code with static shapes.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models.attention import attention
from franka_wm.models.images import check_images
from franka_wm.models.layers import RMSNorm, initialize
from franka_wm.options import is_whole

SIZES = {"tiny": (192, 12, 3), "small": (384, 12, 6)}
"""Published sizes of vision transformers: width, depth, heads (arXiv:2012.12877, table 1)."""


class ConvEncoder(nn.Module):
    """TD-MPC2's convolutional encoder for small images (arXiv:2310.16828, appendix H).

    Kernels 7, 5, 3, 3 with strides 2, 2, 2, 1, `channels` channels each, ReLU between them. Images are
    scaled to [-0.5, 0.5]. 64 × 64 pixels give `channels` × 4 × 4 = 512 features.

    (..., height, width, C) uint8 -> (..., features).

    Args:
        image_size: (height, width, channels).
        channels: channels of every convolution.
        standardize: subtract a mean image and divide by one deviation instead, see `set_statistics`.

    Raises:
        ValueError: images too small for the four convolutions (less than 38 pixels a side).
    """

    KERNELS = ((7, 2), (5, 2), (3, 2), (3, 1))

    def __init__(
        self, image_size: tuple[int, int, int], *, channels: int = 32, standardize: bool = False
    ) -> None:
        super().__init__()
        height, width, inputs = image_size
        if channels < 1:
            raise ValueError(f"channels must be at least 1, got {channels}")
        self.standardizes = standardize
        if standardize:
            self.register_buffer("mean", torch.full(tuple(image_size), 0.5))
            self.register_buffer("std", torch.ones(()))
        for kernel, stride in self.KERNELS:
            height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
        if min(height, width) < 1:
            raise ValueError(
                f"images of {image_size[0]} × {image_size[1]} pixels are too small for the convolutional "
                "encoder: it needs at least 38 × 38"
            )
        self.image_size, self.channels = image_size, channels
        self.grid = (height, width)
        self.features = channels * height * width
        layers: list[nn.Module] = []
        for kernel, stride in self.KERNELS:
            layers += [nn.Conv2d(inputs, channels, kernel, stride), nn.ReLU()]
            inputs = channels
        self.network = nn.Sequential(*layers[:-1])  # what follows normalises; a last ReLU would lose half

    mean: Tensor
    std: Tensor

    @torch.no_grad()
    def set_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Standardise with the moments (height, width, c) of images in [0, 1]; of stacks, c may be that of one frame.

        What does not move is the same number in every feature and hides what does. Deviations of all pixels make
        one: a pixel that hardly ever changes must not become loud.
        """
        self.mean.copy_(mean.repeat(1, 1, self.mean.shape[-1] // mean.shape[-1]))
        deviation = std.square().mean().sqrt()
        self.std.copy_(torch.where(deviation > 1.0 / 255.0, deviation, 1.0))  # nothing moved: centred only

    def maps(self, images: Tensor) -> Tensor:
        """(N, height, width, C) uint8 -> feature maps (N, channels, rows, columns)."""
        dtype = next(self.network.parameters()).dtype
        x = check_images(images).permute(0, 3, 1, 2).to(dtype).div(255.0)
        x = (x - self.mean.permute(2, 0, 1)) / self.std if self.standardizes else x.sub(0.5)
        return self.network(x)

    def forward(self, images: Tensor) -> Tensor:
        leading = images.shape[:-3]
        return self.maps(images.reshape(-1, *images.shape[-3:])).reshape(*leading, self.features)


class ConvDecoder(nn.Module):
    """Images from features: 3 × 3 convolutions, each of whose results is laid out as an image twice as large.

    (..., in_features) -> (..., height, width, C), 0 black and 1 white, not bounded. What is wanted of the larger image
    comes out of the smaller one as four times as many channels (arXiv:1609.05158): no convolution reads the larger one.
    Normalised pixel by pixel, as DreamerV3's.

    Args:
        image_size: (height, width, channels).
        channels: of the last hidden layer; those before it have 1.5, 2 and 2 times as many, as DreamerV3's.
    """

    def __init__(self, in_features: int, image_size: tuple[int, int, int], *, channels: int = 32) -> None:
        super().__init__()
        height, width, outputs = image_size
        self.image_size, self.grid = image_size, (-(-height // 16), -(-width // 16))
        widths = [2 * channels, 2 * channels, 3 * channels // 2, channels]
        self.start = nn.Linear(in_features, widths[0] * self.grid[0] * self.grid[1])
        self.norms = nn.ModuleList(RMSNorm(each, eps=1e-4) for each in widths)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(a, 4 * b, 3, padding=1) for a, b in zip(widths, [*widths[1:], outputs], strict=True)
        )

    def forward(self, features: Tensor) -> Tensor:
        # Channels last throughout: what convolutions on a GPU take and give without a copy.
        x = self.start(features).reshape(-1, *self.grid, self.start.out_features // math.prod(self.grid))
        for norm, convolution in zip(self.norms, self.convolutions, strict=True):
            # (N, rows, columns, 4 · channels) -> (N, 2 rows, 2 columns, channels)
            four = convolution(F.silu(norm(x)).movedim(-1, 1)).movedim(1, -1)
            x = four.unflatten(-1, (2, 2, -1)).transpose(2, 3).flatten(1, 2).flatten(2, 3)
        height, width, _ = self.image_size
        return (x[:, :height, :width] + 0.5).reshape(*features.shape[:-1], *self.image_size)


# -- the vision transformer ------------------------------------------------------------------------------


def sincos(positions: Tensor, width: int) -> Tensor:
    """Sine and cosine codes: positions (...) -> (..., width), `width` even (arXiv:1706.03762)."""
    half = width // 2
    exponents = torch.arange(half, device=positions.device, dtype=torch.float32) / half
    angles = positions.float().unsqueeze(-1) * torch.exp(-math.log(10_000.0) * exponents)
    return torch.cat((angles.sin(), angles.cos()), dim=-1)


def sincos_grid(rows: Tensor, columns: Tensor, width: int) -> Tensor:
    """Codes of a grid: row positions (R,), column positions (C,) -> (R · C, width), `width` divisible by 4."""
    by_row = sincos(rows, width // 2).unsqueeze(1).expand(-1, columns.shape[0], -1)
    by_column = sincos(columns, width // 2).unsqueeze(0).expand(rows.shape[0], -1, -1)
    return torch.cat((by_row, by_column), dim=-1).flatten(0, 1)


def token_codes(slots: int, places: Tensor) -> Tensor:
    """Add time to the codes of a grid (P, width): (slots · P, width). The first slot's are an image's."""
    if slots == 1:
        return places
    time = sincos(torch.arange(slots, device=places.device), places.shape[-1])
    return ((time - time[:1]).unsqueeze(1) + places).flatten(0, 1)


class Block(nn.Module):
    """Pre-norm transformer block: self-attention, then an MLP with GELU, both residual.

    (N, L, width) -> (N, L, width).
    """

    def __init__(self, width: int, heads: int, mlp_ratio: float = 4.0) -> None:
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = nn.LayerNorm(width, eps=1e-6), nn.LayerNorm(width, eps=1e-6)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        hidden = int(width * mlp_ratio)
        self.up, self.down = nn.Linear(width, hidden), nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = self.qkv(self.norm1(x)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        x = x + self.out(attention(q, k, v).transpose(1, 2).flatten(-2))
        return x + self.down(F.gelu(self.up(self.norm2(x))))


class Architecture(NamedTuple):
    """Numbers that a `ViT` is built from. They are stored with its weights, which alone rebuild it."""

    height: int
    width_pixels: int
    channels: int
    patch_size: int
    tubelet: int
    width: int
    depth: int
    heads: int
    mlp_ratio: int
    cls: int


class ViT(nn.Module):
    """Vision transformer of images and clips (arXiv:2010.11929), of the visible patches only if asked.

    A token is a patch of `patch_size` × `patch_size` pixels, over `tubelet` frames in clips. Positions are
    fixed sine-cosine codes, space and time added. With `keep`, the pixels of the other patches are not even
    read: attention, MLPs and the patch embedding see the kept tokens alone, so cost falls with them and
    nothing can leak.

    Args:
        image_size: (height, width, channels); both sides multiples of `patch_size`.
        patch_size: pixels of a patch's side.
        tubelet: frames of a token.
        width, depth, heads, mlp_ratio: of the transformer; see `SIZES`.
        cls: put a learned token in front that belongs to no patch.

    Raises:
        ValueError: sizes that do not divide.
    """

    architecture: Tensor
    code: Tensor

    def __init__(
        self,
        *,
        image_size: tuple[int, int, int],
        patch_size: int = 8,
        tubelet: int = 1,
        width: int = 192,
        depth: int = 12,
        heads: int = 3,
        mlp_ratio: int = 4,
        cls: bool = False,
    ) -> None:
        super().__init__()
        rows, columns, channels = image_size
        for name, value in (
            ("patch_size", patch_size),
            ("tubelet", tubelet),
            ("width", width),
            ("depth", depth),
            ("heads", heads),
            ("mlp_ratio", mlp_ratio),
        ):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        if rows % patch_size or columns % patch_size:
            raise ValueError(
                f"patch_size must divide the image's sides, got {patch_size} and {rows} × {columns}"
            )
        if width % heads or width % 4:
            raise ValueError(f"width must be a multiple of 4 and of heads, got {width} and {heads}")
        self.image_size, self.patch_size, self.tubelet = (rows, columns, channels), patch_size, tubelet
        self.width, self.cls = width, cls
        self.grid = (rows // patch_size, columns // patch_size)
        self.num_patches = self.grid[0] * self.grid[1]
        self.patch_embedding = nn.Linear(tubelet * patch_size * patch_size * channels, width)
        self.blocks = nn.ModuleList(Block(width, heads, mlp_ratio) for _ in range(depth))
        self.norm = nn.LayerNorm(width, eps=1e-6)
        initialize(self)
        if cls:
            self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
            nn.init.trunc_normal_(self.cls_token, std=0.02)
        self.numbers = Architecture(
            rows, columns, channels, patch_size, tubelet, width, depth, heads, mlp_ratio, int(cls)
        )
        self.register_buffer("architecture", torch.tensor(self.numbers, dtype=torch.int64))
        places = sincos_grid(torch.arange(self.grid[0]), torch.arange(self.grid[1]), width)
        self.register_buffer("code", places, persistent=False)

    @classmethod
    def from_weights(cls, weights: Mapping[str, Tensor]) -> "ViT":
        """A `ViT` of the architecture that `weights`, its state dict, names, with these weights.

        Raises:
            ValueError: they are those of another one, or not all. Nothing of the size that they claim was built.
        """
        numbers = weights["architecture"].flatten().tolist()
        named = Architecture._fields
        # More layers than weights would take for ever to refuse.
        if (
            len(numbers) != len(named)
            or not all(map(is_whole, numbers))
            or numbers[named.index("depth")] > len(weights)
        ):
            raise ValueError(f"the encoder's architecture must be {', '.join(named)}, got {numbers}")
        with torch.device("meta"):
            wanted = cls.of(Architecture(*numbers)).state_dict()
        for name in {**wanted, **weights}:
            shapes = [tuple(x[name].shape) if name in x else None for x in (weights, wanted)]
            if shapes[0] != shapes[1]:
                said, asked = (shape or "nothing" for shape in shapes)
                raise ValueError(f"the encoder's {name} holds {said} and its architecture asks for {asked}")
        vit = cls.of(Architecture(*numbers))
        vit.load_state_dict(dict(weights))
        return vit

    @classmethod
    def of(cls, built: Architecture) -> "ViT":
        """An untrained `ViT` of this architecture."""
        return cls(
            image_size=(built.height, built.width_pixels, built.channels),
            patch_size=built.patch_size,
            tubelet=built.tubelet,
            width=built.width,
            depth=built.depth,
            heads=built.heads,
            mlp_ratio=built.mlp_ratio,
            cls=bool(built.cls),
        )

    def forward(self, clips: Tensor, keep: Tensor | None = None) -> Tensor:
        """Encode.

        Args:
            clips: images (N, height, width, C) or clips (N, T, height, width, C), uint8; T a multiple of
                `tubelet`. A single image is repeated to fill a tubelet. Images of another size than
                `image_size` are fine if `patch_size` divides their sides: positions are scaled.
            keep: indices (N, n) of the tokens to compute, in any order; time leads, then rows, then columns.
                All when None.

        Returns:
            (N, n, width), or (N, 1 + n, width) with the class token first.

        Raises:
            ValueError: images that are not uint8, or sizes that do not divide.
        """
        if clips.dim() == 4:
            clips = clips.unsqueeze(1).expand(-1, self.tubelet, -1, -1, -1)
        x, code = self._patches(check_images(clips))
        if keep is not None:
            x = x.gather(1, keep.unsqueeze(-1).expand(-1, -1, x.shape[-1]))
            code = code[keep]
        x = x.to(self.patch_embedding.weight.dtype).div(127.5).sub(1.0)
        x = self.patch_embedding(x) + code
        if self.cls:
            x = torch.cat((self.cls_token.expand(x.shape[0], -1, -1), x), dim=1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)

    def positions(self, frames: int, grid: tuple[int, int] | None = None) -> Tensor:
        """Codes of all tokens of a clip, (tokens, width).

        Args:
            frames: number of frames of the clip.
            grid: patches along rows and columns; the codes of another grid than the own are those of its
                places on the same image.
        """
        device = self.code.device
        if grid is None or grid == self.grid:
            space = self.code
        else:
            rows, columns = (
                (torch.arange(n, device=device) + 0.5) * (own / n) - 0.5
                for n, own in zip(grid, self.grid, strict=True)
            )
            space = sincos_grid(rows, columns, self.width)
        return token_codes(frames // self.tubelet, space)

    def _patches(self, clips: Tensor) -> tuple[Tensor, Tensor]:
        """(N, T, height, width, C) -> raw patches (N, tokens, tubelet · patch² · C), and codes."""
        count, frames, height, width, channels = clips.shape
        p, t = self.patch_size, self.tubelet
        if frames % t or height % p or width % p or channels != self.image_size[2]:
            raise ValueError(
                f"clips of {frames} frames of {height} × {width} × {channels} do not divide into tokens of "
                f"{t} frames of {p} × {p} pixels, {self.image_size[2]} channels"
            )
        grid = (height // p, width // p)
        x = clips.reshape(count, frames // t, t, grid[0], p, grid[1], p, channels)
        x = x.permute(0, 1, 3, 5, 2, 4, 6, 7).reshape(count, (frames // t) * grid[0] * grid[1], -1)
        return x, self.positions(frames, grid)


class Size(NamedTuple):
    """Size of a vision transformer."""

    width: int
    depth: int
    heads: int


def vit_size(
    size: str, *, width: int | None = None, depth: int | None = None, heads: int | None = None
) -> Size:
    """The size of this name, with what is given put in its place.

    Raises:
        ValueError: no size has this name.
    """
    if size not in SIZES:
        raise ValueError(f"unknown size {size!r} of a vision transformer; available: {', '.join(SIZES)}")
    w, d, h = SIZES[size]
    return Size(w if width is None else width, d if depth is None else depth, h if heads is None else heads)
