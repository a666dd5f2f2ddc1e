"""TD-MPC2: a latent world model without decoder (Hansen, Su & Wang, ICLR 2024, arXiv:2310.16828)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from franka_wm.errors import UserError
from franka_wm.models.groups import ParameterGroup
from franka_wm.models.images import ImageSize, check_images
from franka_wm.models.layers import (
    Ensemble,
    GaussianPolicy,
    SimNorm,
    TwoHotSymlog,
    mlp,
    zero_head,
)
from franka_wm.models.normalizer import concatenate
from franka_wm.models.returns import RunningScale, discount_per_step, value_range
from franka_wm.models.simplicial import SimplicialWorldModel
from franka_wm.models.windows import check_windows, window_of
from franka_wm.options import COEFFICIENT, DEPTH, FRACTION, POSITIVE, Bounds, with_defaults
from franka_wm.streams import side_stream


class TDMPC2(SimplicialWorldModel):
    """Encoder, dynamics, reward, Q-ensemble and policy over one latent space, trained together.

    z = h(s);  z' = d(z, a);  r = R(z, a);  q = Q(z, a);  a = π(z). Where episodes may terminate, a head on z' says
    whether they do, for planners (as in the authors' later code). The defaults are the published
    5 M-parameter model for state observations, for images with `image_sizes` (shifted at random in `loss`
    in training mode, never while planning), or for both. Latents (..., `latent_dim`) are simplices of `simnorm_dim`
    features, both from the encoder and from the dynamics. Rewards and values are in the units of the
    environment's reward.

    `train()` and `eval()` matter to `value`, see there. Dropout acts in `loss` alone, never while planning.

    Deliberate differences from the paper:
      * Raw physical observations can be standardised at the encoder's input, see
        `set_observation_statistics`; the default is the identity.
      * One backward pass serves model and policy, so the policy learns from the critic before this update
        instead of after it. Their gradients stay apart.
      * The entropy is that of the actions, as in SAC (Haarnoja et al., arXiv:1801.01290). The authors' code
        counts the Gaussian's before squashing, which grows without bound at no cost where tanh saturates: where
        one action changes returns by little, as on an arm at 30 Hz, their policy ends at ±1 everywhere.
      * All frames of a window are shifted alike, so that motion between them is kept; the paper shifts each.

    Args:
        observation_sizes: observation key -> size of its last dimension; encoded in this order. May be empty
            where there are images.
        image_sizes: image key -> (height, width, channels), uint8.
        action_dim: size of an action; each component lies in [-1, 1].
        episode_length: steps of an episode, from which the discount follows if it is not given:
            clamp((T/5 - 1) / (T/5), 0.95, 0.995).
        discount: per step, in [0, 1).
        latent_dim, simnorm_dim: size of z; features per simplex, which divides it.
        encoder_dim, encoder_layers: width of the encoder's hidden layers; its layers, the output layer included.
        hidden_dim: width of the two hidden layers of every other network.
        num_q: members of the Q-ensemble, at least 2.
        value_members: how many of them `value` averages in evaluation mode, always the first; None: all. The
            paper averages two drawn at random, at two fifths of the cost of all.
        dropout: on the first layer of each Q-function.
        bins, value_low, value_high: two-hot code of rewards and values; the range is in symlog space. None:
            derived from `reward_bounds` and the discount, see `value_range`.
        reward_bounds: the least and the largest reward of a step; None: unknown.
        terminates: whether episodes may terminate; otherwise there is no head for it.
        log_std_min, log_std_max: bounds of the policy's log deviation before squashing. rho: step t weighs rho^t.
        consistency_coef, reward_coef, value_coef, termination_coef: weights of the losses.
        entropy_coef: weight, against scaled values, of `action_dim` times the policy's entropy [nat].
        imitation_coef: of the policy's squared error at `demonstrated` steps; among these alone it is all of its loss.
        mode_targets: bootstrap from Q at the policy's mode, so that values are those of the policy that is
            evaluated; False, as in the paper: at a sample, which counts the policy's noise as well.
        tau: how far target Q-functions, and the policy loss's scale, move at each update.
        encoder_lr_scale: learning rate of the encoder relative to the rest.
        channels: of each convolution over images.
        random_shift: pixels by which images are shifted at most, in each direction; the paper pads by 3 to 4.
        encoder_from: start from this checkpoint's vision transformer, see `franka_wm.models.backbone.read_encoder`.
        encoder_architecture: the transformer's numbers; only to rebuild from a checkpoint.
        encoder_grid: average its tokens to so many rows and columns.
        freeze_encoder: keep it as it is; what joins its features into z is still trained.
        standardize_images: of the convolutions, by a mean image and one deviation, see `set_image_statistics`.
        action_masks: of several tasks whose actions differ, see `SimplicialWorldModel`.

    Raises:
        ValueError: a size or coefficient that cannot work, or neither `episode_length` nor `discount`.
    """

    ranges: ClassVar[Mapping[str, Bounds]] = {
        **dict.fromkeys(("action_dim", "latent_dim", "simnorm_dim", "encoder_dim"), POSITIVE),
        **dict.fromkeys(("encoder_grid", "hidden_dim", "value_members", "channels"), POSITIVE),
        **dict.fromkeys(("consistency_coef", "reward_coef", "value_coef", "termination_coef"), COEFFICIENT),
        **dict.fromkeys(("imitation_coef", "entropy_coef", "encoder_lr_scale"), COEFFICIENT),
        **dict.fromkeys(("log_std_min", "log_std_max"), Bounds(least=-20, most=20)),
        "rho": FRACTION,
        **dict.fromkeys(("num_q", "bins"), Bounds(least=2)),
        **dict.fromkeys(("discount", "dropout"), Bounds(least=0, below=1)),
        "tau": Bounds(above=0, most=1),
        "random_shift": Bounds(least=0),
        "encoder_layers": DEPTH,
    }

    def __init__(
        self,
        *,
        observation_sizes: Mapping[str, int] | None = None,
        image_sizes: Mapping[str, ImageSize] | None = None,
        action_dim: int,
        episode_length: int | None = None,
        discount: float | None = None,
        latent_dim: int = 512,
        simnorm_dim: int = 8,
        encoder_dim: int = 256,
        encoder_layers: int = 2,
        hidden_dim: int = 512,
        num_q: int = 5,
        value_members: int | None = None,
        dropout: float = 0.01,
        bins: int = 101,
        value_low: float | None = None,
        value_high: float | None = None,
        reward_bounds: tuple[float, float] | None = None,
        terminates: bool = False,
        log_std_min: float = -10.0,
        log_std_max: float = 2.0,
        rho: float = 0.5,
        consistency_coef: float = 20.0,
        reward_coef: float = 0.1,
        value_coef: float = 0.1,
        termination_coef: float = 1.0,
        entropy_coef: float = 1e-4,
        imitation_coef: float = 0.0,
        mode_targets: bool = False,
        tau: float = 0.01,
        encoder_lr_scale: float = 0.3,
        channels: int = 32,
        random_shift: int = 3,
        encoder_from: str | Path | None = None,
        encoder_architecture: Sequence[int] | None = None,
        encoder_grid: int | None = 4,
        freeze_encoder: bool = False,
        standardize_images: bool = False,
        action_masks: Sequence[Sequence[float]] | None = None,
    ) -> None:
        self.validate(locals())
        pretrained = encoder_from is not None or encoder_architecture is not None
        if (pretrained and not image_sizes) or (freeze_encoder and not pretrained):
            raise ValueError("encoder_from needs images, and freeze_encoder needs encoder_from")
        super().__init__(
            observation_sizes=observation_sizes,
            image_sizes=image_sizes,
            latent_dim=latent_dim,
            simnorm_dim=simnorm_dim,
            encoder_dim=encoder_dim,
            encoder_layers=encoder_layers,
            channels=channels,
            random_shift=random_shift,
            encoder_from=encoder_from,
            encoder_architecture=encoder_architecture,
            encoder_grid=encoder_grid,
            freeze_encoder=freeze_encoder,
            standardize_images=standardize_images,
            action_masks=action_masks,
        )
        self.discount = discount_per_step(discount, episode_length)
        self.action_dim, self.num_q, self.value_members = action_dim, num_q, value_members
        self.rho, self.tau, self.encoder_lr_scale = rho, tau, encoder_lr_scale
        self.consistency_coef, self.reward_coef = consistency_coef, reward_coef
        self.value_coef, self.entropy_coef, self.mode_targets = value_coef, entropy_coef, mode_targets
        self.imitation_coef = imitation_coef
        self.terminates, self.termination_coef = terminates, termination_coef

        hidden = (hidden_dim, hidden_dim)
        self.dynamics = mlp(latent_dim + action_dim, hidden, latent_dim, output=SimNorm(simnorm_dim))
        self.reward_head = zero_head(latent_dim + action_dim, hidden, bins)
        self.q_ensemble = Ensemble(
            members=num_q,
            in_features=latent_dim + action_dim,
            hidden=hidden,
            out_features=bins,
            dropout=dropout,
        )
        self.policy_head = GaussianPolicy(
            latent_dim=latent_dim,
            hidden=hidden,
            action_dim=action_dim,
            log_std_min=log_std_min,
            log_std_max=log_std_max,
        )
        self.two_hot = TwoHotSymlog(bins, *value_range(value_low, value_high, reward_bounds, self.discount))
        self.termination_head = mlp(latent_dim, hidden, 1) if terminates else None
        self.scale = RunningScale(tau)

    @classmethod
    def validate(cls, options: Mapping[str, Any], *, window: int | None = None) -> None:
        super().validate(options, window=window)
        given = with_defaults(cls, options)
        members, num_q = given.get("value_members"), given.get("num_q")
        if members is not None and num_q is not None and members > num_q:
            raise UserError(f"model.value_members={members}: must be at most model.num_q={num_q}, or null")

    # ------------------------------------------------------------------ what a planner and a policy use

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """Latents (..., latent_dim) and actions (..., action_dim) -> next latents (..., latent_dim)."""
        return self.following(z, self.dynamics(self.joined(z, action, self.dynamics)))

    def reward(self, z: Tensor, action: Tensor) -> Tensor:
        """Expected reward (..., 1) of an action (..., action_dim) in z (..., latent_dim)."""
        return self.two_hot.decode(self.reward_head(self.joined(z, action, self.reward_head)))

    def q(
        self,
        z: Tensor,
        action: Tensor,
        *,
        weights: Literal["live", "detached", "target"] = "live",
        reduce: Literal["mean", "pair_mean", "pair_min"] = "mean",
        first: int | None = None,
        dropout: bool = False,
    ) -> Tensor:
        """Discounted return (..., 1) of an action (..., action_dim) in z (..., latent_dim), then the policy.

        Args:
            weights: which parameters to use, see `Ensemble.forward`.
            first: with `mean`, of the first so many members; of all if None.
            reduce: `mean` of all members; `pair_mean` or `pair_min` of two members drawn at random on the
                device, afresh at each call.
            dropout: whether to drop activations, as while fitting.
        """
        # Ranking noise draws without replacement, on the device; randperm may wait for the host.
        members = first if reduce == "mean" else torch.rand(self.num_q, device=z.device).topk(2).indices
        both = self.joined(z, action, self.q_ensemble)
        logits = self.q_ensemble(both, weights=weights, members=members, dropout=dropout)
        values = self.two_hot.decode(logits)
        return values.amin(0) if reduce == "pair_min" else values.mean(0)

    def value(self, z: Tensor, *, deterministic: bool | None = None) -> Tensor:
        """Value (..., 1) of z (..., latent_dim): Q at the policy's action.

        Args:
            deterministic: True: mean of `value_members` members at the policy's mode. False, as in the paper: mean
                of two random members at a sampled action. None: deterministic in evaluation mode only.
        """
        if deterministic is None:
            deterministic = not self.training
        action = self.policy(z, deterministic=deterministic)
        if deterministic:
            return self.q(z, action, reduce="mean", first=self.value_members)
        return self.q(z, action, reduce="pair_mean")

    def terminated(self, z: Tensor) -> Tensor:
        """Whether an episode ends in z (..., latent_dim), likelier than not: (..., 1) bool.

        Raises:
            ValueError: the model was built for episodes that do not terminate.
        """
        if self.termination_head is None:
            raise ValueError("this model was built without terminates=True: it does not predict ends")
        return self.termination_head(self.features(z)) > 0.0

    def policy(self, z: Tensor, deterministic: bool = False) -> Tensor:
        """Actions (..., action_dim) in [-1, 1] for z (..., latent_dim): a sample, or the mode."""
        return self.masked(z, self.policy_head(self.features(z), deterministic=deterministic))

    def policy_sample(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """A reparameterised action (..., action_dim) and its log-density (..., 1), see `GaussianPolicy.sample`."""
        action, log_prob = self.policy_head.sample(self.features(z), self.used(z))
        return self.masked(z, action), log_prob

    # ------------------------------------------------------------------ training

    parts_of_loss = ("_encode_window", "_td_target", "_unroll", "_model_losses", "_policy_loss", "_metrics")
    """Compiled one by one: what runs side by side on a GPU must not become one program."""

    def loss(self, batch: TensorDictBase) -> TensorDict:
        """Losses of a batch of windows; call `backward` once on the entry `loss`.

        The policy's parameters then hold the gradient of the policy loss alone, all others that of the model losses
        (and the encoder, among demonstrations alone, that of imitation). In training mode the running scale of the
        policy loss is updated as well.

        Args:
            batch: batch size [B, H]: H contiguous transitions, all of one episode, with the observation keys,
                `action` (B, H, A), and in `next` the observation keys, `reward` (B, H, 1) and `terminated`
                (B, H, 1) bool. The observations after steps 0..H-2 are read from the root of the following
                step; only the last one is read from `next`, and it must be the true one, also where the
                episode ended. A truncated episode is bootstrapped, a terminated one is not.

        Returns:
            batch size []: `loss` to differentiate, and detached: `loss_consistency`, `loss_reward`,
            `loss_value`, `loss_policy`, `q_mean`, `q_target_mean`, `policy_entropy` [nat], `policy_scale`,
            `latent_norm`, `reward_error` (mean absolute), `target_outside` (share of rewards and targets of
            values that the two-hot code clamps); with `terminates` also `loss_termination`.

        Raises:
            ValueError: the batch size is not [B, H].
        """
        check_windows(batch)
        # Time leads from here on: (H, B, ...).
        action, reward, terminated = (
            batch.get(key).transpose(0, 1) for key in ("action", ("next", "reward"), ("next", "terminated"))
        )
        steps = torch.arange(action.shape[0] + 1, device=action.device, dtype=action.dtype)
        weight = self.rho ** steps.view(-1, 1, 1)

        encoded = self._encode_window(batch)  # (H+1, B, D), one call
        after = encoded[1:].detach()
        # Targets, model and policy need each other's inputs only: on CUDA they run side by side.
        with side_stream(after, reward, terminated) as targets, torch.no_grad():
            target = self._td_target(after, reward, terminated)
        predicted = self._unroll(encoded[0], action)  # (H+1, B, D)
        detached = predicted.detach()
        with side_stream(detached, weight, lane=1) as policy:
            policy_loss, entropy = self._policy_loss(detached, weight)
        targets.join(target)
        consistency, reward_loss, value_loss, q_logits, reward_logits = self._model_losses(
            predicted, after, action, reward, target, weight[:-1]
        )
        policy.join(policy_loss, entropy)
        shown = batch.get("demonstrated", None)
        if self.imitation_coef and shown is not None:
            # Values that have seen demonstrations alone know no other actions: then the policy imitates alone,
            # and the encoder learns for it, too (MoDem's first phase).
            z = torch.where(alone := self.policy_head.all_shown(shown), encoded[:-1], detached[:-1])
            known = self.masked(z, shown.transpose(0, 1))
            error = self.policy_head.imitation_error(self.features(z), action, known)
            policy_loss = torch.where(alone, 0.0, policy_loss) + self.imitation_coef * error

        total = (
            self.consistency_coef * consistency
            + self.reward_coef * reward_loss
            + self.value_coef * value_loss
            + policy_loss
        )
        ends = {}
        if self.termination_head is not None:  # every step weighs the same, as published
            logits = self.termination_head(self.features(predicted[1:]))
            loss = F.binary_cross_entropy_with_logits(logits, terminated.to(logits.dtype))
            total, ends = total + self.termination_coef * loss, {"loss_termination": loss.detach()}
        with torch.no_grad():
            q_mean, q_target_mean, latent_norm, reward_error, outside = self._metrics(
                q_logits.detach(), reward_logits.detach(), target, encoded.detach(), reward
            )
        metrics = {
            "loss_consistency": consistency.detach(),
            "loss_reward": reward_loss.detach(),
            "loss_value": value_loss.detach(),
            "loss_policy": policy_loss.detach(),
            "q_mean": q_mean,
            "q_target_mean": q_target_mean,
            "policy_entropy": entropy.detach(),
            "policy_scale": self.scale.value.clone(),
            "latent_norm": latent_norm,
            "reward_error": reward_error,
            "target_outside": outside,
            **ends,
        }
        return TensorDict({"loss": total, **metrics}, batch_size=[])

    def parameter_groups(self, lr: float) -> list[ParameterGroup]:
        """Groups for Adam: encoder, policy and the rest. Norms of the policy's gradients are clipped apart."""
        encoder, policy = list(self.encoder.parameters()), list(self.policy_head.parameters())
        apart = {id(parameter) for parameter in (*encoder, *policy)}
        encoder = [parameter for parameter in encoder if parameter.requires_grad]
        rest = [parameter for parameter in self.parameters() if id(parameter) not in apart]
        return [
            {"name": "encoder", "clip": "model", "params": encoder, "lr": lr * self.encoder_lr_scale},
            {"name": "model", "clip": "model", "params": rest, "lr": lr},
            {"name": "policy", "clip": "policy", "params": policy, "lr": lr, "eps": 1e-5},
        ]

    def after_update(self) -> None:
        """Move the target Q-functions by `tau`; call once after each optimiser step."""
        self.q_ensemble.update_target(self.tau)

    # ------------------------------------------------------------------ pieces

    def _encode_window(self, batch: TensorDictBase) -> Tensor:
        """Latents (H+1, B, D) of the H+1 observations of windows [B, H]; images are shifted in training."""
        window = window_of(batch, self.observation_keys)
        sizes = self.observation_sizes
        vectors = concatenate(window, sizes).transpose(0, 1) if sizes else None
        images = {key: check_images(window.get(key)) for key in self.image_sizes}
        images = {key: self.random_shift(image).transpose(0, 1) for key, image in images.items()}
        return self.encode_parts(images, vectors)

    def _unroll(self, z: Tensor, actions: Tensor) -> Tensor:
        """Latents (H+1, B, D) from the first one (B, D) and actions (H, B, A)."""
        latents = [z]
        for action in actions:
            latents.append(self.next(latents[-1], action))
        return torch.stack(latents)

    def _model_losses(
        self, predicted: Tensor, after: Tensor, action: Tensor, reward: Tensor, target: Tensor, weight: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Losses of consistency, reward and value, and the logits of values (num_q, H, B, bins) and rewards."""
        before = self.joined(predicted[:-1], action)
        reward_logits = self.reward_head(before)
        q_logits = self.q_ensemble(before, dropout=self.training)
        error = F.mse_loss(self.features(predicted[1:]), self.features(after), reduction="none")
        consistency = (weight * error).mean()
        reward_loss = (weight * self.two_hot.loss(reward_logits, reward)).mean()
        value_loss = (weight * self.two_hot.loss(q_logits, target)).mean()
        return consistency, reward_loss, value_loss, q_logits, reward_logits

    def _metrics(
        self, q_logits: Tensor, reward_logits: Tensor, target: Tensor, encoded: Tensor, reward: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Means of values, targets, norms of latents and errors of rewards; the share of targets outside."""
        q_mean, error = self.two_hot.decode(q_logits).mean(), self.two_hot.decode(reward_logits) - reward
        outside = self.two_hot.outside(reward, target)
        return q_mean, target.mean(), encoded.norm(dim=-1).mean(), error.abs().mean(), outside

    def _td_target(self, after: Tensor, reward: Tensor, terminated: Tensor) -> Tensor:
        """One-step targets (H, B, 1) from encoded next latents (H, B, D): r + γ min of two target Qs."""
        action = self.policy(after, deterministic=self.mode_targets)
        bootstrap = self.q(after, action, weights="target", reduce="pair_min")
        # A selection rather than a product: 0 · nan would poison the target of a terminal step.
        return reward + self.discount * torch.where(terminated, torch.zeros_like(bootstrap), bootstrap)

    def _policy_loss(self, z: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Loss and mean entropy [nat] of the policy at detached latents z (H+1, B, D)."""
        action, log_prob = self.policy_sample(z)
        q = self.q(z, action, weights="detached", reduce="pair_mean", dropout=self.training)
        if self.training:
            self.scale.update(q[0])
        bonus = self.entropy_coef * self.action_dim * -log_prob
        loss = -(weight * (self.scale(q) + bonus)).mean()
        return loss, -log_prob.mean()
