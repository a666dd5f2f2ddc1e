"""A short history of frames as one flat latent.

Families whose prediction needs more than the present frame keep their history inside z, so that planners
see a plain `next(z, action)`. Layout of z, oldest first, for a history of K frames of F numbers:

    frames (K · F) | actions between them ((K - 1) · A) | validity (K), 1 where the frame is real

At the start of an episode only the newest frame is real. The others are zeros.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from franka_wm.models.base import WorldModel
from franka_wm.models.goal_heads import GoalHeads
from franka_wm.models.normalizer import ObservationNormalizer


class HistoryWorldModel(WorldModel):
    """World model whose latent is a history of frames: what LeWorldModel and the action world model share.

    A family sets `history`, `vectors` and `feature_dim` (entries of a frame, the first, that goals are compared on),
    and defines `encode_frame` and `next`.
    """

    history: FrameHistory
    feature_dim: int
    vectors: ObservationNormalizer
    goal_heads: GoalHeads | None
    has_goal_policy = False  # of families that call `learn_goals`
    has_goal_steps = False

    def encode_frame(self, observation: TensorDictBase, *, batch_statistics: bool = False) -> Tensor:
        """Frames (..., F) of observations (...).

        Args:
            batch_statistics: whether BatchNorm uses those of the batch, see `BatchNorm`.
        """
        raise self._lacks("encode_frame")

    def set_observation_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Standardise state vectors from now on, see `ObservationNormalizer`."""
        self.vectors.set_statistics(mean, std)

    def encode(self, observation: TensorDictBase) -> Tensor:
        """Latents z (..., latent_dim) of an episode's first observation: a history of one frame."""
        return self.history.start(self.encode_frame(observation))

    def observe(
        self, observation: TensorDictBase, previous_z: Tensor, action: Tensor, is_init: Tensor
    ) -> Tensor:
        """Latents z (E, latent_dim) after `action` led to `observation`: the frame joins the history.

        Args:
            observation: batch size [E].
            previous_z: (E, latent_dim), before the action.
            action: (E, action_dim).
            is_init: (E, 1) bool; where True the observation is an episode's first, and z that of `encode`.
        """
        frame = self.encode_frame(observation)
        pushed = self.history.push(previous_z, action, frame)
        return torch.where(is_init, self.history.start(frame), pushed)

    def embed(self, z: Tensor) -> Tensor:
        """What goals are compared on (..., feature_dim), of the newest frame."""
        return self.history.last(z)[..., : self.feature_dim]

    def learn_goals(
        self,
        *,
        policy: float,
        steps: float,
        episode_length: int | None,
        gradient: bool = False,
    ) -> None:
        """Adds the heads of `GoalHeads`, with these weights in the loss; 0: without. The last of a constructor."""
        self.has_goal_policy, self.has_goal_steps = policy > 0, steps > 0
        self._goal_coefs = (policy, steps)
        self.goal_heads = None
        if policy or steps:
            size = self.history.action_dim
            self.goal_heads = GoalHeads(
                self.feature_dim,
                size,
                policy=policy > 0,
                distance=steps > 0,
                frame_dim=self.history.frame_dim,
                gradient=gradient,
                episode_length=episode_length,
            )

    def goal_policy(self, z: Tensor, goal: Tensor, deterministic: bool = False) -> Tensor:
        """Actions (..., A) that lead from z (..., latent_dim) towards goals (..., D), of a model that learns them."""
        if not self.has_goal_policy or self.goal_heads is None:
            raise self._lacks("goal_policy")
        return self.goal_heads.act(self.history.last(z), goal, deterministic=deterministic)

    def goal_steps(self, embedded: Tensor, goal: Tensor) -> Tensor:
        """Learned distance (...) in [0, 1] of embeddings (..., D) to goals (..., D); 1: a window or more (with
        `replay.future`: an episode)."""
        if not self.has_goal_steps or self.goal_heads is None:
            raise self._lacks("goal_steps")
        return self.goal_heads.steps(embedded, goal)

    def goal_losses(self, frames: Tensor, batch: TensorDictBase) -> dict[str, Tensor]:
        """Weighted losses of these heads, of frames (B, H+1, F) of a batch's windows, or (B, H+2, F) with one that was
        reached later behind them (`with_future`).
        """
        if self.goal_heads is None:
            return {}
        action, steps = batch.get("action"), batch.get(("future", "steps"), None)
        count = action.shape[1] + 1
        later = None if steps is None else frames[:, count:]
        found = zip(("loss_goal_policy", "loss_goal_steps"), self._goal_coefs, strict=True)
        losses = self.goal_heads.losses(frames[:, :count], action, later, steps)
        pairs = zip(found, losses, strict=True)
        return {name: coef * loss for (name, coef), loss in pairs if loss is not None}

    def unpack(self, z: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Inputs of a predictor from z (..., latent_dim) and the next action (..., A), N = number of latents.

        Returns:
            Frames (N, K, F), the action taken at each (N, K, A), and which frames are real (N, K).
        """
        count = z.shape[:-1].numel()  # and not -1: of K = 1 frame there are no actions, which tell no size
        frames, actions, valid = (x.reshape(count, *x.shape[z.dim() - 1 :]) for x in self.history.split(z))
        now = action.reshape(count, 1, self.history.action_dim)
        return frames, torch.cat((actions, now.to(actions.dtype)), dim=1), valid

    def feed_back(self, frames: Tensor, action: Tensor, steps: int) -> Tensor:
        """Predict the last frames of windows, each from the prediction before.

        Args:
            frames: (B, H+1, F).
            action: (B, H, A) between them.
            steps: number of predictions, at most H.

        Returns:
            (B, steps, F), of the last `steps` frames.
        """
        horizon = action.shape[1]
        start = horizon - steps
        z = self.history.gather(frames[:, : start + 1], action)[:, -1]
        predicted = []
        for t in range(start, horizon):
            z = self.next(z, action[:, t])
            predicted.append(self.history.last(z))
        return torch.stack(predicted, dim=1)


class FrameHistory:
    """Packs and unpacks z; holds no tensors. Leading dimensions are free.

    Args:
        length: K, at least 1.
        frame_dim: F.
        action_dim: A.

    Raises:
        ValueError: a size below 1.
    """

    def __init__(self, *, length: int, frame_dim: int, action_dim: int) -> None:
        for name, value in (("history", length), ("frame_dim", frame_dim), ("action_dim", action_dim)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self.length, self.frame_dim, self.action_dim = length, frame_dim, action_dim
        self.sizes = (length * frame_dim, (length - 1) * action_dim, length)
        self.size = sum(self.sizes)

    def start(self, frame: Tensor) -> Tensor:
        """The z (..., size) of an episode's first frame (..., F)."""
        leading = frame.shape[:-1]
        before = frame.new_zeros(*leading, self.sizes[0] - self.frame_dim)
        between = frame.new_zeros(*leading, self.sizes[1] + self.length - 1)
        return torch.cat((before, frame, between, frame.new_ones(*leading, 1)), dim=-1)

    def push(self, z: Tensor, action: Tensor, frame: Tensor) -> Tensor:
        """The z after `action` (..., A) led to `frame` (..., F); the oldest frame is dropped."""
        frames, actions, valid = z.split(self.sizes, dim=-1)
        if self.length > 1:
            actions = torch.cat((actions[..., self.action_dim :], action.to(z.dtype)), dim=-1)
        new = torch.ones_like(valid[..., :1])
        return torch.cat(
            (frames[..., self.frame_dim :], frame.to(z.dtype), actions, valid[..., 1:], new), dim=-1
        )

    def last(self, z: Tensor) -> Tensor:
        """The newest frame (..., F) of z."""
        return z[..., self.sizes[0] - self.frame_dim : self.sizes[0]]

    def split(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Frames (..., K, F), actions (..., K - 1, A) and validity (..., K) of z."""
        frames, actions, valid = z.split(self.sizes, dim=-1)
        return (
            frames.unflatten(-1, (self.length, self.frame_dim)),
            actions.reshape(*actions.shape[:-1], self.length - 1, self.action_dim),
            valid,
        )

    def gather(self, frames: Tensor, actions: Tensor) -> Tensor:
        """The z at every step of a window.

        Args:
            frames: (B, T, F), of one episode, contiguous.
            actions: (B, T - 1, A) between them, or more of them, the rest unused.

        Returns:
            (B, T, size); the first has a history of one frame, the second of two, and so on up to K.
        """
        steps = [self.start(frames[:, 0])]
        for t in range(1, frames.shape[1]):
            steps.append(self.push(steps[-1], actions[:, t - 1], frames[:, t]))
        return torch.stack(steps, dim=1)

    def windows(self, x: Tensor) -> Tensor:
        """Cut (B, T, ...) into all runs of K steps, (B · (T - K + 1), K, ...); as it is where T <= K."""
        if x.shape[1] <= self.length:
            return x
        return x.unfold(1, self.length, 1).movedim(-1, 2).flatten(0, 1)
