"""Action world model: dynamics over the tokens of a pretrained encoder (V-JEPA 2-AC, arXiv:2506.09985)."""

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models.backbone import Backbone
from franka_wm.models.groups import decay_groups
from franka_wm.models.jepa import ema_update, one_size, stack_views
from franka_wm.models.lewm import window_of
from franka_wm.models.memory import Memory
from franka_wm.models.parts import mlp
from franka_wm.models.regularizers import CollapseGuard, ProjectionMLP, feature_std, participation_ratio
from franka_wm.models.transformer import CausalTransformer, MLPDynamics, block_causal_mask, hide_invalid
from franka_wm.models.vectors import Vectors
from franka_wm.models.vision import sincos


class ActionWorldModel(nn.Module):
    """Predict the encoder's tokens of the next frame from frames, actions and the robot's own state
    (V-JEPA 2-AC: Assran et al. 2025, arXiv:2506.09985).

    The encoder, usually pretrained, is frozen or trained along. Its tokens are layer-normed; the dynamics, a
    block-causal transformer over [action, state, tokens] of the last `history` frames, predicts those of the
    next frame, and the next state. loss = mean absolute error, teacher-forced, plus that of a short rollout
    in which predictions are fed back.

    z holds the last `history` frames (tokens, then state), the actions between them and who is real, see
    `franka_wm.models.memory`. Distances to a goal are measured on `embed(z)`, the newest frame's tokens.

    An encoder that is trained along needs a guard against collapse, `collapse`; with a frozen one there is
    nothing to collapse and none acts. For `sigreg` and `vicreg` its tokens first go through an MLP with
    BatchNorm, as in LeWorldModel: a transformer ends with a LayerNorm, which keeps embeddings from being
    centred, and so the guard from spreading them.

    Deliberate differences: a small predictor (the paper's has 300 M parameters, 24 layers of width 1024), which
    predicts the change of the tokens, so that it starts as "nothing changes"; the tokens may be averaged to
    a coarser grid, since z holds them for every candidate of a planner.

    Args:
        image_sizes: picture key -> (height, width, channels); several of one size share the encoder. Empty
            for `encoder=state`.
        observation_sizes: vector key -> size. The state token next to pictures; what is encoded for
            `encoder=state`. May be empty next to pictures.
        action_dim: size of an action.
        episode_length: unused, accepted for the common signature.
        encoder: `vit`, `conv` or `state`.
        encoder_size, encoder_width, encoder_depth, encoder_heads, patch_size: of `vit`.
        channels: of `conv`.
        state_embed_dim, state_hidden_dim: of `state`: its token and the two hidden layers before it.
        encoder_from: take the encoder of this checkpoint (a JEPA's, say), see `read_encoder`.
        encoder_architecture: see `Backbone`; only to rebuild from a checkpoint.
        huggingface, huggingface_config, local_files_only: see `Backbone`.
        freeze_encoder: None: frozen if it is pretrained.
        grid: average the tokens to this many rows and columns; None: as they are.
        history: frames that the dynamics sees.
        predictor: `transformer` or `mlp`.
        predictor_width, predictor_depth, predictor_heads, dropout: of `transformer`.
        predictor_hidden_dim: of the three hidden layers of `mlp`.
        rollout: steps of the rollout; 1: teacher forcing alone.
        collapse: `ema`, `sigreg`, `vicreg` or `none`, for an encoder that is trained along.
        guard_coef, guard_directions: see `CollapseGuard`.
        ema: part that the teacher keeps of itself at each update.
        encoder_lr_scale: learning rate of the encoder relative to the rest.
        weight_decay: of matrices.

    Raises:
        ValueError: a setting that cannot work.
        ModuleNotFoundError: `huggingface` without transformers.
    """

    def __init__(
        self,
        *,
        image_sizes: Mapping[str, tuple[int, int, int]] | None = None,
        observation_sizes: Mapping[str, int] | None = None,
        action_dim: int,
        episode_length: int | None = None,
        encoder: str = "vit",
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
        predictor: str = "transformer",
        predictor_width: int = 256,
        predictor_depth: int = 6,
        predictor_heads: int = 8,
        predictor_hidden_dim: int = 512,
        dropout: float = 0.0,
        rollout: int = 2,
        collapse: str = "sigreg",
        guard_coef: float | None = None,
        guard_directions: int = 1024,
        ema: float = 0.996,
        encoder_lr_scale: float = 1.0,
        weight_decay: float = 0.04,
    ) -> None:
        super().__init__()
        if encoder not in ("vit", "conv", "state"):
            raise ValueError(f"unknown encoder {encoder!r}; available: vit, conv, state")
        if predictor not in ("transformer", "mlp"):
            raise ValueError(f"unknown predictor {predictor!r}; available: transformer, mlp")
        if rollout < 1:
            raise ValueError(f"rollout must be at least 1, got {rollout}")
        if not 0.0 <= ema <= 1.0:
            raise ValueError(f"ema must be in [0, 1], got {ema}")
        self.vectors = Vectors(observation_sizes or {})
        self.observation_sizes, self.action_dim = self.vectors.sizes, action_dim
        self.rollout, self.ema = rollout, ema
        self.encoder_lr_scale, self.weight_decay = encoder_lr_scale, weight_decay
        self.image_sizes: dict[str, tuple[int, int, int]] = {}
        pretrained = encoder_from is not None or huggingface is not None
        self.encoder: nn.Module
        if encoder == "state":
            if image_sizes or pretrained:
                raise ValueError("encoder=state reads vectors only: take no pictures, or encoder=vit or conv")
            if not self.observation_sizes:
                raise ValueError("encoder=state needs observation_sizes: set observations=[state]")
            hidden = (state_hidden_dim, state_hidden_dim)
            self.encoder = mlp(self.vectors.size, hidden, state_embed_dim)
            nn.init.xavier_uniform_(self.encoder[-1].weight)  # type: ignore[arg-type]
            places, self.token_dim, views, self.state_dim = 1, state_embed_dim, 1, 0
        else:
            self.image_sizes, size = one_size(image_sizes or {})
            self.encoder = Backbone(
                size,
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
        self.observation_keys = [*self.observation_sizes, *self.image_sizes]
        self.frozen = pretrained if freeze_encoder is None else freeze_encoder
        if self.frozen:
            self.encoder.requires_grad_(False).eval()
        self.memory = Memory(
            history=history, frame_dim=self.feature_dim + self.state_dim, action_dim=action_dim
        )
        self.latent_dim = self.memory.size

        # Which token of a frame is which: action, state (if any), then pictures' tokens.
        self.tokens_per_frame = self.tokens + 1 + (1 if self.state_dim else 0)
        if predictor == "mlp":
            self.dynamics: nn.Module = MLPDynamics(
                memory_dim=self.memory.size,
                frame_dim=self.memory.frame_dim,
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
        self.target_encoder = None
        if self.guard.kind == "ema":
            self.target_encoder = copy.deepcopy(self.encoder).requires_grad_(False)

    def train(self, mode: bool = True) -> "ActionWorldModel":
        """As usual, but a frozen encoder stays in evaluation mode."""
        super().train(mode)
        if self.frozen:
            self.encoder.eval()
        return self

    def rebuild_overrides(self) -> dict[str, Any]:
        """Constructor arguments that replace those which read other files, so that the model's own weights
        rebuild it: JSON-able."""
        overrides: dict[str, Any] = {"freeze_encoder": self.frozen}
        if isinstance(self.encoder, Backbone):
            own = self.encoder.rebuild()
            if "architecture" in own:
                own["encoder_architecture"] = own.pop("architecture")
            overrides |= own
        return overrides

    # ------------------------------------------------------------------ what a planner uses

    def set_observation_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Standardise state vectors from now on, see `Vectors.set_statistics`."""
        self.vectors.set_statistics(mean, std)

    def encode(self, observation: TensorDictBase) -> Tensor:
        """The z (..., latent_dim) of an episode's first observation: a history of one frame."""
        return self.memory.start(self._frame(observation))

    def observe(
        self, observation: TensorDictBase, previous_z: Tensor, action: Tensor, is_init: Tensor
    ) -> Tensor:
        """The z after `action` led to `observation`.

        Args:
            observation: batch size [E].
            previous_z: (E, latent_dim), before the action.
            action: (E, action_dim).
            is_init: (E, 1) bool; where True the observation is an episode's first, and z that of `encode`.
        """
        frame = self._frame(observation)
        pushed = self.memory.push(previous_z, action, frame)
        return torch.where(is_init, self.memory.start(frame), pushed)

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """z (..., latent_dim) and actions (..., action_dim) -> next z (..., latent_dim)."""
        if isinstance(self.dynamics, MLPDynamics):
            frame = self._normalise(self.dynamics(z, self.memory.last(z), action.to(z.dtype)))
            return self.memory.push(z, action, frame)
        frames, actions, valid = (x.reshape(-1, *x.shape[z.dim() - 1 :]) for x in self.memory.split(z))
        flat = action.reshape(-1, self.action_dim)
        actions = torch.cat((actions, flat.unsqueeze(1).to(actions.dtype)), dim=1)
        frame = self._normalise(self.dynamics(frames, actions, valid)[:, -1])
        return self.memory.push(z, action, frame.view(*z.shape[:-1], -1))

    def embed(self, z: Tensor) -> Tensor:
        """What goals are compared on: the newest frame's tokens, flattened (..., feature_dim)."""
        return self.memory.last(z)[..., : self.feature_dim]

    def encode_goal(self, observation: TensorDictBase) -> Tensor:
        """The tokens (..., feature_dim) of a goal: of its pictures, or of its state vectors for
        `encoder=state`."""
        return self._features(observation)

    # ------------------------------------------------------------------ training

    def forward(self, batch: TensorDictBase) -> TensorDict:
        """Same as `loss`, for wrappers that call the module."""
        return self.loss(batch)

    def loss(self, batch: TensorDictBase) -> TensorDict:
        """Loss of a batch of windows; call `backward` once on the entry `loss`.

        Args:
            batch: batch size [B, H]: H contiguous transitions of one episode, with the observation keys,
                `action` (B, H, A), and in `next` the observation keys, of which only the last is read.

        Returns:
            batch size []: `loss`, and detached `loss_prediction` (teacher forcing), `loss_rollout`,
            `loss_state`, `loss_guard` (weighted), `relative_error` (absolute error of the teacher-forced
            tokens over that of predicting no change), `feature_std` and `feature_rank` (participation ratio).

        Raises:
            ValueError: the batch size is not [B, H].
        """
        if len(batch.batch_size) != 2:
            raise ValueError(f"a batch of windows has batch size [B, H], got {list(batch.batch_size)}")
        action = batch.get("action")
        window = window_of(batch, self.observation_keys)
        frames = self._frame(window, batch_statistics=self.training).float()  # (B, H+1, F)
        if self.target_encoder is None:
            targets = frames
        else:
            with torch.no_grad():
                targets = self._join(self._normed(self._tokens(self.target_encoder, window)), window).float()

        before = frames[:, :-1]
        if isinstance(self.dynamics, MLPDynamics):
            predicted = self.dynamics(self.memory.gather(before, action), before, action.to(before.dtype))
            after = targets[:, 1:]
        else:
            cut = self.memory.windows
            before, after, actions = cut(before), cut(targets[:, 1:]), cut(action)
            predicted = self.dynamics(before, actions, None, dropout=self.training)
        prediction, state = self._distance(self._normalise(predicted), after)
        # The same with predictions fed back, at the end of the windows.
        rolled, rolled_state = self._rollout_loss(frames, targets, action)
        # On what is predicted: on a projection of it, the guard would not see it collapse.
        guard = self.guard(self._pooled(frames).transpose(0, 1))
        total = prediction + state + rolled + rolled_state + guard
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
            }
        return TensorDict({"loss": total, **metrics}, batch_size=[])

    def parameter_groups(self, lr: float) -> list[dict[str, Any]]:
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
            pictures = stack_views(observation, self.image_sizes)
            x = encoder(pictures.flatten(0, -4))
        return x.reshape(*pictures.shape[:-4], self.tokens, self.token_dim)

    def _normed(self, tokens: Tensor) -> Tensor:
        """Layer-normed and flattened: (..., feature_dim)."""
        # With so small an eps, what is normed already stays as it is: predicting no change is exact.
        return F.layer_norm(tokens.float(), (self.token_dim,), eps=1e-8).flatten(-2)

    def _features(self, observation: TensorDictBase, *, batch_statistics: bool = False) -> Tensor:
        tokens = self._tokens(self.encoder, observation)
        if self.adapter is not None:
            tokens = self.adapter(tokens, batch_statistics=batch_statistics)
        return self._normed(tokens)

    def _frame(self, observation: TensorDictBase, *, batch_statistics: bool = False) -> Tensor:
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
        start = horizon - steps
        z = self.memory.gather(frames[:, : start + 1], action)[:, -1]
        predicted = []
        for t in range(start, horizon):
            z = self.next(z, action[:, t])
            predicted.append(self.memory.last(z))
        return self._distance(torch.stack(predicted[1:], dim=1), targets[:, start + 2 :])

    def _pooled(self, frames: Tensor) -> Tensor:
        return frames[..., : self.feature_dim].unflatten(-1, (self.tokens, self.token_dim)).mean(-2)


class TokenDynamics(nn.Module):
    """Block-causal transformer over [action, state, tokens] of several frames; predicts the frame after each.

    Every token attends to all tokens of its own and earlier frames. Predicts the change, and starts with none.

    Args:
        tokens, token_dim: of the pictures of one frame.
        state_dim: size of the state vector; 0: no state token.
        action_dim: size of an action.
        width, depth, heads, dropout: of the transformer.
    """

    place: Tensor

    def __init__(
        self,
        *,
        tokens: int,
        token_dim: int,
        state_dim: int,
        action_dim: int,
        width: int,
        depth: int,
        heads: int,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        if width % (2 * heads):
            raise ValueError(
                f"predictor_width must be a multiple of 2 · predictor_heads, got {width} and {heads}"
            )
        self.tokens, self.token_dim, self.state_dim = tokens, token_dim, state_dim
        self.feature_dim = tokens * token_dim
        self.per_frame = tokens + 1 + (1 if state_dim else 0)
        self.enter = nn.Linear(token_dim, width)
        self.enter_action = nn.Linear(action_dim, width)
        self.enter_state = nn.Linear(state_dim, width) if state_dim else None
        self.transformer = CausalTransformer(
            width=width, depth=depth, heads=heads, head_dim=width // heads, hidden=4 * width, dropout=dropout
        )
        self.leave = nn.Linear(width, token_dim)
        self.leave_state = nn.Linear(width, state_dim) if state_dim else None
        for layer in (self.leave, self.leave_state):
            if layer is not None:
                nn.init.zeros_(layer.weight)
                nn.init.zeros_(layer.bias)
        self.register_buffer("place", sincos(torch.arange(self.per_frame), width), persistent=False)

    def forward(
        self, frames: Tensor, actions: Tensor, valid: Tensor | None, *, dropout: bool = False
    ) -> Tensor:
        """Frames (N, K, F), the action taken at each (N, K, A) -> the frame after each (N, K, F).

        Args:
            valid: (N, K), 1 where the frame is real; None: all are.
        """
        count, steps = frames.shape[:2]
        features = frames[..., : self.feature_dim].unflatten(-1, (self.tokens, self.token_dim))
        parts = [self.enter_action(actions.to(frames.dtype)).unsqueeze(2)]
        if self.enter_state is not None:
            parts.append(self.enter_state(frames[..., self.feature_dim :]).unsqueeze(2))
        parts.append(self.enter(features))
        x = (torch.cat(parts, dim=2) + self.place).flatten(1, 2)
        mask = block_causal_mask(steps, self.per_frame, device=x.device)
        if valid is not None:
            mask = hide_invalid(mask, valid, self.per_frame)
        time = torch.arange(steps, device=x.device).repeat_interleave(self.per_frame)
        x = self.transformer(x, time, mask, dropout=dropout).view(count, steps, self.per_frame, -1)
        after = (features + self.leave(x[:, :, -self.tokens :])).flatten(-2)
        if self.leave_state is None:
            return after
        state = frames[..., self.feature_dim :] + self.leave_state(x[:, :, 1])
        return torch.cat((after, state), dim=-1)
