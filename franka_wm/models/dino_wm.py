"""DINO-WM: dynamics over the patches of a frozen pretrained encoder (Zhou et al., ICML 2025, arXiv:2411.04983)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models.backbone import Backbone
from franka_wm.models.base import summed
from franka_wm.models.history import FrameHistory, HistoryWorldModel
from franka_wm.models.images import ImageSize, check_image_sizes, shared_image_size, stack_cameras
from franka_wm.models.normalizer import ObservationNormalizer
from franka_wm.models.transformer import CausalTransformer, block_causal_mask, hide_invalid
from franka_wm.models.windows import check_windows, window_of
from franka_wm.options import COEFFICIENT, DEPTH, POSITIVE, Bounds


class DINOWM(HistoryWorldModel):
    """Predict the patches of the next frame from those of the last `history` frames, actions and the robot's state.

    The encoder is pretrained and never trained here: DINOv2 by its name on the Hugging Face Hub, or the vision
    transformer of a checkpoint. Action and state are embedded and appended to the features of every patch of their
    frame. A transformer reads all patches; each attends to those of its own and earlier frames. loss = mean squared
    error of the next frame's patches, teacher-forced, and of its state.

    z holds the last `history` frames (patches, then state), the actions between them and who is real, see
    `franka_wm.models.history`. Distances to a goal are measured on `embed(z)`, the newest frame's patches: use
    `objective.metric=l2`, as published.

    Deliberate differences from the paper:
      * The predictor outputs the change of the patches, so that it starts as "nothing changes"; positions in time are
        rotary.
      * The state itself is predicted, from the mean of a frame's patches, instead of an embedding of it.
      * Patches may be averaged to a coarser `grid`, since z holds them for every candidate of a planner.
      * No decoder: `franka_wm.evaluation` trains one for looking at what is imagined.

    Args:
        image_sizes: image key -> (height, width, channels); several of one size share the encoder.
        observation_sizes: vector key -> size; the robot's state. May be empty.
        action_dim: size of an action.
        episode_length: unused, accepted for the common signature.
        huggingface, huggingface_config, local_files_only: see `Backbone`.
        encoder_from: take the encoder of this checkpoint (a JEPA's, say), see `read_encoder`.
        encoder_architecture: see `Backbone`; only to rebuild from a checkpoint.
        grid: average the patches to this many rows and columns; None: as they are.
        history: frames that the predictor sees.
        predictor_depth, predictor_heads, predictor_head_dim, predictor_mlp, dropout: of the transformer.
        action_embed_dim, state_embed_dim: what is appended to each patch.
        weight_decay: of matrices.

    Raises:
        ValueError: a setting that cannot work, or no pretrained encoder.
        ModuleNotFoundError: `huggingface` without transformers.
    """

    pretrained = True
    ranges: ClassVar[Mapping[str, Bounds]] = {
        **dict.fromkeys(("action_dim", "grid", "history", "predictor_heads", "predictor_head_dim"), POSITIVE),
        **dict.fromkeys(("predictor_mlp", "action_embed_dim", "state_embed_dim"), POSITIVE),
        "predictor_depth": DEPTH,
        "dropout": Bounds(least=0, below=1),
        "weight_decay": COEFFICIENT,
    }

    def __init__(
        self,
        *,
        image_sizes: Mapping[str, ImageSize] | None = None,
        observation_sizes: Mapping[str, int] | None = None,
        action_dim: int,
        episode_length: int | None = None,
        huggingface: str | None = None,
        huggingface_config: Mapping[str, Any] | None = None,
        local_files_only: bool = False,
        encoder_from: str | Path | None = None,
        encoder_architecture: Sequence[int] | None = None,
        grid: int | None = None,
        history: int = 3,
        predictor_depth: int = 6,
        predictor_heads: int = 16,
        predictor_head_dim: int = 64,
        predictor_mlp: int = 2048,
        dropout: float = 0.1,
        action_embed_dim: int = 10,
        state_embed_dim: int = 10,
        weight_decay: float = 0.0,
    ) -> None:
        self.validate(locals())
        super().__init__()
        given = (huggingface, huggingface_config, encoder_from, encoder_architecture)
        if all(one is None for one in given):
            raise ValueError("give huggingface or encoder_from: it needs a pretrained encoder")
        self.image_sizes = check_image_sizes(image_sizes)
        self.vectors = ObservationNormalizer(observation_sizes)
        self.observation_sizes, self.action_dim = self.vectors.sizes, action_dim
        self.weight_decay = weight_decay
        self.encoder = Backbone(
            shared_image_size(self.image_sizes),
            grid=grid,
            encoder_from=encoder_from,
            architecture=encoder_architecture,
            huggingface=huggingface,
            huggingface_config=huggingface_config,
            local_files_only=local_files_only,
        )
        self.encoder.requires_grad_(False).eval()
        self.patches, self.patch_dim = len(self.image_sizes) * self.encoder.tokens, self.encoder.width
        self.feature_dim, self.state_dim = self.patches * self.patch_dim, self.vectors.size
        self.history = FrameHistory(
            length=history, frame_dim=self.feature_dim + self.state_dim, action_dim=action_dim
        )
        self.latent_dim = self.history.size

        self.embed_action = nn.Linear(action_dim, action_embed_dim)
        self.embed_state = nn.Linear(self.state_dim, state_embed_dim) if self.state_dim else None
        width = self.patch_dim + action_embed_dim + (state_embed_dim if self.state_dim else 0)
        self.place = nn.Parameter(0.02 * torch.randn(self.patches, width))
        self.predictor = CausalTransformer(
            width=width,
            depth=predictor_depth,
            heads=predictor_heads,
            head_dim=predictor_head_dim,
            hidden=predictor_mlp,
            dropout=dropout,
        )
        self.leave = nn.Linear(width, self.patch_dim + self.state_dim)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def train(self, mode: bool = True) -> DINOWM:
        """Set the mode; the encoder stays in evaluation mode."""
        super().train(mode)
        self.encoder.eval()
        return self

    def rebuild_overrides(self) -> dict[str, Any]:
        """Constructor arguments that replace those which read other files: JSON-able."""
        return self.encoder.rebuild()

    # ------------------------------------------------------------------ what a planner uses

    def encode_frame(self, observation: TensorDictBase, *, batch_statistics: bool = False) -> Tensor:
        patches = self._patches(observation)
        return torch.cat((patches, self.vectors(observation)), -1) if self.state_dim else patches

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """Next z (..., latent_dim) after actions (..., action_dim) in z (..., latent_dim)."""
        frame = self._predict(*self.unpack(z, action))[:, -1]
        return self.history.push(z, action, frame.view(*z.shape[:-1], -1))

    def encode_goal(self, observation: TensorDictBase) -> Tensor:
        """Patches (..., feature_dim) of a goal's images."""
        return self._patches(observation)

    # ------------------------------------------------------------------ training

    def loss(self, batch: TensorDictBase) -> TensorDict:
        """Loss of a batch of windows; call `backward` once on the entry `loss`.

        Args:
            batch: batch size [B, H]: H contiguous transitions of one episode, with the observation keys,
                `action` (B, H, A), and in `next` the observation keys, of which only the last is read.

        Returns:
            batch size []: `loss`, and detached `loss_prediction` (patches), `loss_state` and `relative_error` (of the
            predicted patches over that of predicting no change).

        Raises:
            ValueError: the batch size is not [B, H].
        """
        check_windows(batch)
        frames = self.encode_frame(window_of(batch, self.observation_keys)).float()  # (B, H+1, F)
        cut = self.history.windows
        before, after, actions = cut(frames[:, :-1]), cut(frames[:, 1:]), cut(batch.get("action"))
        predicted = self._predict(before, actions, None, dropout=self.training)
        f = self.feature_dim
        prediction = F.mse_loss(predicted[..., :f], after[..., :f])
        state = F.mse_loss(predicted[..., f:], after[..., f:]) if self.state_dim else prediction.new_zeros(())
        with torch.no_grad():
            unchanged = F.mse_loss(before[..., :f], after[..., :f])
            metrics = {
                "loss_prediction": prediction.detach(),
                "loss_state": state.detach(),
                "relative_error": prediction.detach() / unchanged.clamp_min(1e-12),
            }
        return TensorDict({"loss": summed(prediction, state), **metrics}, batch_size=[])

    # ------------------------------------------------------------------ pieces

    @torch.no_grad()
    def _patches(self, observation: TensorDictBase) -> Tensor:
        """The encoder's patches of all images, flattened (..., feature_dim)."""
        images = stack_cameras(observation, self.image_sizes)
        return self.encoder(images.flatten(0, -4)).reshape(*images.shape[:-4], self.feature_dim)

    def _predict(
        self, frames: Tensor, actions: Tensor, valid: Tensor | None, *, dropout: bool = False
    ) -> Tensor:
        """Frames (N, K, F), the action taken at each (N, K, A) -> the frame after each (N, K, F).

        Args:
            valid: (N, K), 1 where the frame is real; None: all are.
        """
        steps = frames.shape[1]
        patches = frames[..., : self.feature_dim].unflatten(-1, (self.patches, self.patch_dim))
        state = frames[..., self.feature_dim :]
        beside = [self.embed_action(actions.to(frames.dtype))]
        if self.embed_state is not None:
            beside.append(self.embed_state(state))
        appended = torch.cat(beside, dim=-1).unsqueeze(2).expand(-1, -1, self.patches, -1)
        x = (torch.cat((patches, appended), dim=-1) + self.place).flatten(1, 2)
        mask = block_causal_mask(steps, self.patches, device=x.device)
        if valid is not None:
            mask = hide_invalid(mask, valid, self.patches)
        time = torch.arange(steps, device=x.device).repeat_interleave(self.patches)
        x = self.predictor(x, time, mask, dropout=dropout).unflatten(1, (steps, self.patches))
        change = self.leave(x)
        after = (patches + change[..., : self.patch_dim]).flatten(-2)
        if not self.state_dim:
            return after
        return torch.cat((after, state + change[..., self.patch_dim :].mean(2)), dim=-1)
