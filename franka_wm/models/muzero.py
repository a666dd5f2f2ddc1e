"""MuZero: a latent model for tree search (Schrittwieser et al., Nature 2020, arXiv:1911.08265)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.errors import UserError
from franka_wm.models.images import ImageSize, check_images
from franka_wm.models.layers import Linear, NormedLinear, SimNorm, TwoHotSymlog, initialize, mlp
from franka_wm.models.returns import discount_per_step, n_step_returns, value_range
from franka_wm.models.simplicial import SimplicialWorldModel
from franka_wm.models.windows import check_windows
from franka_wm.options import COEFFICIENT, DEPTH, FRACTION, POSITIVE, Bounds, with_defaults
from franka_wm.seeding import of_worlds


class MuZero(SimplicialWorldModel):
    """Representation, dynamics and prediction, trained by what a search found and what then happened.

    z = h(s);  z', r = g(z, a);  logits, v = f(z). Actions are M discrete ones. Latents (..., `latent_dim`) are
    simplices of `simnorm_dim` features, from h and g alike. Rewards and values are in the units of the
    environment's reward.

    The loss unrolls g for `unroll` actions from one observation of a window. It compares each step with the
    reward received, the n-step return (see `value_targets`), the policy that the search arrived at, and the
    latent of the observation that came (EfficientZero's consistency, Ye et al., arXiv:2111.00210). The first
    step weighs 1, each later one 1 / `unroll`, and the gradient into z is halved at each use of g.

    Windows start at every step, so a window may go on past the end of its episode. Past an end that terminated,
    actions are random, rewards and values 0: the search learns that nothing is earned there. Past any other end
    nothing is learned.

    Deliberate differences from the papers:
      * Small networks with LayerNorm, and SimNorm in place of min-max scaling, as in TD-MPC2
        (arXiv:2310.16828); rewards and values as two-hot symlog.
      * Raw physical observations can be standardised at the encoder's input, see
        `set_observation_statistics`; the default is the identity.

    Args:
        observation_sizes: observation key -> size of its last dimension; encoded in this order. May be empty
            where there are images.
        image_sizes: image key -> (height, width, channels), uint8; shifted at random in `loss`.
        num_actions: M.
        episode_length: T, steps of an episode, from which the discount follows if it is not given:
            clamp((T/5 - 1) / (T/5), 0.95, 0.995).
        discount: per step, in [0, 1]; without `episode_length` 0.997, as published.
        latent_dim: size of z.
        simnorm_dim: features per simplex; divides `latent_dim`.
        encoder_dim: width of the encoder's hidden layers.
        encoder_layers: layers of the encoder, its output layer included.
        hidden_dim: width of the two hidden layers of g and of f.
        projector_dim: width of the consistency loss's projector; its predictor is half as wide inside.
        channels: of each convolution over images.
        random_shift: pixels by which images are shifted at most, in each direction.
        unroll: number K of actions in the unroll.
        n_step: rewards in a value target before it bootstraps.
        bins, value_low, value_high: two-hot code of rewards and values; the range is in symlog space. None:
            derived from `reward_bounds` and the discount, see `value_range`.
        reward_bounds: the least and the largest reward of a step; None: unknown.
        reward_coef, value_coef, policy_coef, consistency_coef: weights of the losses.
        reanalyze: bootstrap value targets from the model's present value, instead of from what the search found when
            it acted. That is half of MuZero Reanalyse (Schrittwieser et al., arXiv:2104.06294), whose policy targets
            are fresh, too.
        weight_decay: of the matrices.

    Raises:
        ValueError: a size or coefficient that cannot work.
    """

    discrete = True
    cross_episode = (
        True  # the loss looks for the end itself; windows within one episode seldom show what precedes it
    )
    replay_keys = ("search_policy", "search_value")
    ranges: ClassVar[Mapping[str, Bounds]] = {
        **dict.fromkeys(("num_actions", "latent_dim", "simnorm_dim", "encoder_dim"), POSITIVE),
        **dict.fromkeys(("hidden_dim", "channels", "unroll", "n_step"), POSITIVE),
        **dict.fromkeys(("reward_coef", "value_coef", "policy_coef", "consistency_coef"), COEFFICIENT),
        **dict.fromkeys(("projector_dim", "bins"), Bounds(least=2)),
        "discount": FRACTION,
        "random_shift": Bounds(least=0),
        "weight_decay": COEFFICIENT,
        "encoder_layers": DEPTH,
    }
    actions: Tensor

    def __init__(
        self,
        *,
        observation_sizes: Mapping[str, int] | None = None,
        image_sizes: Mapping[str, ImageSize] | None = None,
        num_actions: int,
        episode_length: int | None = None,
        discount: float | None = None,
        latent_dim: int = 256,
        simnorm_dim: int = 8,
        encoder_dim: int = 256,
        encoder_layers: int = 2,
        hidden_dim: int = 256,
        projector_dim: int = 256,
        channels: int = 32,
        random_shift: int = 3,
        unroll: int = 5,
        n_step: int = 5,
        bins: int = 101,
        value_low: float | None = None,
        value_high: float | None = None,
        reward_bounds: tuple[float, float] | None = None,
        reward_coef: float = 1.0,
        value_coef: float = 0.25,
        policy_coef: float = 1.0,
        consistency_coef: float = 2.0,
        reanalyze: bool = False,
        weight_decay: float = 1e-4,
    ) -> None:
        self.validate(locals())
        super().__init__(
            observation_sizes=observation_sizes,
            image_sizes=image_sizes,
            latent_dim=latent_dim,
            simnorm_dim=simnorm_dim,
            encoder_dim=encoder_dim,
            encoder_layers=encoder_layers,
            channels=channels,
            random_shift=random_shift,
        )
        self.num_actions = num_actions
        self.discount = discount_per_step(discount, episode_length, default=0.997)
        self.unroll, self.n_step, self.weight_decay = unroll, n_step, weight_decay
        self.reward_coef, self.value_coef = reward_coef, value_coef
        self.policy_coef, self.consistency_coef = policy_coef, consistency_coef
        self.reanalyze = reanalyze

        # g and f each have one body and two heads: a search calls them once per simulation. Heads are `Linear` of ours,
        # which is faster in compiled searches.
        self.dynamics_body = _body(latent_dim + num_actions, hidden_dim)
        self.dynamics_head = mlp(hidden_dim, (), latent_dim, output=SimNorm(simnorm_dim))
        self.reward_head = Linear(hidden_dim, bins)
        self.prediction_body = _body(latent_dim, hidden_dim)
        self.policy_head = Linear(hidden_dim, num_actions)
        self.value_head = Linear(hidden_dim, bins)
        for head in (self.reward_head, self.policy_head, self.value_head):
            nn.init.zeros_(head.weight)  # first predictions: exactly 0, and all actions alike
            nn.init.zeros_(head.bias)
        self.projector = mlp(latent_dim, (projector_dim,), projector_dim)
        self.predictor = mlp(projector_dim, (projector_dim // 2,), projector_dim)
        self.two_hot = TwoHotSymlog(bins, *value_range(value_low, value_high, reward_bounds, self.discount))
        self.register_buffer("actions", torch.arange(num_actions), persistent=False)

    @property
    def window(self) -> int:
        """Transitions of a window in which the values of all K + 1 steps have full targets.

        The last one, of step K, sums n rewards and bootstraps from step K + n.
        """
        return self.unroll + self.n_step + 1

    @classmethod
    def validate(cls, options: Mapping[str, Any], *, window: int | None = None) -> None:
        super().validate(options, window=window)
        given = with_defaults(cls, options)
        needed = given["unroll"] + given["n_step"] + 1
        if window is not None and window < needed:
            raise UserError(
                f"windows have {window} transitions; with model.unroll={given['unroll']} and model.n_step="
                f"{given['n_step']} the value of the last step reaches over {needed}: use replay.window={needed}"
            )

    # ------------------------------------------------------------------ what a search and a policy use

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """Next latents (..., latent_dim) after discrete actions (...) int64 in z (..., latent_dim)."""
        return self.dynamics_head(self._body(z, action))

    def reward(self, z: Tensor, action: Tensor) -> Tensor:
        """Expected reward (..., 1) of discrete actions (...) int64 in z (..., latent_dim)."""
        return self.two_hot.decode(self.reward_head(self._body(z, action)))

    def value(self, z: Tensor) -> Tensor:
        """Expected discounted return (..., 1) from z (..., latent_dim)."""
        return self.two_hot.decode(self.value_head(self.prediction_body(z)))

    def policy(self, z: Tensor, deterministic: bool = False) -> Tensor:
        """Discrete actions (...) int64 for z (..., latent_dim), without search: a sample, or the likeliest."""
        logits = self.policy_head(self.prediction_body(z))
        if not deterministic:
            # The largest of logits + Gumbel noise is a draw from their softmax.
            draw = of_worlds(lambda shape: logits.new_empty(shape).exponential_(), logits.shape)
            logits = logits - draw.clamp_min(torch.finfo(logits.dtype).tiny).log()
        return logits.argmax(-1)

    def prediction(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (..., M) and value (..., 1) of z (..., latent_dim)."""
        body = self.prediction_body(z)
        return self.policy_head(body), self.two_hot.decode(self.value_head(body))

    def recurrent(self, z: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """One step of a search from z (..., latent_dim) by discrete actions (...).

        Returns:
            Next z, reward (..., 1), discount (..., 1), and the next z's logits (..., M) and value (..., 1).
        """
        body = self._body(z, action)
        after, reward = self.dynamics_head(body), self.two_hot.decode(self.reward_head(body))
        return after, reward, torch.full_like(reward, self.discount), *self.prediction(after)

    # ------------------------------------------------------------------ training

    def loss(self, batch: TensorDictBase) -> TensorDict:
        """Losses of a batch of windows; call `backward` once on the entry `loss`.

        Args:
            batch: batch size [B, H], H ≥ `unroll`: H contiguous transitions, with the observation keys,
                `action` (B, H) int64, `search_policy` (B, H, M), `search_value` (B, H, 1), and in `next` the
                observation keys, `reward` (B, H, 1) and `terminated` (B, H, 1) bool. An entry `is_init`
                (B, H, 1) bool, if there, marks first steps: from the first such step after step 0 on, a window
                is another episode's and ignored. `terminated` may be True only where an episode ends. An entry
                `weight` (B, H) or (B, H, 1), if there, weighs the windows by its first step. With H < `window`,
                value targets are shorter.

        Returns:
            batch size []: `loss` to differentiate, and detached: `loss_reward`, `loss_value`, `loss_policy`,
            `loss_consistency`, `value_mean`, `value_target_mean`, `policy_entropy` [nat], `search_entropy`
            [nat], `reward_error` (mean absolute), `latent_norm`, `target_outside` (share of rewards and targets of
            values that the two-hot code clamps).

        Raises:
            ValueError: another batch size, windows shorter than `unroll`, or no entries of a search.
        """
        self._check(batch)
        reward, terminated = batch.get(("next", "reward")), batch.get(("next", "terminated"))
        steps, device = self.unroll, reward.device
        ends = self._ends(batch)  # (B, 1): the transitions of the first episode
        over = terminated[..., 0].gather(1, ends - 1)  # (B, 1): whether that episode terminated
        step = torch.arange(steps + 1, device=device)
        inside = step < ends  # (B, K+1): steps of the episode

        # Targets, 0 past the episode's end.
        bootstrap = self._present_values(batch, ends) if self.reanalyze else batch.get("search_value")
        returns = self.value_targets(reward, terminated, bootstrap, ends)
        reward_target = _first(reward, inside[:, :-1])
        value_target = _first(returns, inside)
        policy_target = _first(batch.get("search_policy"), inside)

        # The unroll, and the latents of the observations that came.
        actions = self._actions_or_random(batch.get("action"), inside)
        frames = self._frames(batch)
        root = self._encode({key: value[:, 0] for key, value in frames.items()})
        with torch.no_grad():
            came = self._encode({key: value[:, 1:] for key, value in frames.items()})
        predicted, reward_logits = self._unroll(root, actions)
        body = self.prediction_body(predicted)
        policy_logits, value_logits = self.policy_head(body).log_softmax(-1), self.value_head(body)

        # A window that ends before its unroll does, with the episode going on, tells nothing about its last step.
        known = (inside | over).unsqueeze(-1)
        seen = (step[1:] <= ends).unsqueeze(-1)
        scale = torch.full((steps + 1, 1), 1.0 / steps, device=device, dtype=root.dtype)
        scale[0] = 1.0
        weight = batch.get("weight", None)
        weight = 1.0 if weight is None else weight.reshape(*batch.batch_size, 1)[:, :1]

        def total(values: Tensor, mask: Tensor, scale: Tensor) -> Tensor:
            """Mean over windows of the sum over the steps (B, steps, 1) that count."""
            return (weight * scale * torch.where(mask, values, torch.zeros_like(values))).sum(1).mean()

        reward_loss = total(self.two_hot.loss(reward_logits, reward_target), known[:, :-1], scale[1:])
        value_loss = total(self.two_hot.loss(value_logits, value_target), known, scale)
        cross_entropy = -(policy_target * policy_logits).sum(-1, keepdim=True)
        policy_loss = total(cross_entropy, inside.unsqueeze(-1), scale)
        consistency_loss = total(self._consistency(predicted[:, 1:], came), seen, scale[1:])
        loss = (
            self.reward_coef * reward_loss
            + self.value_coef * value_loss
            + self.policy_coef * policy_loss
            + self.consistency_coef * consistency_loss
        )
        with torch.no_grad():
            found, wanted = policy_logits[:, 0], policy_target[:, 0]
            error = (self.two_hot.decode(reward_logits) - reward_target).abs()
            metrics = {
                "loss_reward": reward_loss.detach(),
                "loss_value": value_loss.detach(),
                "loss_policy": policy_loss.detach(),
                "loss_consistency": consistency_loss.detach(),
                "value_mean": self.two_hot.decode(value_logits[:, 0]).mean(),
                "value_target_mean": value_target[:, 0].mean(),
                "policy_entropy": -(found.exp() * found).sum(-1).mean(),
                "search_entropy": -torch.xlogy(wanted, wanted).sum(-1).mean(),
                "reward_error": (error * known[:, :-1]).sum() / known[:, :-1].sum(),
                "latent_norm": predicted[:, 0].norm(dim=-1).mean(),
                "target_outside": self.two_hot.outside(reward_target, value_target),
            }
        return TensorDict({"loss": loss, **metrics}, batch_size=[])

    def value_targets(
        self, reward: Tensor, terminated: Tensor, bootstrap: Tensor, ends: Tensor | None = None
    ) -> Tensor:
        """Value targets (B, H, 1) of windows, see `n_step_returns`."""
        return n_step_returns(
            reward, terminated, bootstrap, discount=self.discount, steps=self.n_step, ends=ends
        )

    # ------------------------------------------------------------------ pieces

    def _check(self, batch: TensorDictBase) -> None:
        _, length = check_windows(batch)
        if length < self.unroll:
            raise ValueError(
                f"windows have {length} transitions, unroll={self.unroll} needs as many; use "
                f"replay.window={self.window}"
            )
        lacking = [key for key in self.replay_keys if batch.get(key, None) is None]
        if lacking:
            raise ValueError(
                f"the batch has no {', '.join(lacking)}: MuZero learns from episodes that a search acted in"
            )

    def _body(self, z: Tensor, action: Tensor) -> Tensor:
        chosen = (action.unsqueeze(-1) == self.actions).to(z.dtype)  # one-hot, without a check on the host
        return self.dynamics_body(torch.cat((z, chosen), dim=-1))

    def _encode(self, observation: Mapping[str, Tensor]) -> Tensor:
        images = {key: check_images(observation[key]) for key in self.image_sizes}
        sizes = self.observation_sizes
        vectors = torch.cat([observation[key] for key in sizes], dim=-1) if sizes else None
        return self.encode_parts(images, vectors)

    def _unroll(self, z: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Latents (B, K+1, D) from the first one (B, D) by actions (B, K), and logits of rewards (B, K, bins)."""
        latents, rewards = [z], []
        for action in actions.unbind(1):
            body = self._body(z, action)
            rewards.append(self.reward_head(body))
            latents.append(self.dynamics_head(body))
            z = 0.5 * latents[-1] + 0.5 * latents[-1].detach()  # half the gradient
        return torch.stack(latents, 1), torch.stack(rewards, 1)

    def _actions_or_random(self, action: Tensor, inside: Tensor) -> Tensor:
        """The first K actions (B, K) of windows; random ones past the episode's end."""
        inside = inside[:, :-1]
        drawn = torch.randint(self.num_actions, inside.shape, device=action.device)
        return torch.where(inside, action[:, : self.unroll], drawn)

    def _ends(self, batch: TensorDictBase) -> Tensor:
        """Number of transitions of each window that are of its first episode (B, 1)."""
        count, length = batch.batch_size
        first = batch.get("is_init", None)
        if first is None:
            return torch.full((count, 1), length, device=batch.get("action").device)
        step = torch.arange(length, device=first.device)
        other = first.reshape(count, length) & (step > 0)
        return torch.where(other, step, length).amin(1, keepdim=True)

    @torch.no_grad()
    def _present_values(self, batch: TensorDictBase, ends: Tensor) -> Tensor:
        """`search_value` (B, H, 1) with the model's present value where the first K + 1 value targets bootstrap."""
        known = batch.get("search_value")
        step = torch.arange(self.unroll + 1, device=known.device)
        stop = torch.minimum(step + self.n_step, ends - 1).unsqueeze(-1)  # (B, K+1, 1)
        row = torch.arange(known.shape[0], device=known.device).unsqueeze(-1)
        seen = {key: batch.get(key)[row, stop[..., 0]] for key in self.observation_keys}
        return known.scatter(1, stop, self.value(self._encode(seen)).to(known.dtype))

    def _frames(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """The first K + 1 observations (B, K+1, ...) of each window; where an episode ends, its true last one."""
        found = {}
        for key in self.observation_keys:
            after = batch.get(("next", key))[:, : self.unroll]
            found[key] = torch.cat((batch.get(key)[:, :1], after), dim=1)
            if key in self.image_sizes:
                found[key] = self.random_shift(check_images(found[key]))
        return found

    def _consistency(self, predicted: Tensor, came: Tensor) -> Tensor:
        """1 - cosine (..., 1) of projections; no gradient through those of the latents that came (SimSiam)."""
        with torch.no_grad():
            target = self.projector(came)
        online = self.predictor(self.projector(predicted))
        return 1.0 - F.cosine_similarity(online, target, dim=-1, eps=1e-6).unsqueeze(-1)


def _body(in_features: int, hidden: int) -> nn.Sequential:
    body = nn.Sequential(NormedLinear(in_features, hidden), NormedLinear(hidden, hidden))
    initialize(body)
    return body


def _first(values: Tensor, inside: Tensor) -> Tensor:
    """The first n steps of windows (B, H, ...) -> (B, n, ...), 0 where not `inside` (B, n)."""
    count, length = inside.shape[1], values.shape[1]
    values = F.pad(values[:, :count], (0, 0, 0, max(0, count - length)))
    return torch.where(inside.unsqueeze(-1), values, torch.zeros_like(values))
