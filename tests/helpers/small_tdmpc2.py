"""A small TD-MPC2, windows for it, and its update."""

import torch
from tensordict import TensorDict

from franka_wm.models import make
from franka_wm.models.tdmpc2 import TDMPC2

SMALL = dict(latent_dim=32, simnorm_dim=8, encoder_dim=32, hidden_dim=32)


def small(**overrides) -> TDMPC2:
    settings = dict(observation_sizes={"state": 3, "joint_target": 2}, action_dim=2, discount=0.9, **SMALL)
    return make("tdmpc2", **{**settings, **overrides})


def windows(batch: int = 6, horizon: int = 3, *, reward: float | None = None) -> TensorDict:
    def observation() -> dict[str, torch.Tensor]:
        return {"state": torch.randn(batch, horizon, 3), "joint_target": torch.randn(batch, horizon, 2)}

    rewards = torch.randn(batch, horizon, 1) if reward is None else torch.full((batch, horizon, 1), reward)
    terminated = torch.zeros(batch, horizon, 1, dtype=torch.bool)
    data = TensorDict(
        {
            **observation(),
            "action": torch.rand(batch, horizon, 2) * 2 - 1,
            "next": {**observation(), "reward": rewards, "terminated": terminated},
        },
        batch_size=[batch, horizon],
    )
    for key in ("state", "joint_target"):  # contiguous: what follows a step is the root of the following one
        data["next", key][:, :-1] = data[key][:, 1:]
    return data


def randomise(model: TDMPC2) -> None:
    """Leave the zero initialisation of the reward and value heads, behind which gradients vanish."""
    with torch.no_grad():
        model.reward_head[-1].weight.normal_(std=0.5)  # type: ignore[union-attr,operator]
        model.q_ensemble.weight_2.normal_(std=0.5)  # type: ignore[operator]
    model.q_ensemble.update_target(1.0)


def optimiser_of(model: TDMPC2, lr: float = 1e-3) -> torch.optim.Adam:
    return torch.optim.Adam(model.parameter_groups(lr), fused=True)


def update(model: TDMPC2, optimiser: torch.optim.Adam, batch: TensorDict) -> TensorDict:
    losses = model.loss(batch)
    optimiser.zero_grad()
    losses["loss"].backward()
    optimiser.step()
    model.after_update()
    return losses.detach()


def point_mass(batch: int, horizon: int = 3) -> TensorDict:
    """A point x in [-1, 1] moved by 0.3 a; reward 1 - |x'|, so returns lie in [0, 1 / (1 - γ)]."""
    x = torch.rand(batch, 1) * 2 - 1
    action = torch.rand(batch, horizon, 1) * 2 - 1
    states = [x]
    for t in range(horizon):
        states.append((states[-1] + 0.3 * action[:, t]).clamp(-1, 1))
    s = torch.stack(states, 1)
    return TensorDict(
        {
            "state": s[:, :-1],
            "action": action,
            "next": {
                "state": s[:, 1:],
                "reward": 1 - s[:, 1:].abs(),
                "terminated": torch.zeros(batch, horizon, 1, dtype=torch.bool),
            },
        },
        batch_size=[batch, horizon],
    )
