"""DreamerV3 on a problem that needs memory."""

import pytest
import torch
from tensordict import TensorDict

from franka_wm.models import make

SIZES = dict(
    deter_dim=64, hidden_dim=64, codes=8, classes=8, blocks=2, encoder_layers=2, bins=101, imagination=5
)


def hidden_velocity(batch: int, horizon: int) -> TensorDict:
    """A mass on a line whose velocity is not seen; an action accelerates it; it pays to be at 0."""
    x, v = torch.rand(batch, 1) * 2 - 1, torch.rand(batch, 1) * 0.4 - 0.2
    action = torch.rand(batch, horizon, 1) * 2 - 1
    places = [x]
    for t in range(horizon):
        v = (v + 0.1 * action[:, t]).clamp(-0.3, 0.3)
        x = (x + v).clamp(-2, 2)
        places.append(x)
    seen = torch.stack(places, 1)
    ended = torch.zeros(batch, horizon, 1, dtype=torch.bool)
    reward = 1 - seen[:, 1:].abs()
    after = {"state": seen[:, 1:], "reward": reward, "terminated": ended}
    return TensorDict({"state": seen[:, :-1], "action": action, "next": after}, [batch, horizon])


@pytest.mark.slow
@pytest.mark.parametrize("actor_gradient", ["reinforce", "dynamics"])
def test_it_remembers_what_is_not_seen_and_learns_to_act(actor_gradient):
    torch.manual_seed(0)
    model = make(
        "dreamer",
        observation_sizes={"state": 1},
        action_dim=1,
        discount=0.9,
        actor_gradient=actor_gradient,
        **SIZES,
    )
    optimiser = torch.optim.AdamW(model.parameter_groups(4e-3), weight_decay=0.0)
    for _ in range(400):
        losses = model.loss(hidden_velocity(16, 10))
        optimiser.zero_grad()
        losses["loss"].backward()
        for group in optimiser.param_groups:
            torch.nn.utils.clip_grad_norm_(group["params"], 10.0)
        optimiser.step()
        model.after_update()
    assert losses["reward_error"] < 0.1

    # Where it will be in four steps depends on the velocity: memory of five observations tells it, one does not.
    batch = hidden_velocity(512, 10)
    never = torch.zeros(512, 1, dtype=torch.bool)
    with torch.no_grad():
        z = model.encode(batch[:, 0].select("state"))
        for t in range(1, 6):
            z = model.observe(batch[:, t].select("state"), z, batch["action"][:, t - 1], never)
        blind = model.encode(batch[:, 5].select("state"))
        errors = []
        for start in (z, blind):
            for t in range(5, 9):
                guess, start = (
                    model.reward(start, batch["action"][:, t]),
                    model.next(start, batch["action"][:, t]),
                )
            errors.append((guess - batch["next", "reward"][:, 8]).abs().mean())
    assert errors[0] < 0.6 * errors[1]

    def play(act) -> float:
        """Mean reward of 20 steps of acting with `act`."""
        x, v, total, z, before = (
            torch.linspace(-1, 1, 256).unsqueeze(-1),
            torch.zeros(256, 1),
            0.0,
            None,
            None,
        )
        for _ in range(20):
            seen = TensorDict({"state": x}, [256])
            z = model.encode(seen) if z is None else model.observe(seen, z, before, never[:256])
            before = act(z)
            v = (v + 0.1 * before).clamp(-0.3, 0.3)
            x = (x + v).clamp(-2, 2)
            total += float((1 - x.abs()).mean()) / 20
        return total

    with torch.no_grad():
        still = play(lambda z: torch.zeros(256, 1))
        learned = play(lambda z: model.policy(z, deterministic=True))
    assert learned > still + 0.2
