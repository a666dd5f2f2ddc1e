"""Action world model: dynamics over the tokens of a pretrained encoder (V-JEPA 2-AC, arXiv:2506.09985)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models.backbone import Backbone
from franka_wm.models.base import summed
from franka_wm.models.ema import ema_update, frozen_copy
from franka_wm.models.groups import ParameterGroup, decay_groups
from franka_wm.models.history import FrameHistory, HistoryWorldModel
from franka_wm.models.images import ImageSize, check_image_sizes, shared_image_size, stack_cameras
from franka_wm.models.layers import mlp, unit_gain
from franka_wm.models.normalizer import ObservationNormalizer
from franka_wm.models.regularizers import (
    CollapseGuard,
    CollapseName,
    ProjectionMLP,
    feature_std,
    participation_ratio,
)
from franka_wm.models.transformer import MLPDynamics, TokenDynamics
from franka_wm.models.windows import check_windows, window_of, with_future
from franka_wm.options import COEFFICIENT, DEPTH, FRACTION, POSITIVE, Bounds


class ActionWorldModel(HistoryWorldModel):
    """Predict the encoder's tokens of the next frame from frames, actions and the robot's own state
    (V-JEPA 2-AC: Assran et al. 2025, arXiv:2506.09985).

    The encoder, usually pretrained, is frozen or trained along. Its tokens are layer-normed; the dynamics, a
    block-causal transformer over [action, state, tokens] of the last `history` frames, predicts those of the
    next frame, and the next state. loss = mean absolute error, teacher-forced, plus that of a short rollout
    in which predictions are fed back.

    z holds the last `history` frames (tokens, then state), the actions between them and who is real, see
    `franka_wm.models.history`. Distances to a goal are measured on `embed(z)`, the newest frame's tokens.

    An encoder that is trained along needs a guard against collapse, `collapse`; with a frozen one there is
    nothing to collapse and none acts. For `sigreg` and `vicreg` its tokens first go through an MLP with
    BatchNorm, as in LeWorldModel: a transformer ends with a LayerNorm, which keeps embeddings from being
    centred, and so the guard from spreading them.

    Deliberate differences: a small predictor (the paper's has 300 M parameters, 24 layers of width 1024), which
    predicts the change of the tokens, so that it starts as "nothing changes"; the tokens may be averaged to
    a coarser grid, since z holds them for every candidate of a planner.

    Args:
        image_sizes: image key -> (height, width, channels); several of one size share the encoder. Empty
            for `encoder=state`.
        observation_sizes: vector key -> size. The state token next to images; what is encoded for
            `encoder=state`. May be empty next to images.
        action_dim: size of an action.
        episode_length: of distances to goals an episode away.
        encoder: `vit`, `conv` or `state`.
        encoder_size, encoder_width, encoder_depth, encoder_heads, patch_size: sizes of `vit`.
        channels: channels of `conv`.
        state_embed_dim, state_hidden_dim: of `state`: its token and the two hidden layers before it.
        encoder_from: take the encoder of this checkpoint (a JEPA's, say), see `read_encoder`.
        encoder_architecture: see `Backbone`; only to rebuild from a checkpoint.
        huggingface, huggingface_config, local_files_only: see `Backbone`.
        freeze_encoder: None: frozen if it is pretrained.
        grid: average the tokens to this many rows and columns; None: as they are.
        history: frames that the dynamics sees.
        predictor: `transformer` or `mlp`.
        predictor_width, predictor_depth, predictor_heads, dropout: options of `transformer`.
        predictor_hidden_dim: width of the three hidden layers of `mlp`.
        rollout: steps of the rollout; 1: teacher forcing alone.
        collapse: `ema`, `sigreg`, `vicreg` or `none`, for an encoder that is trained along.
        guard_coef, guard_directions: see `CollapseGuard`.
        ema: share that the teacher keeps of itself at each update.
        encoder_lr_scale: learning rate of the encoder relative to the rest.
        weight_decay: weight decay of matrices.
        goal_policy_coef, goal_steps_coef: weights of a policy towards goals and of a distance to them in steps, see
            `franka_wm.models.goal_heads.GoalHeads`.

    Raises:
        ValueError: a setting that cannot work.
        ModuleNotFoundError: `huggingface` without transformers.
    """

    has_goal_policy = True  # by options, see `learn_goals`
    has_goal_steps = True
    ranges: ClassVar[Mapping[str, Bounds]] = {
        **dict.fromkeys(("action_dim", "encoder_width", "encoder_heads", "patch_size"), POSITIVE),
        **dict.fromkeys(("channels", "state_embed_dim", "state_hidden_dim", "grid", "history"), POSITIVE),
        **dict.fromkeys(("predictor_width", "predictor_heads"), POSITIVE),
        **dict.fromkeys(("predictor_hidden_dim", "rollout", "guard_directions"), POSITIVE),
        **dict.fromkeys(("guard_coef", "weight_decay", "encoder_lr_scale"), COEFFICIENT),
        **dict.fromkeys(("goal_policy_coef", "goal_steps_coef"), COEFFICIENT),
        "ema": FRACTION,
        "dropout": Bounds(least=0, below=1),
        **dict.fromkeys(("encoder_depth", "predictor_depth"), DEPTH),
    }

    def __init__(
        self,
        *,
        image_sizes: Mapping[str, ImageSize] | None = None,
        observation_sizes: Mapping[str, int] | None = None,
        action_dim: int,
        episode_length: int | None = None,
        encoder: Literal["vit", "conv", "state"] = "vit",
        encoder_size: str = "tiny",
        encoder_width: int | None = None,
        encoder_depth: int | None = None,
        encoder_heads: int | None = None,
        patch_size: int = 8,
        channels: int = 32,
        state_embed_dim: int = 128,
        state_hidden_dim: int = 256,
        encoder_from: str | Path | None = None,
        encoder_architecture: Sequence[int] | None = None,
        huggingface: str | None = None,
        huggingface_config: Mapping[str, Any] | None = None,
        local_files_only: bool = False,
        freeze_encoder: bool | None = None,
        grid: int | None = 4,
        history: int = 2,
        predictor: Literal["transformer", "mlp"] = "transformer",
        predictor_width: int = 256,
        predictor_depth: int = 6,
        predictor_heads: int = 8,
        predictor_hidden_dim: int = 512,
        dropout: float = 0.0,
        rollout: int = 2,
        collapse: CollapseName = "sigreg",
        guard_coef: float | None = None,
        guard_directions: int = 1024,
        ema: float = 0.996,
        encoder_lr_scale: float = 1.0,
        weight_decay: float = 0.04,
        goal_policy_coef: float = 0.0,
        goal_steps_coef: float = 0.0,
    ) -> None:
        self.validate(locals())
        super().__init__()
        self.vectors = ObservationNormalizer(observation_sizes)
        self.observation_sizes, self.action_dim = self.vectors.sizes, action_dim
        self.rollout, self.ema = rollout, ema
        self.encoder_lr_scale, self.weight_decay = encoder_lr_scale, weight_decay
        pretrained = encoder_from is not None or huggingface is not None
        self.encoder: nn.Module
        if encoder == "state":
            if image_sizes or pretrained:
                raise ValueError("encoder=state reads vectors only: take no images, or encoder=vit or conv")
            if not self.observation_sizes:
                raise ValueError("encoder=state needs observation_sizes: set observations=[state]")
            hidden = (state_hidden_dim, state_hidden_dim)
            self.encoder = unit_gain(mlp(self.vectors.size, hidden, state_embed_dim))
            places, self.token_dim, views, self.state_dim = 1, state_embed_dim, 1, 0
        else:
            self.image_sizes = check_image_sizes(image_sizes)
            self.encoder = Backbone(
                shared_image_size(self.image_sizes),
                kind=encoder,
                size=encoder_size,
                width=encoder_width,
                depth=encoder_depth,
                heads=encoder_heads,
                patch_size=patch_size,
                channels=channels,
                grid=grid,
                encoder_from=encoder_from,
                architecture=encoder_architecture,
                huggingface=huggingface,
                huggingface_config=huggingface_config,
                local_files_only=local_files_only,
            )
            views, self.state_dim = len(self.image_sizes), self.vectors.size
            places, self.token_dim = self.encoder.tokens, self.encoder.width
        self.tokens = views * places
        self.feature_dim = self.tokens * self.token_dim
        self.frozen = pretrained if freeze_encoder is None else freeze_encoder
        if self.frozen:
            self.encoder.requires_grad_(False).eval()
        self.history = FrameHistory(
            length=history, frame_dim=self.feature_dim + self.state_dim, action_dim=action_dim
        )
        self.latent_dim = self.history.size
        if predictor == "mlp":
            self.dynamics: MLPDynamics | TokenDynamics = MLPDynamics(
                history_dim=self.history.size,
                frame_dim=self.history.frame_dim,
                action_dim=action_dim,
                hidden=(predictor_hidden_dim,) * 3,
            )
        else:
            self.dynamics = TokenDynamics(
                tokens=self.tokens,
                token_dim=self.token_dim,
                state_dim=self.state_dim,
                action_dim=action_dim,
                width=predictor_width,
                depth=predictor_depth,
                heads=predictor_heads,
                dropout=dropout,
            )
        # A frozen encoder cannot collapse; nothing guards it.
        self.guard = CollapseGuard(
            "none" if self.frozen else collapse, coef=guard_coef, directions=guard_directions
        )
        self.adapter = ProjectionMLP(self.token_dim, self.token_dim) if self.guard.acts else None
        self.target_encoder = frozen_copy(self.encoder) if self.guard.kind == "ema" else None
        goals: Any = {"policy": goal_policy_coef, "steps": goal_steps_coef}
        self.learn_goals(**goals, episode_length=episode_length)

    def train(self, mode: bool = True) -> ActionWorldModel:
        """Set the mode; a frozen encoder stays in evaluation mode."""
        super().train(mode)
        if self.frozen:
            self.encoder.eval()
        return self

    def rebuild_overrides(self) -> dict[str, Any]:
        """Constructor arguments that replace those which read other files, so that the model's own weights
        rebuild it: JSON-able."""
        own = self.encoder.rebuild() if isinstance(self.encoder, Backbone) else {}
        return {"freeze_encoder": self.frozen} | own

    # ------------------------------------------------------------------ what a planner uses

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """Next z (..., latent_dim) after actions (..., action_dim) in z (..., latent_dim)."""
        if isinstance(self.dynamics, MLPDynamics):
            frame = self._normalise(self.dynamics(z, self.history.last(z), action.to(z.dtype)))
            return self.history.push(z, action, frame)
        frame = self._normalise(self.dynamics(*self.unpack(z, action))[:, -1])
        return self.history.push(z, action, frame.view(*z.shape[:-1], -1))

    def encode_goal(self, observation: TensorDictBase) -> Tensor:
        """The tokens (..., feature_dim) of a goal: of its images, or of its state vectors for
        `encoder=state`."""
        return self._features(observation)

    # ------------------------------------------------------------------ training

    def loss(self, batch: TensorDictBase) -> TensorDict:
        """Loss of a batch of windows; call `backward` once on the entry `loss`.

        Args:
            batch: batch size [B, H]: H contiguous transitions of one episode, with the observation keys,
                `action` (B, H, A), and in `next` the observation keys, of which only the last is read.

        Returns:
            batch size []: `loss`, and detached `loss_prediction` (teacher forcing), `loss_rollout`,
            `loss_state`, `loss_guard` (weighted), `relative_error` (absolute error of the teacher-forced
            tokens over that of predicting no change), `feature_std` and `feature_rank` (participation ratio);
            `loss_goal_policy` and `loss_goal_steps` where asked for.

        Raises:
            ValueError: the batch size is not [B, H].
        """
        check_windows(batch)
        action = batch.get("action")
        window = window_of(batch, self.observation_keys)
        seen = window if self.goal_heads is None else with_future(window, batch)
        encoded = self.encode_frame(seen, batch_statistics=self.training).float()
        frames = encoded[:, : action.shape[1] + 1]  # (B, H+1, F)
        if self.target_encoder is None:
            targets = frames
        else:
            with torch.no_grad():
                targets = self._join(self._normed(self._tokens(self.target_encoder, window)), window).float()

        before = frames[:, :-1]
        if isinstance(self.dynamics, MLPDynamics):
            predicted = self.dynamics(self.history.gather(before, action), before, action.to(before.dtype))
            after = targets[:, 1:]
        else:
            cut = self.history.windows
            before, after, actions = cut(before), cut(targets[:, 1:]), cut(action)
            predicted = self.dynamics(before, actions, None, dropout=self.training)
        prediction, state = self._distance(self._normalise(predicted), after)
        # The same with predictions fed back, at the end of the windows.
        rolled, rolled_state = self._rollout_loss(frames, targets, action)
        # On what is predicted: on a projection of it, the guard would not see it collapse.
        guard = self.guard(self._pooled(frames).transpose(0, 1))
        goals = self.goal_losses(encoded, batch)
        total = summed(prediction, state, rolled, rolled_state, guard, *goals.values())
        with torch.no_grad():
            unchanged, _ = self._distance(before, after)
            metrics = {
                "loss_prediction": prediction.detach(),
                "loss_rollout": rolled.detach(),
                "loss_state": (state + rolled_state).detach(),
                "loss_guard": guard.detach(),
                "relative_error": prediction.detach() / unchanged.clamp_min(1e-12),
                "feature_std": feature_std(frames[..., : self.feature_dim]),
                "feature_rank": participation_ratio(self._pooled(frames)),
                **{name: value.detach() for name, value in goals.items()},
            }
        return TensorDict({"loss": total, **metrics}, batch_size=[])

    def parameter_groups(self, lr: float) -> list[ParameterGroup]:
        """Parameter groups for AdamW; a frozen encoder and a teacher are in none."""
        own = {id(p) for p in self.encoder.parameters()}
        rest = [p for p in self.parameters() if id(p) not in own]
        slower = lr * self.encoder_lr_scale
        return [
            *decay_groups(self.encoder.parameters(), slower, weight_decay=self.weight_decay, name="encoder"),
            *decay_groups(rest, lr, weight_decay=self.weight_decay),
        ]

    @torch.no_grad()
    def after_update(self) -> None:
        """Move the teacher, where there is one; call once after each optimiser step."""
        if self.target_encoder is not None:
            keep = torch.full((), self.ema, device=next(self.target_encoder.parameters()).device)
            ema_update(self.target_encoder, self.encoder, keep)

    # ------------------------------------------------------------------ pieces

    def _tokens(self, encoder: nn.Module, observation: TensorDictBase) -> Tensor:
        """The encoder's tokens (..., tokens, token_dim)."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            if not self.image_sizes:
                return encoder(self.vectors(observation)).unsqueeze(-2)
            images = stack_cameras(observation, self.image_sizes)
            x = encoder(images.flatten(0, -4))
        return x.reshape(*images.shape[:-4], self.tokens, self.token_dim)

    def _normed(self, tokens: Tensor) -> Tensor:
        """Layer-normed and flattened: (..., feature_dim)."""
        # With so small an eps, what is normed already stays as it is: predicting no change is exact.
        return F.layer_norm(tokens.float(), (self.token_dim,), eps=1e-8).flatten(-2)

    def _features(self, observation: TensorDictBase, *, batch_statistics: bool = False) -> Tensor:
        tokens = self._tokens(self.encoder, observation)
        if self.adapter is not None:
            tokens = self.adapter(tokens, batch_statistics=batch_statistics)
        return self._normed(tokens)

    def encode_frame(self, observation: TensorDictBase, *, batch_statistics: bool = False) -> Tensor:
        return self._join(self._features(observation, batch_statistics=batch_statistics), observation)

    def _join(self, features: Tensor, observation: TensorDictBase) -> Tensor:
        return torch.cat((features, self.vectors(observation)), -1) if self.state_dim else features

    def _normalise(self, frame: Tensor) -> Tensor:
        """A predicted frame (..., F) with its tokens layer-normed, as the encoder's are."""
        features = frame[..., : self.feature_dim].unflatten(-1, (self.tokens, self.token_dim))
        features = self._normed(features)
        if not self.state_dim:
            return features
        return torch.cat((features, frame[..., self.feature_dim :].float()), dim=-1)

    def _distance(self, predicted: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
        """Mean absolute errors of tokens and of state, () each."""
        f = self.feature_dim
        features = F.l1_loss(predicted[..., :f], true[..., :f])
        if not self.state_dim:
            return features, torch.zeros_like(features)
        return features, F.l1_loss(predicted[..., f:], true[..., f:])

    def _rollout_loss(self, frames: Tensor, targets: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        horizon = action.shape[1]
        steps = min(self.rollout, horizon)
        if steps < 2:
            return frames.new_zeros(()), frames.new_zeros(())
        predicted = self.feed_back(frames, action, steps)[:, 1:]
        return self._distance(predicted, targets[:, horizon - steps + 2 :])

    def _pooled(self, frames: Tensor) -> Tensor:
        return frames[..., : self.feature_dim].unflatten(-1, (self.tokens, self.token_dim)).mean(-2)
