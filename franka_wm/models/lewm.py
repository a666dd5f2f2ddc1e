"""LeWorldModel: an action-conditioned JEPA trained end to end, kept from collapsing by SIGReg alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.errors import UserError
from franka_wm.models.history import FrameHistory, HistoryWorldModel
from franka_wm.models.images import (
    ImageSize,
    RandomShift,
    check_image_sizes,
    shared_image_size,
    stack_cameras,
)
from franka_wm.models.layers import TwoHotSymlog, initialize, mlp, unit_gain, zero_head
from franka_wm.models.normalizer import ObservationNormalizer
from franka_wm.models.regularizers import (
    ProjectionMLP,
    SIGReg,
    feature_std,
    info_nce,
    participation_ratio,
)
from franka_wm.models.transformer import CausalTransformer, block_causal_mask, hide_invalid
from franka_wm.models.vision import ViT, vit_size
from franka_wm.models.windows import check_windows, window_of, with_future
from franka_wm.options import COEFFICIENT, DEPTH, FRACTION, POSITIVE, Bounds, with_defaults

_COEFS = (
    *("sigreg_coef", "infonce_coef", "inverse_coef", "weight_decay"),
    *("goal_policy_coef", "goal_steps_coef"),
)


class LeWorldModel(HistoryWorldModel):
    """Encoder and action-conditioned predictor of embeddings, one loss for both (LeWorldModel, Maes et al. 2026,
    arXiv:2603.19312; SIGReg is that of LeJEPA, Balestriero & LeCun 2025, arXiv:2511.08544).

    loss = mean squared error of the next embedding + `sigreg_coef` · SIGReg of the embeddings, for each time
    step over the batch. No stop-gradient, no teacher, no decoder, no reward. An embedding is a vision
    transformer's class token through an MLP with BatchNorm; the predictor is a causal transformer over the
    last `history` embeddings with the actions through AdaLN-zero.

    z holds the last `history` frames' embeddings, the actions between them and who is real (see
    `franka_wm.models.history`), so `next(z, action)` needs nothing else. Distances to a goal are measured on
    `embed(z)`, the newest embedding. BatchNorm uses the batch's statistics in `loss` alone, and there in
    training mode alone: planning never depends on what else is in the batch.

    With `observation_sizes` a frame's embedding is joined by that of the state vector; without images it is
    that of the state alone. With images, goals are compared by the image's part.

    Deliberate differences: rotary positions in the predictor instead of learned ones, so that a history which
    is still short predicts as in training; `rollout`, InfoNCE, inverse dynamics, heads for goals, shifted images
    and the reward probe, off by default.

    Args:
        image_sizes: image key -> (height, width, channels); several of one size share the encoder.
        observation_sizes: vector key -> size; may be empty if there are images.
        action_dim: size of an action.
        episode_length: of the discount's default, and of distances to goals an episode away.
        embed_dim: size of the embedding of a frame's image.
        state_embed_dim: size of the embedding of a frame's state vector, next to images; without, it is `embed_dim`.
        state_hidden_dim: width of the state encoder's two hidden layers.
        history: frames that the predictor sees.
        encoder_size, encoder_width, encoder_depth, encoder_heads, patch_size: the vision transformer.
        projector_hidden: width of the MLPs after encoder and predictor.
        predictor_width: of the predictor's tokens; None: a frame's embedding is a token, as published. A small
            embedding needs wider ones.
        predictor_depth, predictor_heads, predictor_head_dim, predictor_mlp, dropout: the predictor.
        sigreg_coef, sigreg_directions: weight and random directions of the regulariser.
        rollout: 1, as published: predict from true embeddings. More: feed predictions back for so many steps
            at the end of each window as well.
        infonce_coef: weight of an InfoNCE loss between predicted and true next embeddings.
        inverse_coef: weight of inverse dynamics, after PLDM (Sobal et al. 2025, arXiv:2502.14819): the actions
            of a window are read from the embeddings of its frames (of the images' part where there are any),
            so that these describe all that the actions move, the hand's turning as well as the large links.
            Windows must then be at least `history` transitions long.
        goal_policy_coef, goal_steps_coef: weights of a policy towards goals and of a distance to them in steps, see
            `franka_wm.models.goal_heads.GoalHeads`.
        goal_policy_gradient: whether that policy shapes the embeddings, too.
        random_shift: pixels by which images are shifted at most in training, in each direction, a
            camera's of a window alike.
        reward_head: learn the reward as a probe of z whose gradient stops there, for planners that need it;
            the batch must then hold rewards.
        discount: discount of the rewards per step, for planning for return.
        weight_decay: weight decay of matrices.

    Raises:
        ValueError: a setting that cannot work.
    """

    has_goal_policy = True  # by options, see `learn_goals`
    has_goal_steps = True
    ranges: ClassVar[Mapping[str, Bounds]] = {
        **dict.fromkeys(
            ("action_dim", "embed_dim", "state_embed_dim", "state_hidden_dim", "history"), POSITIVE
        ),
        **dict.fromkeys(("encoder_width", "encoder_heads", "patch_size"), POSITIVE),
        **dict.fromkeys(("projector_hidden", "predictor_width", "predictor_heads"), POSITIVE),
        **dict.fromkeys(("predictor_head_dim", "predictor_mlp", "sigreg_directions", "rollout"), POSITIVE),
        **dict.fromkeys(_COEFS, COEFFICIENT),
        "discount": FRACTION,
        "random_shift": Bounds(least=0),
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
        embed_dim: int = 192,
        state_embed_dim: int = 64,
        state_hidden_dim: int = 256,
        history: int = 3,
        encoder_size: str = "tiny",
        encoder_width: int | None = None,
        encoder_depth: int | None = None,
        encoder_heads: int | None = None,
        patch_size: int = 8,
        random_shift: int = 0,
        projector_hidden: int = 2048,
        predictor_width: int | None = None,
        predictor_depth: int = 6,
        predictor_heads: int = 16,
        predictor_head_dim: int = 64,
        predictor_mlp: int = 2048,
        dropout: float = 0.1,
        sigreg_coef: float = 0.09,
        sigreg_directions: int = 1024,
        rollout: int = 1,
        infonce_coef: float = 0.0,
        inverse_coef: float = 0.0,
        goal_policy_coef: float = 0.0,
        goal_policy_gradient: bool = False,
        goal_steps_coef: float = 0.0,
        reward_head: bool = False,
        discount: float = 0.99,
        weight_decay: float = 1e-3,
    ) -> None:
        self.validate(locals())
        super().__init__()
        if not image_sizes and not observation_sizes:
            raise ValueError("give observation_sizes or image_sizes: there is nothing to read")
        self.vectors = ObservationNormalizer(observation_sizes)
        self.observation_sizes, self.action_dim = self.vectors.sizes, action_dim
        self.image_sizes = check_image_sizes(image_sizes)
        self.random_shift = RandomShift(random_shift)
        self.sigreg_coef, self.infonce_coef, self.rollout = sigreg_coef, infonce_coef, rollout
        self.inverse_coef = inverse_coef
        self.weight_decay, self.discount = weight_decay, discount
        self.encoder = self.projector = self.state_encoder = None
        self.image_part = self.state_part = 0
        self.feature_dim = embed_dim  # of images, or of vectors alone
        if self.image_sizes:
            shape = vit_size(encoder_size, width=encoder_width, depth=encoder_depth, heads=encoder_heads)
            self.encoder = ViT(
                image_size=shared_image_size(self.image_sizes),
                patch_size=patch_size,
                width=shape.width,
                depth=shape.depth,
                heads=shape.heads,
                cls=True,
            )
            self.image_part = embed_dim
            self.projector = ProjectionMLP(
                shape.width * len(self.image_sizes), embed_dim, hidden=projector_hidden
            )
        if self.observation_sizes:
            self.state_part = state_embed_dim if self.image_sizes else embed_dim
            hidden = (state_hidden_dim, state_hidden_dim)
            self.state_encoder = unit_gain(mlp(self.vectors.size, hidden, self.state_part))
        frame = self.image_part + self.state_part
        self.history = FrameHistory(length=history, frame_dim=frame, action_dim=action_dim)
        self.latent_dim = self.history.size
        width = frame if predictor_width is None else predictor_width
        self.lift = nn.Identity() if predictor_width is None else nn.Linear(frame, width)
        self.action_encoder = nn.Sequential(nn.Linear(action_dim, width), nn.SiLU(), nn.Linear(width, width))
        initialize(self.action_encoder)
        unit_gain(self.action_encoder)
        self.predictor = CausalTransformer(
            width=width,
            depth=predictor_depth,
            heads=predictor_heads,
            head_dim=predictor_head_dim,
            hidden=predictor_mlp,
            condition=width,
            dropout=dropout,
        )
        self.head = ProjectionMLP(width, frame, hidden=projector_hidden)
        self.sigreg = SIGReg(directions=sigreg_directions)
        self.inverse_head = None
        if inverse_coef:
            self.inverse_head = mlp((history + 1) * self.feature_dim, (512, 512), history * action_dim)
        self.reward_probe, self.has_reward = None, reward_head
        if reward_head:
            self.two_hot = TwoHotSymlog()
            self.reward_probe = zero_head(self.latent_dim + action_dim, (256, 256), self.two_hot.bins)
        goals: Any = {"policy": goal_policy_coef, "steps": goal_steps_coef, "gradient": goal_policy_gradient}
        self.learn_goals(**goals, episode_length=episode_length)

    @classmethod
    def validate(cls, options: Mapping[str, Any], *, window: int | None = None) -> None:
        super().validate(options, window=window)
        given = with_defaults(cls, options)
        if given["goal_policy_gradient"] and not given["goal_policy_coef"]:
            raise UserError(
                "model.goal_policy_gradient=true: there is no policy towards goals; set model.goal_policy_coef above 0"
            )
        if given["random_shift"] and "image_sizes" in options and not options["image_sizes"]:
            raise UserError(
                f"model.random_shift={given['random_shift']}: shifts images, and model.observations names none"
            )
        inverse, history = given["inverse_coef"], given["history"]
        if inverse and window is not None and window < history:
            raise UserError(
                f"model.inverse_coef={inverse}: reads the actions of windows of model.history={history} transitions, "
                f"and they have {window}; use replay.window={history}, or model.inverse_coef=0"
            )

    # ------------------------------------------------------------------ what a planner uses

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """Next z (..., latent_dim) after actions (..., action_dim) in z (..., latent_dim)."""
        frames, actions, valid = self.unpack(z, action)
        mask = block_causal_mask(self.history.length, device=z.device)
        predicted = self._predict(frames, actions, hide_invalid(mask, valid), training=False)[:, -1]
        return self.history.push(z, action, predicted.view(*z.shape[:-1], -1))

    def encode_goal(self, observation: TensorDictBase) -> Tensor:
        """The embedding (..., embed_dim) of a goal: of its images where the model reads any (state vectors
        are not needed then), else of its state vectors."""
        if self.image_sizes:
            return self._image(observation, batch_statistics=False)
        return self.encode_frame(observation)

    def reward(self, z: Tensor, action: Tensor) -> Tensor:
        """Expected reward (..., 1) of an action in z, of a model with `reward_head`."""
        if self.reward_probe is None:
            raise NotImplementedError("this model was built without reward_head=true: it has no reward")
        return self.two_hot.decode(self.reward_probe(torch.cat((z, action), dim=-1)))

    # ------------------------------------------------------------------ training

    def loss(self, batch: TensorDictBase) -> TensorDict:
        """Loss of a batch of windows; call `backward` once on the entry `loss`.

        Args:
            batch: batch size [B, H]: H contiguous transitions of one episode, with the observation keys,
                `action` (B, H, A), in `next` the observation keys and, with `reward_head` only, `reward`
                (B, H, 1). Of `next` only the last observation is read.

        Returns:
            batch size []: `loss`, and detached `loss_prediction`, `loss_sigreg`, `relative_error` (squared
            error of the prediction over that of predicting no change), `feature_std` and `feature_rank`
            (participation ratio) of the embeddings; `loss_rollout`, `loss_infonce`, `loss_inverse`,
            `loss_reward`, `loss_goal_policy`, `loss_goal_steps` where asked for.

        Raises:
            ValueError: the batch size is not [B, H], or with `inverse_coef` H is below `history`.
        """
        check_windows(batch)
        action = batch.get("action")
        window = window_of(batch, self.observation_keys)
        if self.goal_heads is not None:
            window = with_future(window, batch)
        for key in self.image_sizes:
            window.set(key, self.random_shift(window.get(key)))
        encoded = self.encode_frame(window, batch_statistics=self.training).float()
        frames = encoded[:, : action.shape[1] + 1]  # (B, H+1, F)

        cut = self.history.windows
        before, after, actions = cut(frames[:, :-1]), cut(frames[:, 1:]), cut(action)
        mask = block_causal_mask(before.shape[1], device=before.device)
        predicted = self._predict(before, actions, mask, training=self.training).float()
        prediction = F.mse_loss(predicted, after)
        total = prediction
        sigreg = self._sigreg(frames.transpose(0, 1))
        total = total + self.sigreg_coef * sigreg
        extra: dict[str, Tensor] = {}
        if self.rollout > 1:
            extra["loss_rollout"] = self._rollout_loss(frames, action)
        if self.infonce_coef:
            extra["loss_infonce"] = self.infonce_coef * info_nce(predicted[:, -1], after[:, -1])
        if self.inverse_head is not None:
            extra["loss_inverse"] = self.inverse_coef * self._inverse_loss(before, after, actions)
        if self.reward_probe is not None:
            z = self.history.gather(frames[:, :-1].detach(), action)
            logits = self.reward_probe(torch.cat((z, action.to(z.dtype)), dim=-1))
            extra["loss_reward"] = self.two_hot.loss(logits.float(), batch.get(("next", "reward"))).mean()
        extra |= self.goal_losses(encoded, batch)
        for value in extra.values():
            total = total + value
        with torch.no_grad():
            metrics = {
                "loss_prediction": prediction.detach(),
                "loss_sigreg": sigreg.detach(),
                "relative_error": prediction.detach() / F.mse_loss(before, after).clamp_min(1e-12),
                "feature_std": feature_std(frames),
                "feature_rank": participation_ratio(frames),
                **{name: value.detach() for name, value in extra.items()},
            }
        return TensorDict({"loss": total, **metrics}, batch_size=[])

    # ------------------------------------------------------------------ pieces

    def _image(self, observation: TensorDictBase, *, batch_statistics: bool) -> Tensor:
        assert self.encoder is not None and self.projector is not None
        images = stack_cameras(observation, self.image_sizes)  # (..., V, height, width, C)
        tokens = self.encoder(images.flatten(0, -4))[:, 0]
        x = tokens.reshape(*images.shape[:-4], -1)
        return self.projector(x, batch_statistics=batch_statistics)

    def encode_frame(self, observation: TensorDictBase, *, batch_statistics: bool = False) -> Tensor:
        """Embeddings (..., F) of observations (...): the image's, then the state's."""
        parts = []
        if self.encoder is not None:
            parts.append(self._image(observation, batch_statistics=batch_statistics))
        if self.state_encoder is not None:
            parts.append(self.state_encoder(self.vectors(observation)))
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)

    def _predict(self, frames: Tensor, actions: Tensor, mask: Tensor, *, training: bool) -> Tensor:
        """Frames (N, K, F), the action taken at each (N, K, A) -> the frame after each (N, K, F)."""
        positions = torch.arange(frames.shape[1], device=frames.device)
        condition = self.action_encoder(actions.to(frames.dtype))
        x = self.predictor(self.lift(frames), positions, mask, condition, dropout=training)
        return self.head(x, batch_statistics=training)

    def _sigreg(self, frames: Tensor) -> Tensor:
        """SIGReg of images and states apart: both describe the same scene, so they cannot be independent."""
        parts = [part for part in (self.image_part, self.state_part) if part]
        values = [self.sigreg(x) for x in frames.split(parts, dim=-1)]
        return torch.stack(values).mean()

    def _inverse_loss(self, before: Tensor, after: Tensor, actions: Tensor) -> Tensor:
        """Squared error of a window's actions as its embeddings tell them."""
        assert self.inverse_head is not None
        if actions.shape[1] < self.history.length:
            raise ValueError(
                f"inverse_coef needs windows of at least history={self.history.length} transitions, got "
                f"{actions.shape[1]}"
            )
        frames = torch.cat((before, after[:, -1:]), dim=1)[..., : self.feature_dim]
        read = self.inverse_head(frames.flatten(1)).float().view(actions.shape)
        return F.mse_loss(read, actions.float())

    def _rollout_loss(self, frames: Tensor, action: Tensor) -> Tensor:
        """Squared error of predictions fed back, from the second step on, at the end of the windows."""
        steps = min(self.rollout, action.shape[1])
        if steps < 2:
            return frames.new_zeros(())
        predicted = self.feed_back(frames, action, steps)[:, 1:]
        return F.mse_loss(predicted, frames[:, frames.shape[1] - steps + 1 :])
