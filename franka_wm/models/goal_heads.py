"""Heads over pairs of embeddings: which action leads from one to another, and how many steps that takes."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models.layers import mlp, zero_head
from franka_wm.seeding import normal_like

LOWEST, HIGHEST = -3.0, 0.0
"""Range of the logarithm of the policy's deviation."""


class GoalHeads(nn.Module):
    """A policy towards a goal and a distance in steps, learned from windows without rewards.

    A pair is a step of a window and a later one of it, drawn uniformly, so both know goals at most a window ahead; with
    frames that were reached later (`replay.future`), half of the goals are these.

    - *Policy*: an inverse-dynamics policy (GC-IDM, arXiv:2605.08732): a Gaussian over the action that was taken, its
      mean within [-1, 1]. It reads a whole frame, with the vectors where the model reads any, and the embedding of
      the goal. Without `gradient` none reaches these: actions that were taken are no property of the scene.
    - *Distance*: what share of a window lies between the two (with frames reached later: of an episode); 1 between
      embeddings of different windows (reachability, RC-aux, arXiv:2605.07278). Its gradient shapes the embeddings, so
      that they tell what is far by actions.

    Args:
        embed_dim: D.
        action_dim: A.
        policy, distance: which of the two there are.
        frame_dim: F, of a whole frame, whose first D features are its embedding; None: D.
        gradient: whether the policy shapes the frames.
        episode_length: steps of an episode: the longest distance where goals are as far as that; None: unknown.
        hidden: width of two hidden layers.
    """

    def __init__(
        self,
        embed_dim: int,
        action_dim: int,
        *,
        policy: bool,
        distance: bool,
        frame_dim: int | None = None,
        gradient: bool = False,
        episode_length: int | None = None,
        hidden: int = 512,
    ) -> None:
        super().__init__()
        self.embed_dim, self.gradient, self.episode_length = embed_dim, gradient, episode_length
        self.actor = self.ruler = None
        if policy:
            self.actor = mlp((frame_dim or embed_dim) + embed_dim, (hidden, hidden), action_dim)
            self.log_std = nn.Parameter(torch.full((action_dim,), -1.0))
        if distance:
            self.ruler = zero_head(2 * embed_dim, (hidden, hidden), 1)

    def act(self, frame: Tensor, goal: Tensor, *, deterministic: bool) -> Tensor:
        """Actions (..., A) in [-1, 1] from frames (..., F) towards goals (..., D): a sample, or the mode."""
        mean, std = self._gaussian(frame, goal)
        return mean if deterministic else (mean + std * normal_like(mean)).clamp(-1.0, 1.0)

    def steps(self, embedded: Tensor, goal: Tensor) -> Tensor:
        """Distance (...) in [0, 1] from embeddings (..., D) to goals (..., D)."""
        return self._logit(embedded, goal).sigmoid()

    def losses(
        self, frames: Tensor, action: Tensor, later: Tensor | None = None, steps: Tensor | None = None
    ) -> tuple[Tensor | None, Tensor | None]:
        """Negative log-likelihood of the actions and cross-entropy of the distances; None for a head that is absent.

        Args:
            frames: (B, H+1, F), of windows.
            action: (B, H, A) between them.
            later: (B, 1, F), of frames that were reached later; None: there are none.
            steps: (B, H, 1), to these frames from each step.

        Raises:
            ValueError: `later` without `steps`, or distances of a model that was not told how long episodes are.
        """
        batch, horizon = action.shape[:2]
        embedded = frames[..., : self.embed_dim]
        now = torch.arange(horizon, device=action.device)
        ahead = (torch.rand(batch, horizon, device=action.device) * (horizon - now)).long() + 1  # 1 … H - t
        within = (now + ahead).unsqueeze(-1).expand(-1, -1, embedded.shape[-1])
        start, goal, longest = embedded[:, :-1], embedded.gather(1, within), horizon + 1
        if later is not None:
            if steps is None or (self.ruler is not None and self.episode_length is None):
                raise ValueError("goals reached later need their steps, and distances to them episode_length")
            far = torch.rand(batch, horizon, device=action.device) < 0.5
            goal = torch.where(far.unsqueeze(-1), later[..., : self.embed_dim], goal)
            ahead = torch.where(far, steps.squeeze(-1), ahead)
            longest = self.episode_length or longest
        policy = distance = None
        if self.actor is not None:
            pair = (frames[:, :-1], goal)
            mean, std = self._gaussian(*(pair if self.gradient else (x.detach() for x in pair)))
            variance = std.float().square()  # torch's gaussian_nll_loss looks at it on the host
            policy = 0.5 * (variance.log() + (action.float() - mean.float()).square() / variance).mean()
        if self.ruler is not None:
            share = (ahead / longest).clamp(max=1.0)
            logits = [
                self._logit(start, goal),
                self._logit(start, start),
                self._logit(start, goal.roll(1, 0)),
            ]
            wanted = torch.stack((share, torch.zeros_like(share), torch.ones_like(share)))
            distance = F.binary_cross_entropy_with_logits(torch.stack(logits).float(), wanted)
        return policy, distance

    def _gaussian(self, frame: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        assert self.actor is not None
        mean = self.actor(torch.cat((frame, goal), dim=-1)).tanh()
        return mean, self.log_std.clamp(LOWEST, HIGHEST).exp().to(mean.dtype)

    def _logit(self, embedded: Tensor, goal: Tensor) -> Tensor:
        assert self.ruler is not None
        return self.ruler(torch.cat((embedded, goal), dim=-1)).squeeze(-1)
