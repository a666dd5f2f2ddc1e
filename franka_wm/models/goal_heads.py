"""Heads over pairs of embeddings: which action leads from one to another, and how many steps that takes."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models.layers import mlp, zero_head

LOWEST, HIGHEST = -3.0, 0.0
"""Range of the logarithm of the policy's deviation."""


class GoalHeads(nn.Module):
    """A policy towards a goal and a distance in steps, learned from windows without rewards.

    A pair is a step of a window and a later one of it, drawn uniformly, so both know goals at most a window ahead.

    - *Policy*: an inverse-dynamics policy (GC-IDM, arXiv:2605.08732): a Gaussian over the action that was taken, its
      mean within [-1, 1]. No gradient reaches the embeddings: actions that were taken are no property of the scene.
    - *Distance*: what share of a window lies between the two; 1 between embeddings of different windows (reachability,
      RC-aux, arXiv:2605.07278). Its gradient shapes the embeddings, so that they tell what is far by actions.

    Args:
        embed_dim: D.
        action_dim: A.
        policy, distance: which of the two there are.
        hidden: width of two hidden layers.
    """

    def __init__(
        self, embed_dim: int, action_dim: int, *, policy: bool, distance: bool, hidden: int = 512
    ) -> None:
        super().__init__()
        self.actor = self.ruler = None
        if policy:
            self.actor = mlp(2 * embed_dim, (hidden, hidden), action_dim)
            self.log_std = nn.Parameter(torch.full((action_dim,), -1.0))
        if distance:
            self.ruler = zero_head(2 * embed_dim, (hidden, hidden), 1)

    def act(self, embedded: Tensor, goal: Tensor, *, deterministic: bool) -> Tensor:
        """Actions (..., A) from embeddings (..., D) towards goals (..., D): a sample, or the mode."""
        mean, std = self._gaussian(embedded, goal)
        return mean if deterministic else mean + std * torch.randn_like(mean)

    def steps(self, embedded: Tensor, goal: Tensor) -> Tensor:
        """Distance (...) in [0, 1] from embeddings (..., D) to goals (..., D)."""
        return self._logit(embedded, goal).sigmoid()

    def losses(self, embedded: Tensor, action: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Negative log-likelihood of the actions and cross-entropy of the distances; None for a head that is absent.

        Args:
            embedded: (B, H+1, D), of the frames of windows.
            action: (B, H, A) between them.
        """
        batch, horizon = action.shape[:2]
        now = torch.arange(horizon, device=action.device)
        ahead = (torch.rand(batch, horizon, device=action.device) * (horizon - now)).long() + 1  # 1 … H - t
        later = (now + ahead).unsqueeze(-1).expand(-1, -1, embedded.shape[-1])
        start, goal = embedded[:, :-1], embedded.gather(1, later)
        policy = distance = None
        if self.actor is not None:
            mean, std = self._gaussian(start.detach(), goal.detach())
            policy = F.gaussian_nll_loss(mean.float(), action.float(), std.square().float().expand_as(mean))
        if self.ruler is not None:
            share = ahead / (horizon + 1.0)
            logits = [
                self._logit(start, goal),
                self._logit(start, start),
                self._logit(start, goal.roll(1, 0)),
            ]
            wanted = torch.stack((share, torch.zeros_like(share), torch.ones_like(share)))
            distance = F.binary_cross_entropy_with_logits(torch.stack(logits).float(), wanted)
        return policy, distance

    def _gaussian(self, embedded: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        assert self.actor is not None
        mean = self.actor(torch.cat((embedded, goal), dim=-1)).tanh()
        return mean, self.log_std.clamp(LOWEST, HIGHEST).exp().to(mean.dtype)

    def _logit(self, embedded: Tensor, goal: Tensor) -> Tensor:
        assert self.ruler is not None
        return self.ruler(torch.cat((embedded, goal), dim=-1)).squeeze(-1)
