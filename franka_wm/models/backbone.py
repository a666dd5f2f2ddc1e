"""Vision encoders as a grid of tokens: our own, pretrained ones, and those of Hugging Face."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models.images import check_images
from franka_wm.models.vision import Architecture, ConvEncoder, ViT, vit_size
from franka_wm.untrusted import linked_json

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_WEIGHTS = ("model.safetensors", "checkpoints/latest/model.safetensors")
_PREFIXES = ("target_encoder.", "target_encoder.network.", "encoder.", "encoder.network.")


def read_encoder(path: str | Path) -> dict[str, Tensor]:
    """Weights of a pretrained `ViT` from a checkpoint: its state dict, on the CPU.

    Args:
        path: `model.safetensors`, the folder it is in, or a run's folder. Read are the keys under
            `target_encoder.` (a teacher, if there is one) or `encoder.`, or those of a `network` in it.

    Raises:
        ValueError: no such file, not safetensors, or no vision transformer in it.
    """
    given = Path(path).expanduser()
    files = [given] if given.is_file() else [given / name for name in _WEIGHTS if (given / name).is_file()]
    if not files:
        raise ValueError(
            f"encoder_from={path}: neither model.safetensors nor a folder that holds it; give a checkpoint of "
            "a JEPA or another model with a vision transformer"
        )
    try:
        with safe_open(files[0], framework="pt") as weights:
            names = list(weights.keys())
            for prefix in _PREFIXES:
                if prefix + "architecture" in names:
                    own = [name for name in names if name.startswith(prefix)]
                    return {name.removeprefix(prefix): weights.get_tensor(name) for name in own}
    except (SafetensorError, OSError) as error:
        raise ValueError(f"encoder_from={path}: {files[0]} cannot be read: {error}") from error
    raise ValueError(
        f"encoder_from={path}: {files[0]} holds no vision transformer under encoder.; give a checkpoint of a "
        "JEPA, or of another model with one"
    )


class Backbone(nn.Module):
    """Images (N, height, width, C) uint8 -> tokens (N, `tokens`, `width`), one for each cell of a grid.

    Args:
        image_size: (height, width, channels).
        kind: `vit` or `conv`; ignored with `huggingface` or `encoder_from`.
        size, width, depth, heads, patch_size: of a `vit`, see `vit_size`.
        channels: channels of a `conv`.
        grid: tokens are averaged down to this many rows and columns; None: as they are.
        encoder_from: start from this checkpoint, see `read_encoder`; it gives the architecture, too.
        architecture: numbers of an `Architecture`, instead of `size` and so on.
        huggingface: name or folder of a Hugging Face vision model with a grid of tokens or feature maps
            (ViT, DINOv2, CLIP's vision tower, ResNet, ...); needs the extra `[huggingface]`. Only safetensors
            are read and no code of a model's own is run.
        huggingface_config: a model's configuration as a dict, to build it untrained; then nothing is read.
        local_files_only: never ask the Hub.

    Raises:
        ValueError: what cannot be built or read, in one line.
        ModuleNotFoundError: `huggingface` without transformers.
    """

    def __init__(
        self,
        image_size: tuple[int, int, int],
        *,
        kind: str = "vit",
        size: str = "tiny",
        width: int | None = None,
        depth: int | None = None,
        heads: int | None = None,
        patch_size: int = 8,
        channels: int = 32,
        grid: int | None = None,
        encoder_from: str | Path | None = None,
        architecture: Sequence[int] | None = None,
        huggingface: str | None = None,
        huggingface_config: Mapping[str, Any] | None = None,
        local_files_only: bool = False,
    ) -> None:
        super().__init__()
        if (encoder_from is not None) + (huggingface is not None or huggingface_config is not None) > 1:
            raise ValueError("give encoder_from or huggingface, not both")
        if kind not in ("vit", "conv"):
            raise ValueError(f"unknown encoder {kind!r} of images; available: vit, conv")
        if grid is not None and grid < 1:
            raise ValueError(f"grid must be at least 1, got {grid}")
        self.image_size = image_size
        self.network: ViT | ConvEncoder | HuggingFaceEncoder
        if huggingface is not None or huggingface_config is not None:
            self.network = HuggingFaceEncoder(
                image_size, huggingface, config=huggingface_config, local_files_only=local_files_only
            )
            own, self.width = self.network.grid, self.network.width
        elif encoder_from is not None or architecture is not None or kind == "vit":
            if encoder_from is not None:
                weights = read_encoder(encoder_from)
                try:
                    self.network = ViT.from_weights(weights)
                except ValueError as error:
                    raise ValueError(
                        f"encoder_from={encoder_from}: {error}; give another checkpoint"
                    ) from error
            elif architecture is not None:
                self.network = ViT.of(Architecture(*architecture))
            else:
                shape = vit_size(size, width=width, depth=depth, heads=heads)
                self.network = ViT(
                    image_size=image_size,
                    patch_size=patch_size,
                    width=shape.width,
                    depth=shape.depth,
                    heads=shape.heads,
                )
            patch, channels_in = self.network.patch_size, self.network.image_size[2]
            if image_size[0] % patch or image_size[1] % patch or image_size[2] != channels_in:
                raise ValueError(
                    f"the pretrained encoder takes {channels_in} channels and sides that are multiples of "
                    f"{patch} pixels, got images of {image_size}"
                )
            own, self.width = (image_size[0] // patch, image_size[1] // patch), self.network.width
        else:
            self.network = ConvEncoder(image_size, channels=channels)
            own, self.width = self.network.grid, channels
        self.own_grid = own
        self.grid = own if grid is None else (min(grid, own[0]), min(grid, own[1]))
        self.tokens = self.grid[0] * self.grid[1]

    def forward(self, images: Tensor) -> Tensor:
        if isinstance(self.network, ViT):
            x = self.network(images)[:, int(self.network.cls) :]
            x = x.mT.unflatten(-1, self.own_grid)
        else:
            x = self.network.maps(images)
        if self.grid != self.own_grid:
            x = F.adaptive_avg_pool2d(x, self.grid)
        return x.flatten(2).mT

    def rebuild(self) -> dict[str, Any]:
        """Arguments of a model that make it anew from no other file than its weights: JSON-able."""
        if isinstance(self.network, ViT):
            return {"encoder_from": None, "encoder_architecture": self.network.architecture.tolist()}
        if isinstance(self.network, HuggingFaceEncoder):
            return {"huggingface": None, "huggingface_config": self.network.config}
        return {}


class HuggingFaceEncoder(nn.Module):
    """A vision model of the Hugging Face Hub as feature maps; see `Backbone`.

    Images are resized to what the model was trained on and normalised as its `preprocessor_config.json`
    says, or as ImageNet where it has none.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        image_size: tuple[int, int, int],
        name: str | None,
        *,
        config: Mapping[str, Any] | None = None,
        local_files_only: bool = False,
    ) -> None:
        super().__init__()
        try:
            import transformers
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "a Hugging Face backbone needs transformers: pip install 'franka-wm[huggingface]'"
            ) from error
        if image_size[2] != 3:
            raise ValueError(f"a Hugging Face backbone needs images of 3 channels, got {image_size}")
        mean, std = IMAGENET_MEAN, IMAGENET_STD
        if config is not None:
            settings = dict(config)
            kind = settings.pop("model_type")
            model = transformers.AutoModel.from_config(
                transformers.AutoConfig.for_model(kind, **settings), trust_remote_code=False
            )
        else:
            assert name is not None
            try:
                model = transformers.AutoModel.from_pretrained(
                    name, use_safetensors=True, trust_remote_code=False, local_files_only=local_files_only
                )
                mean, std = _normalisation(name, local_files_only)
            except (OSError, ValueError) as error:
                raise ValueError(f"huggingface={name}: {' '.join(str(error).split())}") from error
        model = getattr(model, "vision_model", model)
        self.model: nn.Module = model.float()
        settings = model.config.to_dict()
        self.config: dict[str, Any] = json.loads(json.dumps(settings, default=str))
        self.config["model_type"] = model.config.model_type
        side = settings.get("image_size") or 224
        self.size: tuple[int, int] = (side, side) if isinstance(side, int) else (side[0], side[1])
        self.register_buffer("mean", torch.tensor(mean).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(std).view(1, 3, 1, 1))
        patch = settings.get("patch_size") or 1
        steps = (patch, patch) if isinstance(patch, int) else (patch[0], patch[1])
        self.patches = (self.size[0] // steps[0], self.size[1] // steps[1])
        with torch.no_grad():
            probe = self.maps(torch.zeros(1, *image_size, dtype=torch.uint8))
        self.width, self.grid = probe.shape[1], (probe.shape[2], probe.shape[3])

    def maps(self, images: Tensor) -> Tensor:
        """(N, height, width, 3) uint8 -> feature maps (N, width, rows, columns)."""
        x = check_images(images).permute(0, 3, 1, 2).to(self.mean.dtype).div(255.0)
        if x.shape[-2:] != self.size:
            x = F.interpolate(x, size=self.size, mode="bilinear", antialias=True)
        hidden = self.model(pixel_values=(x - self.mean) / self.std).last_hidden_state
        if hidden.dim() == 4:
            return hidden
        count = self.patches[0] * self.patches[1]
        if hidden.shape[1] < count:
            raise ValueError(
                f"{type(self.model).__name__} gives {hidden.shape[1]} tokens, fewer than its {count} patches: "
                "take a model with one token for each patch, or feature maps"
            )
        # Class and register tokens come first.
        return hidden[:, -count:].mT.unflatten(-1, self.patches)


def _normalisation(name: str, local_files_only: bool) -> tuple[Sequence[float], Sequence[float]]:
    """Mean and standard deviation of the images that the model was trained on."""
    from transformers.utils.hub import cached_file

    file = cached_file(
        name,
        "preprocessor_config.json",
        local_files_only=local_files_only,
        _raise_exceptions_for_missing_entries=False,
    )
    if file is None:
        return IMAGENET_MEAN, IMAGENET_STD
    settings = linked_json(Path(file))
    return settings.get("image_mean", IMAGENET_MEAN), settings.get("image_std", IMAGENET_STD)
