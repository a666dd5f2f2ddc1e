"""Joint-embedding predictive pretraining of vision encoders from images alone: I-JEPA, V-JEPA, LeJEPA."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm import processes
from franka_wm.models.base import WorldModel, summed
from franka_wm.models.ema import ema_update, frozen_copy
from franka_wm.models.images import (
    ImageSize,
    check_image_sizes,
    random_crops,
    shared_image_size,
    stack_cameras,
)
from franka_wm.models.layers import initialize
from franka_wm.models.masks import Sampler, make_masks
from franka_wm.models.regularizers import (
    CollapseGuard,
    CollapseName,
    ProjectionMLP,
    feature_std,
    participation_ratio,
)
from franka_wm.models.vision import (
    Block,
    ViT,
    sincos_grid,
    token_codes,
    vit_size,
)
from franka_wm.models.windows import check_windows
from franka_wm.options import COEFFICIENT, DEPTH, FRACTION, POSITIVE, Bounds

# recipe -> (guard, masks, clips, tubelet): what it takes where nothing else is asked for
RECIPES: dict[str, tuple[CollapseName, str | None, bool, int]] = {
    "ijepa": ("ema", "multiblock", False, 1),
    "vjepa": ("ema", "tube", True, 2),
    "lejepa": ("sigreg", None, False, 1),
}

SIGREG_PLACES = 8
"""Places of an image that SIGReg looks at in an update of a masked recipe, drawn anew each time."""


class JEPA(WorldModel):
    """An encoder of images or clips, trained to predict embeddings instead of pixels. No actions.

    Three recipes:
      * `ijepa` (Assran et al., CVPR 2023, arXiv:2301.08243): from the visible patches of an image, predict
        the embeddings of hidden blocks; smooth L1.
      * `vjepa` (Bardes et al., TMLR 2024, arXiv:2404.08471): likewise on clips with tubes; L1.
      * `lejepa` (Balestriero & LeCun 2025, arXiv:2511.08544): embeddings of large and small crops agree with
        the mean of the large crops' ones; squared error. No predictor, no teacher.

    and four guards against the collapse to a constant, free to combine with any recipe: `ema`, the targets
    come from a slow copy of the encoder, without gradient; `sigreg` and `vicreg`, a regulariser over images
    of the embeddings of each place (of `lejepa`: of each crop), where targets come from the encoder itself
    through an MLP with BatchNorm, with gradient; `none`, to see it collapse. In the masked recipes the encoder
    computes only the tokens that it may see.

    It pretrains: there is `encode`, but no `next`, so nothing plans with it. Its checkpoint is what
    `encoder_from` of the action world model and of TD-MPC2 read.

    Deliberate differences from the papers: numbers of tokens seen and predicted are fixed (see
    `franka_wm.models.masks`); `lejepa` neither flips nor recolours, since left and right matter to a robot;
    its losses are added as prediction + 0.05 · SIGReg instead of 0.95 and 0.05; with `ema`, `lejepa` puts an
    MLP between student and teacher as BYOL does (arXiv:2006.07733).

    Args:
        image_sizes: image key -> (height, width, channels); several cameras of one size share the encoder.
        observation_sizes: must be empty; it reads no vectors.
        action_dim, episode_length: unused, accepted for the common signature.
        recipe: `ijepa`, `vjepa` or `lejepa`.
        collapse: the guard; None: the recipe's (`ema`, `ema`, `sigreg`).
        masks: `multiblock`, `tube`, `temporal` or `random`; None: the recipe's.
        mask_ratio: part of the tokens to predict, for all but `multiblock`; None: the sampler's.
        clips: a window is one clip (True) or H images (False); None: True for `vjepa`.
        tubelet: frames of a token; None: 2 for `vjepa`, else 1.
        encoder_size: `tiny` or `small`; width, depth and heads override it.
        patch_size: pixels.
        predictor_width, predictor_depth, predictor_heads: the predictor of the masked recipes.
        features: `mean` of the tokens, or all of them, `flat`: what `encode` returns.
        ema_start, ema_end, ema_steps: the teacher keeps this part of itself at each update, rising linearly
            over so many updates.
        guard_coef, guard_directions: see `CollapseGuard`.
        projection: width of the embeddings that are predicted for `lejepa`, `sigreg` and `vicreg`, made from
            tokens by an MLP with BatchNorm. A transformer ends with a LayerNorm, which keeps embeddings from
            being centred, and so the guard from spreading them.
        global_views, local_views, global_scale, local_scale: crops of `lejepa` and the range of their area;
            local ones have half the pixels a side.
        weight_decay: weight decay of matrices.

    Raises:
        ValueError: a setting that cannot work.
    """

    ranges: ClassVar[Mapping[str, Bounds]] = {
        **dict.fromkeys(("encoder_width", "encoder_heads", "patch_size", "tubelet"), POSITIVE),
        **dict.fromkeys(("predictor_width", "predictor_heads", "projection"), POSITIVE),
        **dict.fromkeys(("ema_steps", "guard_directions", "global_views"), POSITIVE),
        **dict.fromkeys(("guard_coef", "weight_decay"), COEFFICIENT),
        **dict.fromkeys(("ema_start", "ema_end"), FRACTION),
        "local_views": Bounds(least=0),
        "mask_ratio": Bounds(above=0, below=1),
        **dict.fromkeys(("encoder_depth", "predictor_depth"), DEPTH),
    }

    def __init__(
        self,
        *,
        image_sizes: Mapping[str, ImageSize] | None = None,
        observation_sizes: Mapping[str, int] | None = None,
        action_dim: int | None = None,
        episode_length: int | None = None,
        recipe: Literal["ijepa", "vjepa", "lejepa"] = "ijepa",
        collapse: CollapseName | None = None,
        masks: str | None = None,
        mask_ratio: float | None = None,
        clips: bool | None = None,
        tubelet: int | None = None,
        encoder_size: str = "tiny",
        encoder_width: int | None = None,
        encoder_depth: int | None = None,
        encoder_heads: int | None = None,
        patch_size: int = 8,
        predictor_width: int = 192,
        predictor_depth: int = 6,
        predictor_heads: int = 6,
        features: Literal["mean", "flat"] = "mean",
        ema_start: float = 0.996,
        ema_end: float = 1.0,
        ema_steps: int = 100_000,
        guard_coef: float | None = None,
        guard_directions: int = 1024,
        projection: int = 64,
        global_views: int = 2,
        local_views: int = 6,
        global_scale: tuple[float, float] = (0.3, 1.0),
        local_scale: tuple[float, float] = (0.05, 0.3),
        weight_decay: float = 0.05,
    ) -> None:
        self.validate(locals())
        super().__init__()
        if observation_sizes:
            raise ValueError(
                f"JEPA reads images only, got vectors {', '.join(observation_sizes)}: set observations=[pixels]"
            )
        if ema_start > ema_end:
            raise ValueError(f"ema_start must be at most ema_end, got {ema_start} and {ema_end}")
        self.image_sizes = check_image_sizes(image_sizes)
        size = shared_image_size(self.image_sizes)
        guard, sampler, as_clips, own_tubelet = RECIPES[recipe]
        self.recipe, self.features, self.weight_decay = recipe, features, weight_decay
        self.collapse = guard if collapse is None else collapse
        self.clips = as_clips if clips is None else clips
        self.masks, self.mask_ratio = sampler if masks is None else masks, mask_ratio
        self.ema_start, self.ema_end, self.ema_steps = ema_start, ema_end, ema_steps
        shape = vit_size(encoder_size, width=encoder_width, depth=encoder_depth, heads=encoder_heads)
        self.encoder = ViT(
            image_size=size,
            patch_size=patch_size,
            tubelet=own_tubelet if tubelet is None else tubelet,
            width=shape.width,
            depth=shape.depth,
            heads=shape.heads,
        )
        width = self.encoder.width
        if not self.clips and self.encoder.tubelet > 1:
            raise ValueError("tubelet > 1 needs clips=true")
        self.guard = CollapseGuard(self.collapse, coef=guard_coef, directions=guard_directions)
        projects = recipe == "lejepa" or self.guard.acts
        self.projector = ProjectionMLP(width, projection) if projects else None
        self.predictor = None
        if recipe == "lejepa":
            if masks is not None:
                raise ValueError("the recipe lejepa crops instead of masking: leave masks at null")
            for name, (low, high) in (("global_scale", global_scale), ("local_scale", local_scale)):
                if not 0.0 < low <= high <= 1.0:
                    raise ValueError(f"{name} must be a range within (0, 1], got [{low}, {high}]")
            self.views = (
                (global_views, (global_scale[0], global_scale[1])),
                (local_views, (local_scale[0], local_scale[1])),
            )
            half = [max(patch_size, n // 2 // patch_size * patch_size) for n in size[:2]]
            self.view_sizes = (size[:2], (half[0], half[1]))
            if self.collapse == "ema":
                self.predictor = ProjectionMLP(projection, projection)
        else:
            self.predictor = MaskedPredictor(
                self.encoder,
                outputs=projection if projects else width,
                width=predictor_width,
                depth=predictor_depth,
                heads=predictor_heads,
            )
        self.target_encoder = self.target_projector = None
        if self.collapse == "ema":
            self.target_encoder = frozen_copy(self.encoder)
            if recipe == "lejepa":
                assert self.projector is not None
                self.target_projector = frozen_copy(self.projector)
        self.register_buffer("updates", torch.zeros(()))
        if recipe != "lejepa":
            # Fails here, not at the first update, if the sampler does not fit; clips may have any length later.
            self._sampler(2 * self.encoder.tubelet if self.clips else 1)
        tokens = self.encoder.num_patches if features == "flat" else 1
        self.latent_dim = width * tokens * len(self.image_sizes)

    updates: Tensor

    # ------------------------------------------------------------------ what probes and dynamics use

    @torch.no_grad()
    def encode(self, observation: TensorDictBase) -> Tensor:
        """Images (..., height, width, C) uint8 of each key -> features (..., latent_dim), float.

        Of the teacher where there is one, as published, else of the encoder. No gradient.
        """
        images = stack_cameras(observation, self.image_sizes)
        leading = images.shape[:-3]
        tokens = self.best_encoder(images.reshape(-1, *images.shape[-3:]))
        x = tokens.mean(1) if self.features == "mean" else tokens.flatten(1)
        return x.reshape(*leading, -1).flatten(-2)

    @property
    def best_encoder(self) -> ViT:
        """The encoder to use after training: the teacher where there is one."""
        return self.encoder if self.target_encoder is None else self.target_encoder

    # ------------------------------------------------------------------ training

    def loss(self, batch: TensorDictBase) -> TensorDict:
        """Loss of a batch of windows; call `backward` once on the entry `loss`.

        Args:
            batch: batch size [B, H], with the image keys (B, H, height, width, C). Only the root is read:
                neither `next` nor actions are needed. With `clips`, the first frames of a window, as many as
                fill whole tubelets, are one clip; otherwise every frame is an image of its own.

        Returns:
            batch size []: `loss`, and detached `loss_prediction`, `loss_guard` (weighted), `feature_std` and
            `feature_rank` (participation ratio) of the pooled embeddings over the batch, `ema`.

        Raises:
            ValueError: the batch size is not [B, H], or windows shorter than a tubelet.
        """
        check_windows(batch)
        clips = self._as_clips(batch)
        step = self._loss_of_views if self.recipe == "lejepa" else self._loss_of_masks
        prediction, guard, pooled = step(clips)
        with torch.no_grad():
            metrics = {
                "loss_prediction": prediction.detach(),
                "loss_guard": guard.detach(),
                "feature_std": feature_std(pooled),
                "feature_rank": participation_ratio(pooled),
                "ema": self.ema(),
            }
        return TensorDict({"loss": summed(prediction, guard), **metrics}, batch_size=[])

    def ema(self) -> Tensor:
        """Share () that the teacher keeps of itself at the next update, on the device."""
        part = (self.updates / self.ema_steps).clamp(max=1.0)
        return self.ema_start + (self.ema_end - self.ema_start) * part

    @torch.no_grad()
    def after_update(self) -> None:
        """Move the teacher; call once after each optimiser step."""
        if self.target_encoder is not None:
            ema_update(self.target_encoder, self.encoder, self.ema())
        if self.target_projector is not None and self.projector is not None:
            ema_update(self.target_projector, self.projector, self.ema())
        self.updates.add_(1.0)

    # ------------------------------------------------------------------ pieces

    def _as_clips(self, batch: TensorDictBase) -> Tensor:
        """(N, T, height, width, C) from windows [B, H]: each camera's clip, or image, by itself."""
        images = stack_cameras(batch, self.image_sizes)  # (B, H, V, height, width, C)
        if not self.clips:
            return images.flatten(0, 2).unsqueeze(1)
        tubelet = self.encoder.tubelet
        frames = images.shape[1] // tubelet * tubelet
        if frames == 0:
            raise ValueError(f"clips need windows of at least {tubelet} frames, got {images.shape[1]}")
        return images[:, :frames].transpose(1, 2).flatten(0, 1)

    def _sampler(self, frames: int) -> Sampler:
        assert self.masks is not None
        options = {} if self.mask_ratio is None or self.masks == "multiblock" else {"ratio": self.mask_ratio}
        return make_masks(self.masks, (frames // self.encoder.tubelet, *self.encoder.grid), **options)

    def _loss_of_masks(self, clips: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        masks = self._sampler(clips.shape[1])(clips.shape[0], clips.device)
        context = self.encoder(clips, masks.context)
        if self.target_encoder is None:
            full = self.encoder(clips)
            if self.projector is not None:
                full = self._project(self.projector, full)
        else:
            with torch.no_grad():
                full = self.target_encoder(clips)
        # Without scale or shift: a feature cannot win by being large.
        full = F.layer_norm(full.float(), full.shape[-1:])
        index = masks.targets.flatten(1).unsqueeze(-1).expand(-1, -1, full.shape[-1])
        target = full.gather(1, index).unflatten(1, masks.targets.shape[1:])
        assert isinstance(self.predictor, MaskedPredictor)
        predicted = self.predictor(context, masks.context, masks.targets, clips.shape[1]).float()
        distance = F.l1_loss if self.recipe == "vjepa" else F.smooth_l1_loss
        prediction = distance(predicted, target)
        # On what is predicted: on a projection of it, the guard would not see it collapse. Of every place of every
        # camera: what differs from place to place only is the same in all images.
        places = full.unflatten(0, (-1, len(self.image_sizes))).permute(1, 2, 0, 3)  # (cameras, tokens, n, P)
        if self.guard.kind == "sigreg":  # costly: some places in each update, the same ones in all processes
            drawn = torch.randint(places.shape[1], (SIGREG_PLACES,), device=places.device)
            places = places[:, processes.broadcast(drawn)]
        return prediction, self.guard(places), full.mean(1)

    def _loss_of_views(self, clips: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        assert self.projector is not None
        crops = [
            random_crops(clips, count, scale, size)
            for (count, scale), size in zip(self.views, self.view_sizes, strict=True)
            if count
        ]
        pooled = [self.encoder(c.flatten(0, 1)).mean(1).unflatten(0, c.shape[:2]) for c in crops]
        embedded = self._project(self.projector, torch.cat(pooled)).float()  # (views, N, P)
        count = crops[0].shape[0]
        if self.target_encoder is None:
            centre = embedded[:count].mean(0)
            prediction = F.mse_loss(embedded, centre.expand_as(embedded))
        else:
            assert self.target_projector is not None and isinstance(self.predictor, ProjectionMLP)
            with torch.no_grad():
                slow = self.target_encoder(crops[0].flatten(0, 1)).mean(1).unflatten(0, crops[0].shape[:2])
                centre = self._project(self.target_projector, slow).float().mean(0)
            predicted = self._project(self.predictor, embedded)
            prediction = (
                F.mse_loss(F.normalize(predicted, dim=-1), F.normalize(centre, dim=-1).expand_as(predicted))
                * predicted.shape[-1]
            )
        return prediction, self.guard(embedded), pooled[0][0].float()

    def _project(self, projector: ProjectionMLP, x: Tensor) -> Tensor:
        return projector(x, batch_statistics=self.training)


class MaskedPredictor(nn.Module):
    """Predicts the embeddings of hidden tokens from those of visible ones (I-JEPA, section 3).

    A narrow transformer over the visible tokens and one mask token, with its position, for each token asked
    for. Groups of targets are predicted independently of each other.

    Args:
        encoder: encoder whose tokens it reads; only its sizes are used.
        outputs: size P of the embeddings that it predicts.
        width, depth, heads: sizes of the predictor.
    """

    space: Tensor

    def __init__(self, encoder: ViT, *, outputs: int, width: int, depth: int, heads: int) -> None:
        super().__init__()
        if width % heads or width % 4:
            raise ValueError(
                f"predictor_width must be a multiple of 4 and of predictor_heads, got {width} and {heads}"
            )
        self.tubelet = encoder.tubelet
        self.enter, self.leave = nn.Linear(encoder.width, width), nn.Linear(width, outputs)
        self.mask_token = nn.Parameter(torch.zeros(width))
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(width, eps=1e-6)
        initialize(self)
        nn.init.trunc_normal_(self.mask_token, std=0.02)
        rows, columns = (torch.arange(n) for n in encoder.grid)
        self.register_buffer("space", sincos_grid(rows, columns, width), persistent=False)

    def forward(self, context: Tensor, seen: Tensor, targets: Tensor, frames: int) -> Tensor:
        """Context tokens (N, n, W) at `seen` (N, n), `targets` (N, M, k) -> embeddings (N, M, k, P)."""
        count, groups, asked = targets.shape
        code = token_codes(frames // self.tubelet, self.space)
        x = self.enter(context) + code[seen]
        x = x.unsqueeze(1).expand(-1, groups, -1, -1).flatten(0, 1)
        x = torch.cat((x, self.mask_token + code[targets.flatten(0, 1)]), dim=1)
        for block in self.blocks:
            x = block(x)
        return self.leave(self.norm(x[:, -asked:])).unflatten(0, (count, groups))
