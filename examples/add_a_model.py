"""A family of your own: a linear latent model with reward, value and no policy network.

    python train.py plugins=[examples.add_a_model] hydra.searchpath=[file://examples/conf] \\
        model=linear collector.policy=planner

`examples/conf/model/linear.yaml` holds its hyper-parameters.
"""

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models import WorldModel, register


class Linear(WorldModel):
    """z = W s; z' = A z + B a; reward and value are small networks. Value targets are one-step, with γ."""

    def __init__(
        self,
        *,
        observation_sizes: Mapping[str, int],
        action_dim: int,
        episode_length: int,
        latent_dim: int = 64,
        discount: float = 0.95,
    ):
        super().__init__()
        self.observation_sizes, self.action_dim, self.discount = observation_sizes, action_dim, discount
        size = sum(observation_sizes.values())
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))
        self.encoder = nn.Linear(size, latent_dim)
        self.dynamics = nn.Linear(latent_dim + action_dim, latent_dim)
        self.reward_head = nn.Sequential(
            nn.Linear(latent_dim + action_dim, 128), nn.Mish(), nn.Linear(128, 1)
        )
        self.value_head = nn.Sequential(nn.Linear(latent_dim, 128), nn.Mish(), nn.Linear(128, 1))

    def set_observation_statistics(self, mean: Tensor, std: Tensor) -> None:
        self.mean.copy_(mean)
        self.std.copy_(std)

    # What a planner uses

    def encode(self, observation: TensorDictBase) -> Tensor:
        x = torch.cat([observation.get(key) for key in self.observation_sizes], -1)
        return self.encoder((x - self.mean) / self.std)

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        return self.dynamics(torch.cat((z, action), -1))

    def reward(self, z: Tensor, action: Tensor) -> Tensor:
        return self.reward_head(torch.cat((z, action), -1))

    def value(self, z: Tensor) -> Tensor:
        return self.value_head(z)

    # What the learner uses

    def loss(self, batch: TensorDictBase) -> TensorDict:
        z, after = self.encode(batch), self.encode(batch.get("next"))
        action, reward = batch.get("action"), batch.get(("next", "reward"))
        with torch.no_grad():
            later = torch.where(batch.get(("next", "terminated")), 0.0, self.value(after))
            target = reward + self.discount * later
        parts = {
            "loss_consistency": F.mse_loss(self.next(z, action), after),
            "loss_reward": F.mse_loss(self.reward(z, action), reward),
            "loss_value": F.mse_loss(self.value(z), target),
        }
        total = torch.stack(tuple(parts.values())).sum()
        return TensorDict({"loss": total} | {k: v.detach() for k, v in parts.items()}, batch_size=[])


register("linear", Linear, line="linear latents, an example")
