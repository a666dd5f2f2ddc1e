"""MuZero: a latent model for tree search (Schrittwieser et al., Nature 2020, arXiv:1911.08265)."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models.groups import decay_groups
from franka_wm.models.parts import NormedLinear, SimNorm, TwoHotSymlog, initialize, mlp
from franka_wm.models.pixel_encoder import PixelEncoder
from franka_wm.models.returns import episode_discount, value_range
from franka_wm.models.vectors import copy_statistics
from franka_wm.models.vision import RandomShift, check_image_sizes, check_pictures


class MuZero(nn.Module):
    """Representation, dynamics and prediction, trained by what a search found and what then happened.

    z = h(s);  z', r = g(z, a);  logits, v = f(z). Actions are one of M moves. Latents (..., `latent_dim`) are
    simplices of `simnorm_dim` features, from h and g alike. Rewards and values are in the units of the
    environment's reward.

    The loss unrolls g for `unroll` moves from one observation of a window and compares each step with the
    reward received, the n-step return (see `value_targets`), the policy that the search arrived at, and the
    latent of the observation that came (EfficientZero's consistency, Ye et al., arXiv:2111.00210). The first
    step weighs 1, each later one 1 / `unroll`, and the gradient into z is halved at each use of g.

    Every step starts windows, so a window may go on past the end of its episode; what follows is ignored. Past
    an end that terminated, moves are random, rewards and values 0: so the search learns that nothing is earned
    there. Past any other end nothing is learned.

    Deliberate differences from the papers:
      * Small networks with LayerNorm, and SimNorm in place of min-max scaling, as in TD-MPC2
        (arXiv:2310.16828); rewards and values as two-hot symlog.
      * Raw physical observations can be standardised at the encoder's input, see
        `set_observation_statistics`; the default is the identity.

    Args:
        observation_sizes: observation key -> size of its last dimension; encoded in this order. May be empty
            where there are pictures.
        image_sizes: picture key -> (height, width, channels), uint8; shifted at random in `loss`.
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
        channels: of each convolution over pictures.
        random_shift: pixels by which pictures are shifted at most, in each direction.
        unroll: moves, K.
        n_step: rewards in a value target before the stored value of the search takes over, or the model's own.
        bins, value_low, value_high: two-hot code of rewards and values; the range is in symlog space. None:
            derived from `reward_bounds` and the discount, see `value_range`.
        reward_bounds: the least and the largest reward of a step; None: unknown.
        reward_coef, value_coef, policy_coef, consistency_coef: weights of the losses.
        fresh_values: value targets end in the model's value of now instead of in what the search found when it
            acted: half of MuZero Reanalyse (Schrittwieser et al., arXiv:2104.06294), whose policy targets are
            fresh, too.
        weight_decay: of the matrices.

    Raises:
        ValueError: a size or coefficient that cannot work.
    """

    discrete = True
    replay_keys = ("search_policy", "search_value")
    past_end = True  # the loss looks for the end itself: whole windows would seldom show what comes before it
    observation_mean: Tensor
    observation_std: Tensor
    moves: Tensor

    def __init__(
        self,
        *,
        observation_sizes: Mapping[str, int] | None = None,
        image_sizes: Mapping[str, tuple[int, int, int]] | None = None,
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
        fresh_values: bool = False,
        weight_decay: float = 1e-4,
    ) -> None:
        super().__init__()
        sizes = {str(key): int(size) for key, size in (observation_sizes or {}).items()}
        self.image_sizes = check_image_sizes(image_sizes or {})
        if (not sizes and not self.image_sizes) or min(sizes.values(), default=1) < 1:
            raise ValueError(
                f"observation_sizes or image_sizes needs at least one key, each of size 1 or more, got {sizes}"
            )
        for name, count, least in (
            ("num_actions", num_actions, 1),
            ("encoder_layers", encoder_layers, 1),
            ("projector_dim", projector_dim, 2),
            ("unroll", unroll, 1),
            ("n_step", n_step, 1),
        ):
            if count < least:
                raise ValueError(f"{name} must be at least {least}, got {count}")
        if simnorm_dim < 1 or latent_dim % simnorm_dim:
            raise ValueError(f"simnorm_dim must divide latent_dim, got {simnorm_dim} and {latent_dim}")
        self.observation_sizes, self.observation_keys = sizes, [*sizes, *self.image_sizes]
        self.num_actions, self.latent_dim = num_actions, latent_dim
        self.discount = _discount(discount, episode_length)
        self.unroll, self.n_step, self.weight_decay = unroll, n_step, weight_decay
        self.reward_coef, self.value_coef = reward_coef, value_coef
        self.policy_coef, self.consistency_coef = policy_coef, consistency_coef
        self.fresh_values = fresh_values

        observation_dim = sum(sizes.values())
        if self.image_sizes:
            self.encoder: nn.Module = PixelEncoder(
                image_sizes=self.image_sizes,
                observation_dim=observation_dim,
                hidden=(encoder_dim,) * max(1, encoder_layers - 1),
                latent_dim=latent_dim,
                simnorm_dim=simnorm_dim,
                channels=channels,
            )
        else:
            hidden = (encoder_dim,) * (encoder_layers - 1)
            self.encoder = mlp(observation_dim, hidden, latent_dim, output=SimNorm(simnorm_dim))
        self.random_shift = RandomShift(random_shift)
        # g and f each have one body and two heads: a search calls them once per simulation.
        self.dynamics_body = _body(latent_dim + num_actions, hidden_dim)
        self.dynamics_head = mlp(hidden_dim, (), latent_dim, output=SimNorm(simnorm_dim))
        self.reward_head = nn.Linear(hidden_dim, bins)
        self.prediction_body = _body(latent_dim, hidden_dim)
        self.policy_head = nn.Linear(hidden_dim, num_actions)
        self.value_head = nn.Linear(hidden_dim, bins)
        for head in (self.reward_head, self.policy_head, self.value_head):
            nn.init.zeros_(head.weight)  # first predictions: exactly 0, and all moves alike
            nn.init.zeros_(head.bias)
        self.projector = mlp(latent_dim, (projector_dim,), projector_dim)
        self.predictor = mlp(projector_dim, (projector_dim // 2,), projector_dim)
        self.two_hot = TwoHotSymlog(bins, *value_range(value_low, value_high, reward_bounds, self.discount))
        self.register_buffer("moves", torch.arange(num_actions), persistent=False)
        self.register_buffer("observation_mean", torch.zeros(observation_dim))
        self.register_buffer("observation_std", torch.ones(observation_dim))

    @property
    def window(self) -> int:
        """Transitions of a window in which the values of all K + 1 steps have full targets.

        The last one, of step K, sums n rewards and ends in the search's value of step K + n.
        """
        return self.unroll + self.n_step + 1

    @staticmethod
    def refusal(settings: Mapping[str, Any], window: int) -> str | None:
        """Why a run with these options (``conf/model``) cannot learn from windows of so many transitions."""
        unroll, n_step = settings.get("unroll", 5), settings.get("n_step", 5)
        if not (isinstance(unroll, int) and isinstance(n_step, int)) or window >= unroll + n_step + 1:
            return None  # what is no number, the constructor refuses
        return (
            f"windows have {window} transitions; with model.unroll={unroll} and model.n_step={n_step} the value of "
            f"the last step reaches over {unroll + n_step + 1}: use replay.window={unroll + n_step + 1}"
        )

    # ------------------------------------------------------------------ what a search and a policy use

    @torch.no_grad()
    def set_observation_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Standardise vectors at the encoder's input from now on: (s - mean) / std.

        Saved with the weights and never trained. A feature of zero standard deviation is centred only.

        Args:
            mean, std: (sum of `observation_sizes`), in the order of `observation_sizes`.

        Raises:
            ValueError: a wrong shape, a value that is not finite, or a negative standard deviation.
        """
        copy_statistics(self.observation_mean, self.observation_std, mean, std)

    def encode(self, observation: TensorDictBase) -> Tensor:
        """Observations with keys `observation_sizes`, each (..., size), and `image_sizes`, each
        (..., height, width, C) uint8 -> latents (..., latent_dim)."""
        return self._encode({key: observation.get(key) for key in self.observation_keys})

    def rebuild_overrides(self) -> dict[str, Any]:
        """Constructor arguments that replace those which depend on the environment: JSON-able."""
        return self.two_hot.rebuild()

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """Latents (..., latent_dim) and moves (...) int64 -> next latents (..., latent_dim)."""
        return self.dynamics_head(self._body(z, action))

    def reward(self, z: Tensor, action: Tensor) -> Tensor:
        """Expected reward (..., 1) of a move (...) int64 in z (..., latent_dim)."""
        return self.two_hot.decode(self.reward_head(self._body(z, action)))

    def value(self, z: Tensor) -> Tensor:
        """Expected discounted return (..., 1) from z (..., latent_dim)."""
        return self.two_hot.decode(self.value_head(self.prediction_body(z)))

    def policy(self, z: Tensor, deterministic: bool = False) -> Tensor:
        """Moves (...) int64 for z (..., latent_dim), without search: a sample, or the likeliest."""
        logits = self.policy_head(self.prediction_body(z))
        if not deterministic:
            # The largest of logits + Gumbel noise is a draw from their softmax.
            draw = torch.empty_like(logits).exponential_().clamp_min(torch.finfo(logits.dtype).tiny)
            logits = logits - draw.log()
        return logits.argmax(-1)

    def prediction(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """z (..., latent_dim) -> logits (..., M) and value (..., 1)."""
        body = self.prediction_body(z)
        return self.policy_head(body), self.two_hot.decode(self.value_head(body))

    def recurrent(self, z: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """One step of a search: z (..., latent_dim), move (...) -> next z, reward (..., 1), discount (..., 1),
        and the next z's logits (..., M) and value (..., 1)."""
        body = self._body(z, action)
        after, reward = self.dynamics_head(body), self.two_hot.decode(self.reward_head(body))
        return after, reward, torch.full_like(reward, self.discount), *self.prediction(after)

    # ------------------------------------------------------------------ training

    def forward(self, batch: TensorDictBase) -> TensorDict:
        """Same as `loss`, for wrappers that call the module."""
        return self.loss(batch)

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
        if len(batch.batch_size) != 2:
            raise ValueError(f"a batch of windows has batch size [B, H], got {list(batch.batch_size)}")
        count, length = batch.batch_size
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
        action, reward, terminated = (
            batch.get(key) for key in ("action", ("next", "reward"), ("next", "terminated"))
        )
        steps, device = self.unroll, action.device
        ends = self._ends(batch)  # (B, 1): the transitions of the first episode
        over = terminated[..., 0].gather(1, ends - 1)  # (B, 1)
        lent = self._fresh(batch, ends) if self.fresh_values else batch.get("search_value")
        returns = self.value_targets(reward, terminated, lent, ends)
        step = torch.arange(steps + 1, device=device)
        inside = step < ends  # (B, K+1)

        def at(values: Tensor, count: int) -> Tensor:
            """The first `count` steps of windows (B, H, ...), 0 past the episode's end."""
            values = F.pad(values[:, :count], (0, 0, 0, max(0, count - length)))
            return torch.where(inside[:, :count, None], values, torch.zeros_like(values))

        moves = torch.where(
            inside[:, :-1],
            action[:, :steps],
            torch.randint(self.num_actions, (count, steps), device=device),
        )
        frames = self._frames(batch)
        latents = [self._encode({key: value[:, 0] for key, value in frames.items()})]
        with torch.no_grad():
            came = self._encode({key: value[:, 1:] for key, value in frames.items()})
        reward_logits = []
        z = latents[0]
        for k in range(steps):
            body = self._body(z, moves[:, k])
            reward_logits.append(self.reward_head(body))
            latents.append(self.dynamics_head(body))
            z = 0.5 * latents[-1] + 0.5 * latents[-1].detach()  # half the gradient
        reward_logits, predicted = torch.stack(reward_logits, 1), torch.stack(latents, 1)
        body = self.prediction_body(predicted)
        policy_logits, value_logits = self.policy_head(body).log_softmax(-1), self.value_head(body)

        # A window that ends before its unroll does, with the episode going on, knows nothing of its last step.
        known = (inside | over).unsqueeze(-1)
        scale = torch.full((steps + 1, 1), 1.0 / steps, device=device, dtype=z.dtype)
        scale[0] = 1.0
        weight = batch.get("weight", None)
        weight = 1.0 if weight is None else weight.reshape(count, length, 1)[:, :1]

        def total(values: Tensor, mask: Tensor, scale: Tensor) -> Tensor:
            """Mean over windows of the sum over the steps (B, steps, 1) that count."""
            return (weight * scale * torch.where(mask, values, torch.zeros_like(values))).sum(1).mean()

        reward_target, value_target = at(reward, steps), at(returns, steps + 1)
        policy_target = at(batch.get("search_policy"), steps + 1)
        reward_loss = total(self.two_hot.loss(reward_logits, reward_target), known[:, :-1], scale[1:])
        value_loss = total(self.two_hot.loss(value_logits, value_target), known, scale)
        policy_loss = total(
            -(policy_target * policy_logits).sum(-1, keepdim=True), inside.unsqueeze(-1), scale
        )
        seen = (step[1:] <= ends).unsqueeze(-1)
        consistency_loss = total(self._consistency(predicted[:, 1:], came), seen, scale[1:])
        loss = (
            self.reward_coef * reward_loss
            + self.value_coef * value_loss
            + self.policy_coef * policy_loss
            + self.consistency_coef * consistency_loss
        )
        with torch.no_grad():
            root = policy_logits[:, 0]
            wanted = policy_target[:, 0]
            error = (self.two_hot.decode(reward_logits) - reward_target).abs()
            metrics = {
                "loss_reward": reward_loss.detach(),
                "loss_value": value_loss.detach(),
                "loss_policy": policy_loss.detach(),
                "loss_consistency": consistency_loss.detach(),
                "value_mean": self.two_hot.decode(value_logits[:, 0]).mean(),
                "value_target_mean": value_target[:, 0].mean(),
                "policy_entropy": -(root.exp() * root).sum(-1).mean(),
                "search_entropy": -torch.xlogy(wanted, wanted).sum(-1).mean(),
                "reward_error": (error * known[:, :-1]).sum() / known[:, :-1].sum(),
                "latent_norm": predicted[:, 0].norm(dim=-1).mean(),
                "target_outside": self.two_hot.outside(reward_target, value_target),
            }
        return TensorDict({"loss": loss, **metrics}, batch_size=[])

    def value_targets(
        self, reward: Tensor, terminated: Tensor, search_value: Tensor, ends: Tensor | None = None
    ) -> Tensor:
        """n-step returns of the H steps of windows, each within its window and episode.

        Step t sums `n_step` discounted rewards and adds the discounted `search_value` of the step that
        follows. Near the end of an episode that terminated, what is left of the rewards is all. Near any other
        end, also the window's, the last step lends its search value, however near.

        Args:
            reward, search_value: (B, H, 1).
            terminated: (B, H, 1) bool; the last transition of the episode decides.
            ends: (B, 1) int64 in 1 … H, how many transitions belong to the episode; None: all H.

        Returns:
            (B, H, 1); without meaning past the end.
        """
        length, device = reward.shape[1], reward.device
        if ends is None:
            ends = torch.full((reward.shape[0], 1), length, device=device)
        over = terminated[..., 0].gather(1, ends - 1)
        step = torch.arange(length, device=device)
        stop = torch.minimum(step + self.n_step, ends - 1 + over.long())  # (B, H): the first step not summed
        ahead = step - step.unsqueeze(-1)  # (H, H): steps from t, in rows, to k
        base = torch.full((), self.discount, device=device, dtype=reward.dtype)
        discount = base ** ahead.clamp_min(0).to(reward.dtype)
        summed = discount * ((ahead >= 0) & (step < stop.unsqueeze(-1)))  # (B, H, H)
        # Where the episode is over, nothing is lent: stop is then past its last step.
        lent = discount * ((step == stop.unsqueeze(-1)) & (step < ends).unsqueeze(1))
        # Not a matrix product: autocast would round the targets.
        rewards, values = reward.transpose(1, 2), search_value.transpose(1, 2)  # (B, 1, H)
        return (summed * rewards + lent * values).sum(-1, keepdim=True)

    def parameter_groups(self, lr: float) -> list[dict[str, Any]]:
        """Parameter groups for AdamW: matrices with weight decay, the rest without; one gradient norm."""
        return decay_groups(self.parameters(), lr, weight_decay=self.weight_decay)

    def after_update(self) -> None:
        """Nothing: MuZero has no slow copies; its targets come from stored searches, or from the model itself."""

    # ------------------------------------------------------------------ pieces

    def _body(self, z: Tensor, action: Tensor) -> Tensor:
        chosen = (action.unsqueeze(-1) == self.moves).to(z.dtype)  # one-hot, without a check on the host
        return self.dynamics_body(torch.cat((z, chosen), dim=-1))

    def _encode(self, observation: Mapping[str, Tensor]) -> Tensor:
        pictures = {key: check_pictures(observation[key]) for key in self.image_sizes}
        vectors = None
        if self.observation_sizes:
            x = torch.cat([observation[key] for key in self.observation_sizes], dim=-1)
            vectors = (x.to(self.observation_mean.dtype) - self.observation_mean) / self.observation_std
        return self.encoder(pictures, vectors) if pictures else self.encoder(vectors)

    def _ends(self, batch: TensorDictBase) -> Tensor:
        """How many transitions of each window are of its first episode (B, 1)."""
        count, length = batch.batch_size
        first = batch.get("is_init", None)
        if first is None:
            return torch.full((count, 1), length, device=batch.get("action").device)
        step = torch.arange(length, device=first.device)
        other = first.reshape(count, length) & (step > 0)
        return torch.where(other, step, length).amin(1, keepdim=True)

    @torch.no_grad()
    def _fresh(self, batch: TensorDictBase, ends: Tensor) -> Tensor:
        """`search_value` (B, H, 1) with the model's own value where the first K + 1 value targets end."""
        known = batch.get("search_value")
        step = torch.arange(self.unroll + 1, device=known.device)
        stop = torch.minimum(step + self.n_step, ends - 1).unsqueeze(-1)  # (B, K+1, 1)
        row = torch.arange(known.shape[0], device=known.device).unsqueeze(-1)
        seen = {key: batch.get(key)[row, stop[..., 0]] for key in self.observation_keys}
        value = self.two_hot.decode(self.value_head(self.prediction_body(self._encode(seen))))
        return known.scatter(1, stop, value.to(known.dtype))

    def _frames(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """The first K + 1 observations (B, K+1, ...) of each window; where an episode ends, its true last one."""
        found = {}
        for key in self.observation_keys:
            after = batch.get(("next", key))[:, : self.unroll]
            found[key] = torch.cat((batch.get(key)[:, :1], after), dim=1)
            if key in self.image_sizes:
                found[key] = self.random_shift(check_pictures(found[key]))
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


def _discount(discount: float | None, episode_length: int | None) -> float:
    if discount is not None:
        if not 0.0 <= discount <= 1.0:
            raise ValueError(f"discount must be in [0, 1], got {discount}")
        return float(discount)
    return 0.997 if episode_length is None else episode_discount(episode_length)
