"""DreamerV3: a recurrent model and a policy learned in its imagination (Hafner et al., 2023, arXiv:2301.04104)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from franka_wm.errors import UserError
from franka_wm.keys import CONTEXT
from franka_wm.models.actor_critic import ActorCritic
from franka_wm.models.dreamer_images import PixelEncoder
from franka_wm.models.ema import frozen_copy
from franka_wm.models.images import ImageSize, check_image_sizes
from franka_wm.models.layers import TwoHotSymlog, symlog
from franka_wm.models.normalizer import ObservationNormalizer
from franka_wm.models.returns import RunningScale, discount_per_step, value_range
from franka_wm.models.rssm import RSSM, divergence, network
from franka_wm.models.vision import ConvDecoder
from franka_wm.models.windows import check_windows, window_of
from franka_wm.options import COEFFICIENT, DEPTH, FRACTION, POSITIVE, Bounds, with_defaults
from franka_wm.streams import side_stream


class Dreamer(ActorCritic):
    """RSSM, decoder, reward, end, actor and critic.

    z = (h, s), see `RSSM`. The world model is trained to reconstruct observations, rewards and ends from z, and to
    guess s before it sees the observation. Actor and critic are trained on trajectories of `imagination` steps that
    the model imagines from every state of a batch; no gradient of theirs reaches the model, but for the critic's on
    recorded rewards. The model has memory: `observe` carries z along. The defaults are the published 12 M size.

    Deliberate differences from the paper (docs/models/dreamer.md):
      * A window lies within one episode. Its memory begins empty (as published, with what the replay kept, by
        `stored_state`) and goes through the `burn_in` steps before it. Its first step's divergences are left out.
      * `encode`, `observe` and `next` take the likeliest codes: what acts and plans is deterministic. Training draws.
      * Vectors are standardised before symlog, see `set_observation_statistics`; the default is the identity. With
        `standardize_images` images are standardised, too.
      * AdamW with clipped gradient norms (of model, actor and critic apart) instead of LaProp with adaptive clipping.
      * The encoder of vectors ends with a plain linear layer, one of its `encoder_layers`.
      * Convolutions read and give four pixels of an image as one of an image half as large, see `PixelEncoder`.
      * The two-hot code is TD-MPC2's: bins are equidistant in symlog space, and its expectation is taken there.

    Args:
        observation_sizes: observation key -> size of its last dimension; encoded in this order. May be empty
            where there are images.
        image_sizes: image key -> (height, width, channels), uint8; height and width are the same of all.
        action_dim: size of an action; each component lies in [-1, 1].
        episode_length: steps of an episode, from which the discount follows if it is not given:
            clamp((T/5 - 1) / (T/5), 0.95, 0.995).
        discount: per step, in [0, 1); without `episode_length` 0.997, as published.
        deter_dim: size of h; a multiple of `blocks`.
        hidden_dim: width of all hidden layers.
        codes, classes: s are so many one-hot codes of so many classes.
        blocks: of the recurrent matrix.
        unimix: share of the uniform distribution in those of codes.
        encoder_layers: layers of the encoder, and hidden ones of the decoder, of vectors.
        channels: of the convolutions that read and draw images, see `PixelEncoder` and `ConvDecoder`.
        standardize_images: by a mean image and one deviation, see `set_image_statistics`.
        bins, value_low, value_high: two-hot code of rewards and values; the range is in symlog space. None:
            derived from `reward_bounds` and the discount, see `value_range`.
        reward_bounds: the least and the largest reward of a step; None: unknown.
        terminates: whether episodes may terminate; else there is no head for it.
        free_nats: divergences below this are not reduced further.
        dynamics_coef, representation_coef: weights of the prior's and the posterior's divergence.
        decoder_coef: weight of reconstruction; at 0 there is no decoder, and rewards, ends and values shape z.
        vector_coef: weight of the vectors' reconstruction relative to the images'.
        reward_coef, termination_coef, replay_value_coef: weights of these losses; the last is the critic's on
            recorded rewards.
        imagination: steps of an imagined trajectory.
        return_lambda: λ of the returns.
        entropy_coef: weight, against scaled advantages, of the actor's entropy [nat].
        std_min, std_max: bounds of the actor's standard deviation.
        burn_in: steps in front of each window that `loss` takes, see there.
        stored_state: memory begins with what the acting policy had, which the replay keeps.
        actor_gradient: "reinforce", that of advantages, as published; "dynamics", that of the returns themselves,
            back through rewards, critic and imagined steps (DreamerV1, arXiv:1912.01603).
        actor_critic_lr_scale: learning rate of actor and critic relative to the model's.
        tau, scale_tau: how far the slow critic and the scale of returns move at each update.

    Raises:
        ValueError: a size or coefficient that cannot work, images of several sizes, or nothing to read.
    """

    moved_windows = True
    ranges: ClassVar[Mapping[str, Bounds]] = {
        **dict.fromkeys(("action_dim", "deter_dim", "hidden_dim", "codes", "blocks"), POSITIVE),
        **dict.fromkeys(("channels", "imagination"), POSITIVE),
        **dict.fromkeys(("classes", "bins"), Bounds(least=2, most=10**6)),
        **dict.fromkeys(("free_nats", "dynamics_coef", "representation_coef", "decoder_coef"), COEFFICIENT),
        **dict.fromkeys(("vector_coef", "reward_coef", "termination_coef"), COEFFICIENT),
        **dict.fromkeys(("replay_value_coef", "entropy_coef", "actor_critic_lr_scale"), COEFFICIENT),
        "burn_in": Bounds(least=0, most=1000),
        **dict.fromkeys(("discount", "unimix"), Bounds(least=0, below=1)),
        **dict.fromkeys(("tau", "scale_tau"), Bounds(above=0, most=1)),
        **dict.fromkeys(("std_min", "std_max"), Bounds(above=0, most=1e6)),
        "return_lambda": FRACTION,
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
        deter_dim: int = 2048,
        hidden_dim: int = 256,
        codes: int = 32,
        classes: int = 16,
        blocks: int = 8,
        unimix: float = 0.01,
        encoder_layers: int = 3,
        channels: int = 32,
        standardize_images: bool = False,
        bins: int = 255,
        value_low: float | None = None,
        value_high: float | None = None,
        reward_bounds: tuple[float, float] | None = None,
        terminates: bool = False,
        free_nats: float = 1.0,
        dynamics_coef: float = 1.0,
        representation_coef: float = 0.1,
        decoder_coef: float = 1.0,
        vector_coef: float = 1.0,
        reward_coef: float = 1.0,
        termination_coef: float = 1.0,
        replay_value_coef: float = 0.3,
        imagination: int = 15,
        return_lambda: float = 0.95,
        entropy_coef: float = 3e-4,
        std_min: float = 0.1,
        std_max: float = 1.0,
        burn_in: int = 0,
        stored_state: bool = False,
        actor_gradient: Literal["reinforce", "dynamics"] = "reinforce",
        actor_critic_lr_scale: float = 1.0,
        tau: float = 0.02,
        scale_tau: float = 0.01,
    ) -> None:
        self.validate(locals())
        super().__init__()
        self.vectors = ObservationNormalizer(observation_sizes)
        self.observation_sizes, self.image_sizes = self.vectors.sizes, check_image_sizes(image_sizes)
        if not self.observation_keys:
            raise ValueError("give observation_sizes or image_sizes: there is nothing to read")
        if standardize_images and not self.image_sizes:
            raise ValueError(
                "standardize_images=True: it reads no images; let it read pixels, or leave it out"
            )
        self.discount = discount_per_step(discount, episode_length, default=0.997)
        self.action_dim, self.terminates, self.free_nats = action_dim, terminates, free_nats
        self.dynamics_coef, self.representation_coef = dynamics_coef, representation_coef
        self.decoder_coef, self.vector_coef, self.reward_coef = decoder_coef, vector_coef, reward_coef
        self.termination_coef, self.replay_value_coef = termination_coef, replay_value_coef
        self.burn_in, self.replay_keys = burn_in, (CONTEXT,) if stored_state else ()
        self.imagination, self.return_lambda, self.entropy_coef = imagination, return_lambda, entropy_coef
        self.std_min, self.std_max, self.actor_gradient = std_min, std_max, actor_gradient
        self.actor_critic_lr_scale = actor_critic_lr_scale

        deep, size = (hidden_dim,) * encoder_layers, self.vectors.size
        self.image_encoder = self.image_decoder = None
        if seen := self.image_sizes:
            self.image_encoder = PixelEncoder(seen, channels=channels, standardize=standardize_images)
        self.standardized_images = list(self.image_sizes) if standardize_images else ()
        self.vector_encoder = network(size, deep[1:], hidden_dim) if size else None
        embed_dim = (self.image_encoder.features if self.image_encoder else 0) + (hidden_dim if size else 0)
        self.rssm = RSSM(
            embed_dim=embed_dim,
            action_dim=action_dim,
            deter_dim=deter_dim,
            hidden_dim=hidden_dim,
            codes=codes,
            classes=classes,
            blocks=blocks,
            unimix=unimix,
        )
        self.latent_dim = width = self.rssm.size
        decodes = decoder_coef > 0.0
        self.vector_decoder = network(width, deep, size) if size and decodes else None
        if self.image_encoder is not None and decodes:
            self.image_decoder = ConvDecoder(width, self.image_encoder.image_size, channels=channels)
        self.reward_head = network(width, (hidden_dim,), bins, scale=0.0)
        self.termination_head = network(width, (hidden_dim,), 1) if terminates else None
        self.actor = network(width, (hidden_dim,) * 3, 2 * action_dim, scale=0.01)
        self.critic = network(width, (hidden_dim,) * 3, bins, scale=0.0)
        self.slow_critic = frozen_copy(self.critic)
        self.two_hot = TwoHotSymlog(bins, *value_range(value_low, value_high, reward_bounds, self.discount))
        self.scale = RunningScale(scale_tau)
        self.register_buffer("keep", torch.tensor(1.0 - tau), persistent=False)

    @classmethod
    def validate(cls, options: Mapping[str, Any], *, window: int | None = None) -> None:
        super().validate(options, window=window)
        given = with_defaults(cls, options)
        if given["deter_dim"] % given["blocks"]:
            raise UserError(
                f"model.blocks={given['blocks']}: must divide model.deter_dim={given['deter_dim']}"
            )
        if not given["std_min"] < given["std_max"]:
            raise UserError(
                f"model.std_min={given['std_min']}: must be below model.std_max={given['std_max']}"
            )

    # ------------------------------------------------------------------ what a planner and a policy use

    def encode(self, observation: TensorDictBase) -> Tensor:
        """Latents z (..., latent_dim) of an episode's first observation."""
        embedded = self._embed(observation)
        return self._see(self.rssm.begin(embedded), embedded, sample=False)[0]

    def observe(
        self, observation: TensorDictBase, previous_z: Tensor, action: Tensor, is_init: Tensor
    ) -> Tensor:
        """Latents z (E, latent_dim) after `action` led to `observation`, see `WorldModel.observe`."""
        # From nothing where an episode begins, as `RSSM.begin`.
        h = self.rssm.recur(previous_z.masked_fill(is_init, 0.0), action.masked_fill(is_init, 0.0))
        return self._see(h, self._embed(observation), sample=False)[0]

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """Next latents (..., latent_dim), with the likeliest codes, after actions (..., action_dim)."""
        return self.rssm.next(z, action, sample=False)

    def reward(self, z: Tensor, action: Tensor) -> Tensor:
        """Expected reward (..., 1) of an action (..., action_dim) in z (..., latent_dim): that of the next z."""
        return self.arrival_reward(self.next(z, action))

    def arrival_reward(self, z: Tensor) -> Tensor:
        """Expected reward (..., 1) of the action that led to z (..., latent_dim)."""
        return self.two_hot.decode(self.reward_head(z))

    def terminated(self, z: Tensor) -> Tensor:
        """Whether an episode ends in z (..., latent_dim), likelier than not: (..., 1) bool.

        Raises:
            ValueError: the model was built for episodes that do not terminate.
        """
        if self.termination_head is None:
            raise ValueError("this model was built without terminates=True: it does not predict ends")
        return self.termination_head(z) > 0.0

    # ------------------------------------------------------------------ training

    parts_of_loss = (
        "_embed",
        "_step",
        "_steps",
        "_imagined_step",
        "_model_loss",
        "_actor_critic_loss",
        "_replay_value_loss",
    )
    """Compiled one by one: all steps of a long window in one program would take minutes to compile."""
    repeated = ("rssm", "actor")
    unrolled = 8
    """Steps of a window in one program, which sums their gradients itself."""

    def loss(self, batch: TensorDictBase) -> TensorDict:
        """Losses of a batch of windows; call `backward` once on the entry `loss`.

        In training mode the running scale of returns is updated as well.

        Args:
            batch: batch size [B, burn_in + H]: H contiguous transitions, all of one episode, with the observation keys,
                `action` (…, A), and in `next` the observation keys, `reward` (…, 1) and `terminated` (…, 1) bool. In
                front of them `burn_in` steps, of any episode, from which the memory begins; with them, `is_init`
                (…, 1) bool of all. With `stored_state` also that, and `context` (…, latent_dim), z as it was at play.

        Returns:
            batch size []: `loss` to differentiate, and detached: `loss_dynamics` and `loss_representation` [nat, not
            below `free_nats`], `loss_decoder`, `loss_reward`, `loss_policy`, `loss_value`, `loss_replay_value`,
            `value_mean`, `return_mean`, `policy_entropy` [nat], `policy_scale`, `reward_error` (mean absolute),
            `prior_entropy` [nat], `target_outside` (share of rewards and returns that the two-hot code clamps); with
            `terminates` also `loss_termination`.

        Raises:
            ValueError: the batch size is not [B, burn_in + H], or an entry is missing that the memory begins with.
        """
        count = check_windows(batch)[1]
        if self.burn_in and (count <= self.burn_in or batch.get("is_init", None) is None):
            raise ValueError(
                f"burn_in={self.burn_in}: windows have so many steps in front (and `is_init`), not {count} in all"
            )
        if self.replay_keys and (batch.get(CONTEXT, None) is None or batch.get("is_init", None) is None):
            raise ValueError(f"stored_state=True: the batch must have `{CONTEXT}` and `is_init`, see there")
        whole, (_, batch) = batch, batch.split([self.burn_in, count - self.burn_in], dim=1)
        # Time leads from here on: (H, B, ...).
        action, reward, terminated = (
            batch.get(key).transpose(0, 1) for key in ("action", ("next", "reward"), ("next", "terminated"))
        )
        window = window_of(batch, self.observation_keys).transpose(0, 1)
        observed = [window.get(key) for key in self.observation_keys]
        # On CUDA, parts that do not wait for each other's results run side by side.
        # Weights that `lowered` casts for this update alone are read there, too.
        with side_stream(*observed, *self.rssm.of_observation.parameters()) as seen:
            embedded = self._embed(window)
        h = self._remember(whole, embedded[0])
        seen.join(embedded)
        z, posterior = self._filter(h, embedded, action)  # (H+1, B, ...)
        read = (z, posterior, *observed, reward, terminated, *self.rssm.prior_head.parameters())
        with side_stream(*read) as model:
            model_loss, model_metrics = self._model_loss(z, posterior, window, reward, terminated)
        imagined, actions = self._imagine(z.detach().flatten(0, 1))
        begun = torch.cat((torch.ones_like(reward[:1]), (~terminated).to(reward.dtype)))
        policy_loss, value_loss, entropy, returns, value = self._actor_critic_loss(
            imagined, actions, begun.flatten(0, 1)
        )
        replay_value_loss = self._replay_value_loss(z, returns[0], reward, terminated)
        model.join(model_loss, *model_metrics.values())
        metrics = {
            **model_metrics,
            "loss_policy": policy_loss,
            "loss_value": value_loss,
            "loss_replay_value": replay_value_loss,
            "value_mean": value.mean(),
            "return_mean": returns.mean(),
            "policy_entropy": entropy,
            "policy_scale": self.scale.value.clone(),
            "target_outside": self.two_hot.outside(reward, returns),
        }
        loss = model_loss + policy_loss + value_loss + self.replay_value_coef * replay_value_loss
        detached = {name: value.detach() for name, value in metrics.items()}
        return TensorDict({"loss": loss, **detached}, batch_size=[])

    def set_observation_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Standardise vectors from now on, see `ObservationNormalizer`."""
        self.vectors.set_statistics(mean, std)

    def set_image_statistics(self, moments: Mapping[str, Sequence[Tensor]]) -> None:
        """Standardise images from now on, of models with `standardize_images`, see `PixelEncoder.set_statistics`."""
        assert self.image_encoder is not None
        self.image_encoder.set_statistics(moments)

    def rebuild_overrides(self) -> dict[str, Any]:
        """The range of rewards and values, wherever it came from."""
        return self.two_hot.rebuild()

    # ------------------------------------------------------------------ pieces

    def _embed(self, observation: TensorDictBase) -> Tensor:
        """What the posterior reads (..., hidden_dim) of observations (...)."""
        parts = []
        if self.image_encoder is not None:
            parts.append(self.image_encoder(self.image_encoder.images(observation)))
        if self.vector_encoder is not None:
            parts.append(self.vector_encoder(symlog(self.vectors(observation))))
        return self.rssm.of_observation(torch.cat(parts, dim=-1))

    def _see(self, h: Tensor, embedded: Tensor, *, sample: bool) -> tuple[Tensor, Tensor]:
        """States (..., Z) and posteriors (..., codes, classes) of h and features (..., E)."""
        posterior = self.rssm.posterior(h, embedded)
        return self.rssm.state(h, posterior, sample=sample), posterior

    def _step(self, h: Tensor, embedded: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """z (B, Z) and its posterior (B, codes, classes), as `_see` draws, and the next h (B, deter_dim)."""
        z, posterior = self._see(h, embedded, sample=True)
        return z, posterior, self.rssm.recur(z, action)

    def _remember(self, batch: TensorDictBase, embedded: Tensor) -> Tensor:
        """h (B, deter_dim) of a window's first step, whose features are (B, E), after the steps before it.

        No gradient reaches these: stored state and burn-in of R2D2 (Kapturowski et al., 2019).
        """
        h = begin = self.rssm.begin(embedded)
        if self.replay_keys:
            h = batch.get(CONTEXT)[:, 0, : self.rssm.deter_dim].to(begin.dtype)
        elif not self.burn_in:
            return begin
        is_init, action = (batch.get(key).transpose(0, 1) for key in ("is_init", "action"))
        if self.burn_in:
            with torch.no_grad():
                earlier = batch.split(self.burn_in, dim=1)[0].select(*self.observation_keys)
                features = self._embed(earlier.transpose(0, 1))
                for t in range(self.burn_in):
                    _, _, h = self._step(torch.where(is_init[t], begin, h), features[t], action[t])
        return torch.where(is_init[self.burn_in], begin, h)

    def _filter(self, h: Tensor, embedded: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """States (H+1, B, Z) and posteriors (H+1, B, codes, classes) of features (H+1, B, E), actions (H, B, A).

        h (B, deter_dim) is the first step's.
        """
        states, posteriors = [], []
        for some, actions in zip(
            embedded[:-1].split(self.unrolled), action.split(self.unrolled), strict=True
        ):
            z, posterior, h = self._steps(h, some, actions)
            states.append(z)
            posteriors.append(posterior)
        z, posterior = self._see(h, embedded[-1], sample=True)
        return torch.cat((*states, z.unsqueeze(0))), torch.cat((*posteriors, posterior.unsqueeze(0)))

    def _steps(self, h: Tensor, embedded: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`_step` after `_step` with features (K, B, E), actions (K, B, A): z and posteriors (K, B, ...), last h."""
        states, posteriors = [], []
        for t in range(action.shape[0]):
            z, posterior, h = self._step(h, embedded[t], action[t])
            states.append(z)
            posteriors.append(posterior)
        return torch.stack(states), torch.stack(posteriors), h

    def _model_loss(
        self, z: Tensor, posterior: Tensor, window: TensorDictBase, reward: Tensor, terminated: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The world model's loss () and its parts, for states z (H+1, B, Z) and posteriors of a window."""
        prior = self.rssm.prior(z[1:, ..., : self.rssm.deter_dim])
        dynamics = divergence(posterior[1:].detach(), prior).clamp_min(self.free_nats).mean()
        representation = divergence(posterior[1:], prior.detach()).clamp_min(self.free_nats).mean()
        reconstruction = self._reconstruction(z, window)
        reward_logits = self.reward_head(z[1:])
        reward_loss = self.two_hot.loss(reward_logits, reward).mean()
        loss = (
            self.dynamics_coef * dynamics
            + self.representation_coef * representation
            + self.decoder_coef * reconstruction
            + self.reward_coef * reward_loss
        )
        with torch.no_grad():
            error = (self.two_hot.decode(reward_logits) - reward).abs().mean()
            prior_entropy = -(prior.exp() * prior).sum((-2, -1)).mean()
        parts = {
            "loss_dynamics": dynamics,
            "loss_representation": representation,
            "loss_decoder": reconstruction,
            "loss_reward": reward_loss,
            "reward_error": error,
            "prior_entropy": prior_entropy,
        }
        if self.termination_head is not None:
            logits = self.termination_head(z[1:])
            termination = F.binary_cross_entropy_with_logits(logits, terminated.to(logits.dtype))
            loss, parts["loss_termination"] = loss + self.termination_coef * termination, termination
        return loss, parts

    def _reconstruction(self, z: Tensor, window: TensorDictBase) -> Tensor:
        """Squared errors (), summed over an observation: of symlog vectors, weighted, and of images in [0, 1]."""
        total = z.new_zeros(())
        if self.vector_decoder is not None:
            error = self.vector_decoder(z) - symlog(self.vectors(window))
            total = total + self.vector_coef * error.square().sum(-1).mean()
        if self.image_encoder is not None and self.image_decoder is not None:
            error = self.image_decoder(z) - self.image_encoder.images(window).to(z.dtype) / 255.0
            total = total + error.square().sum((-3, -2, -1)).mean()
        return total
