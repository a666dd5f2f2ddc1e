"""One model, several tasks: what a task's action lacks counts nowhere, and no task's reward reaches another's."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.nn import functional as F

from franka_wm.models import make
from franka_wm.planning import MPPI, RewardPlusValue
from franka_wm.policies.planner import PlannerPolicy
from franka_wm.training import build
from small_tdmpc2 import randomise

MASKS = [[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]]
"""The first of two tasks lacks the last entry of an action."""
SMALL: dict[str, Any] = dict(
    observation_sizes={"state": 4, "task": 2}, action_dim=3, episode_length=20, latent_dim=16, simnorm_dim=4,
    encoder_dim=16, hidden_dim=16, bins=11, dropout=0.0, terminates=True,
)  # fmt: skip


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def model(masks: Any = MASKS) -> Any:
    made = make("tdmpc2", action_masks=masks, **SMALL)
    randomise(made)
    return made


def windows(tasks: list[int], horizon: int = 3) -> TensorDict:
    """(B, H), each window of one task."""
    batch = len(tasks)
    state = torch.randn(batch, horizon + 1, 4)
    task = F.one_hot(torch.tensor(tasks), 2).float().unsqueeze(1).expand(-1, horizon + 1, -1)
    after = {
        "state": state[:, 1:],
        "task": task[:, 1:],
        "reward": torch.rand(batch, horizon, 1),
        "terminated": torch.zeros(batch, horizon, 1, dtype=torch.bool),
    }
    root = {"state": state[:, :-1], "task": task[:, :-1], "action": torch.rand(batch, horizon, 3) * 2 - 1}
    return TensorDict({**root, "next": after}, [batch, horizon])


def loss_of(made: Any, batch: TensorDict) -> TensorDict:
    torch.manual_seed(7)
    return copy.deepcopy(made).loss(batch).detach()  # a copy: the policy's running scale moves


def test_what_a_task_lacks_counts_in_no_loss() -> None:
    made, batch = model(), windows([0, 0, 1, 1])
    other = batch.clone()
    other["action"][:2, :, 2] *= -0.5  # the entry that the first task lacks
    first, second = loss_of(made, batch), loss_of(made, other)
    for key in first.keys():  # noqa: SIM118
        assert torch.equal(first[key], second[key]), key
    other["action"][2:, :, 2] *= -0.5
    assert not torch.equal(loss_of(made, other)["loss"], first["loss"])
    other, plain = batch.clone(), model(None)
    other["action"][:2, :, 2] *= -0.5
    assert not torch.equal(loss_of(plain, batch)["loss"], loss_of(plain, other)["loss"])


def test_the_policy_does_nothing_there_and_gains_no_entropy() -> None:
    made, batch = model(), windows([0, 1])
    z = made.encode(batch[:, 0])
    for deterministic in (True, False):
        action = made.policy(z, deterministic=deterministic)
        assert action[0, 2] == 0 and (action[0, :2] != 0).all() and (action[1] != 0).all()
    torch.manual_seed(3)
    action, log_prob = made.policy_sample(z)
    assert action[0, 2] == 0 and action[1, 2] != 0
    with torch.no_grad():
        made.policy_head.network[-1].bias[5] += 1.0  # the deviation of the last entry
    torch.manual_seed(3)
    _, wider = made.policy_sample(z)
    assert log_prob[0] == wider[0] and log_prob[1] != wider[1]


def test_plans_of_a_task_do_not_depend_on_it() -> None:
    made = model().eval()
    batch: Any = windows([0, 1])[:, 0]
    z, action = made.encode(batch), batch["action"]
    other = action.clone()
    other[:, 2] += 0.5
    for same, one, two in (
        (0, made.next(z, action), made.next(z, other)),
        (0, made.reward(z, action), made.reward(z, other)),
        (0, made.q(z, action), made.q(z, other)),
    ):
        assert torch.equal(one[same], two[same]) and not torch.equal(one[1], two[1])
    assert torch.equal(made.next(z, action)[:, -3:], torch.tensor(MASKS))  # the mask goes along
    assert made.terminated(z).shape == (2, 1)
    planner = MPPI(action_dim=3, horizon=3, num_samples=16, num_policy_samples=4, num_elites=4, iterations=2)
    policy = PlannerPolicy.for_model(made, planner, objective=RewardPlusValue.of(made), explore=False)
    seen = batch.select("state", "task").set("is_init", torch.ones(2, 1, dtype=torch.bool))
    assert policy(seen)["action"].shape == (2, 3)


def test_plans_of_a_task_cost_nothing_by_it(settled) -> None:
    """What an objective takes for actions, and for their changes since the last, which a planner chose as it liked."""
    tasks = [f"~env.tasks.{name}" for name in ("track", "lift", "pick", "stack", "drawer", "peg")]
    for name in ("action", "policy", "smoothness"):
        run = settled("device=cpu", "scale=smoke", "env=multitask", *tasks, f"objective.{name}_penalty=30")
        for made, independent in ((model().eval(), True), (model(None).eval(), False)):
            objective = build.make_objective(run, made)
            assert objective is not None
            z = made.encode(windows([0, 1])[:, 0])
            trajectory = z[:, None, None].expand(-1, 1, 4, -1)
            actions, last = torch.rand(2, 1, 3, 3) - 0.5, torch.rand(2, 3) - 0.5
            other, moved = actions.clone(), last.clone()
            other[..., 0, 2] += 0.5
            moved[:, 2] += 0.3
            with torch.no_grad():
                one, two, three = (
                    objective.bind(TensorDict({"action": before}, [2]))(trajectory, plan).squeeze(1)
                    for before, plan in ((last, actions), (last, other), (moved, actions))
                )
            assert bool(one[0] == two[0]) == independent and one[1] != two[1]
            if name == "smoothness":
                assert bool(one[0] == three[0]) == independent and one[1] != three[1]


def test_no_reward_reaches_another_task() -> None:
    """Each window's losses are its own: those of one task do not change with the other's rewards and ends."""
    made, batch = model(), windows([0, 1, 0, 1])
    other = batch.clone()
    other["next", "reward"][1::2] += 3.0
    other["next", "terminated"][1::2, -1] = True
    per_window = [losses_by_window(made, one) for one in (batch, other)]
    for name in per_window[0]:
        one, two = per_window[0][name], per_window[1][name]
        assert torch.equal(one[0::2], two[0::2]), name
        assert not torch.equal(one[1::2], two[1::2]), name


def test_the_loss_itself_asks_for_no_reward_of_another_task(monkeypatch: pytest.MonkeyPatch) -> None:
    batch = windows([0, 1, 0, 1])
    other = batch.clone()
    other["next", "reward"][1::2] += 3.0
    other["next", "terminated"][1::2, -1] = True
    made, targets = model(), []
    begun, two_hot = copy.deepcopy(made.state_dict()), made.two_hot.loss
    monkeypatch.setattr(
        made.two_hot, "loss", lambda logits, target: (targets.append(target), two_hot(logits, target))[1]
    )
    for one in (batch, other):
        made.load_state_dict(begun)
        torch.manual_seed(7)
        made.loss(one)
    first, second = targets[: len(targets) // 2], targets[len(targets) // 2 :]
    assert len(first) == len(second) >= 2  # rewards and values
    for one, two in zip(first, second, strict=True):
        assert one.shape[-2] == 4 and torch.equal(one[..., 0::2, :], two[..., 0::2, :])
        assert not torch.equal(one[..., 1::2, :], two[..., 1::2, :])


def losses_by_window(made: Any, batch: TensorDict) -> dict[str, torch.Tensor]:
    """Losses of reward and value (B,), of a model in training mode with the same draws."""
    torch.manual_seed(7)
    reward, ended = (batch["next", key].transpose(0, 1) for key in ("reward", "terminated"))
    encoded = made._encode_window(batch)
    target = made._td_target(encoded[1:].detach(), reward, ended)
    action = batch["action"].transpose(0, 1)
    before = made.joined(made._unroll(encoded[0], action)[:-1], action)
    found = {
        "reward": made.two_hot.loss(made.reward_head(before), reward).mean((0, 2)),
        "value": made.two_hot.loss(made.q_ensemble(before), target).mean((0, 1, 3)),
    }
    return {name: loss.detach() for name, loss in found.items()}


def test_demonstrations_teach_only_what_the_task_has() -> None:
    made = make("tdmpc2", action_masks=MASKS, imitation_coef=1.0, **SMALL)
    randomise(made)
    batch = windows([0, 0, 1, 1])
    batch["demonstrated"] = torch.ones(4, 3, 1, dtype=torch.bool)
    found, other = loss_of(made, batch)["loss"], batch.clone()
    other["action"][:2, :, 2] = 0.9  # the first task lacks it
    assert loss_of(made, other)["loss"].equal(found)
    other["action"][2:, :, 2] = 0.9
    assert not loss_of(made, other)["loss"].equal(found)
