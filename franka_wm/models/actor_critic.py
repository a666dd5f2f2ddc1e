"""An actor and a critic that learn in a world model's imagination (DreamerV3, arXiv:2301.04104)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from franka_wm.models.base import WorldModel
from franka_wm.models.ema import ema_update, frozen
from franka_wm.models.groups import ParameterGroup
from franka_wm.models.layers import TwoHotSymlog
from franka_wm.models.returns import RunningScale, lambda_returns
from franka_wm.models.rssm import RSSM
from franka_wm.seeding import normal_like


class ActorCritic(WorldModel):
    """Base class of world models whose actor and critic learn on trajectories that the model imagines.

    The networks and numbers below are the subclass's. No gradient of actor or critic reaches the model, but for the
    critic's on recorded rewards. The actor's gradient is one of two:

    - *reinforce*, as published: actions are as likely as they paid more than the critic expected.
    - *dynamics*: that of the returns themselves, back through critic, rewards and imagined steps to the actions
      (DreamerV1, arXiv:1912.01603), each taken as if the state it was taken in stood still.
    """

    rssm: RSSM
    reward_head: nn.Module
    termination_head: nn.Module | None
    actor: nn.Module
    critic: nn.Module
    slow_critic: nn.Module
    two_hot: TwoHotSymlog
    scale: RunningScale
    keep: Tensor
    actor_gradient: Literal["reinforce", "dynamics"]
    actor_critic_lr_scale: float
    imagination: int
    discount: float
    return_lambda: float
    entropy_coef: float
    std_min: float
    std_max: float

    def value(self, z: Tensor) -> Tensor:
        """Expected discounted return (..., 1) of the policy from z (..., latent_dim)."""
        return self.two_hot.decode(self.critic(z))

    def policy(self, z: Tensor, deterministic: bool = False) -> Tensor:
        """Actions (..., action_dim) in [-1, 1] for z (..., latent_dim): a sample, or the mode."""
        mean, std = self.action_distribution(z)
        return mean if deterministic else (mean + std * normal_like(mean)).clamp(-1.0, 1.0)

    def action_distribution(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Mean in [-1, 1] and standard deviation of the actor's Gaussian, each (..., action_dim)."""
        mean, raw = self.actor(z).float().chunk(2, dim=-1)
        return torch.tanh(mean), self.std_min + (self.std_max - self.std_min) * torch.sigmoid(raw + 2.0)

    def parameter_groups(self, lr: float) -> list[ParameterGroup]:
        """Groups for Adam: model, actor and critic, whose gradients are clipped apart."""
        actor, critic = list(self.actor.parameters()), list(self.critic.parameters())
        apart = {id(parameter) for parameter in (*actor, *critic, *self.slow_critic.parameters())}
        model = [parameter for parameter in self.parameters() if id(parameter) not in apart]
        slower = lr * self.actor_critic_lr_scale
        groups = (("model", model, lr), ("policy", actor, slower), ("value", critic, slower))
        return [{"name": name, "clip": name, "params": group, "lr": rate} for name, group, rate in groups]

    def after_update(self) -> None:
        """Move the slow critic by `tau`; call once after each optimiser step."""
        ema_update(self.slow_critic, self.critic, self.keep)

    def _actor_critic_loss(self, imagined: Tensor, actions: Tensor, begun: Tensor) -> tuple[Tensor, ...]:
        """Losses of actor and critic and the actor's entropy (), returns and values (K, N, 1), see `_imagine`.

        Args:
            begun: (N, 1), 0 where the first state had ended its episode.
        """
        reached, value, weight = self._imagined_returns(imagined, begun)
        states, actions, value, weight = (x.detach() for x in (imagined[:-1], actions, value, weight))
        returns = reached.detach()
        if self.training:
            self.scale.update(returns)
        policy_loss, entropy = self._policy_loss(states, actions, reached, value, weight)
        value_loss = (weight * self._value_loss(states, returns)).mean()
        return policy_loss, value_loss, entropy, returns, value

    def _replay_value_loss(self, z: Tensor, imagined: Tensor, reward: Tensor, terminated: Tensor) -> Tensor:
        """The critic's loss () on recorded rewards (H, B, 1), with returns imagined ((H+1) B, 1) from z (H+1, B, Z)."""
        bootstrap = imagined.view(*z.shape[:2], 1)[1:]
        returns = lambda_returns(
            reward, ~terminated, bootstrap, discount=self.discount, decay=self.return_lambda
        )
        return self._value_loss(z[:-1], returns).mean()

    def _imagined_step(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (N, A) that the actor draws in z (N, Z), not clamped, and states (N, Z) drawn after them."""
        mean, std = self.action_distribution(z.detach())
        action = mean + std * torch.randn_like(mean)
        return action, frozen(self.rssm, z, action.clamp(-1.0, 1.0))

    def _imagine(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """States (K+1, N, Z) and actions (K, N, A) from z (N, Z).

        With `actor_gradient=dynamics` they have gradients to the actor, through nothing but its actions.
        """
        states, actions = [z], []
        with torch.set_grad_enabled(self.actor_gradient == "dynamics" and torch.is_grad_enabled()):
            for _ in range(self.imagination):
                action, z = self._imagined_step(z)
                actions.append(action)
                states.append(z)
            return torch.stack(states), torch.stack(actions)

    def _imagined_returns(self, imagined: Tensor, begun: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """λ-returns, values and weights (K, N, 1) of states (K+1, N, Z): the discounted chance to get there.

        Args:
            begun: (N, 1), 0 where the first state had ended its episode.
        """
        reward = self.two_hot.decode(frozen(self.reward_head, imagined[1:]))
        value = self.two_hot.decode(frozen(self.critic, imagined))
        going_on = torch.ones_like(reward)
        if self.termination_head is not None:
            going_on = torch.sigmoid(-frozen(self.termination_head, imagined[1:]))
        returns = lambda_returns(
            reward, going_on, value[1:], discount=self.discount, decay=self.return_lambda
        )
        weight = torch.cat((begun.unsqueeze(0), self.discount * going_on[:-1])).cumprod(0)
        return returns, value[:-1], weight

    def _policy_loss(
        self, z: Tensor, actions: Tensor, returns: Tensor, value: Tensor, weight: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Loss (REINFORCE with the critic as baseline, or returns themselves) and mean entropy [nat] of the actor."""
        mean, std = self.action_distribution(z)
        normal = torch.distributions.Normal(mean, std, validate_args=False)
        gain = self.scale(returns - value)
        if self.actor_gradient == "reinforce":
            gain = gain * normal.log_prob(actions).sum(-1, keepdim=True)
        entropy = normal.entropy().sum(-1, keepdim=True)
        return -(weight * (gain + self.entropy_coef * entropy)).mean(), entropy.mean()

    def _value_loss(self, z: Tensor, returns: Tensor) -> Tensor:
        """Cross-entropy (..., 1) of the critic in z (..., Z) with returns, and with what the slow critic says."""
        logits = self.critic(z)
        with torch.no_grad():
            slow = self.two_hot.decode(self.slow_critic(z))
        return self.two_hot.loss(logits, returns) + self.two_hot.loss(logits, slow)
