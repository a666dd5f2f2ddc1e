"""Worlds that explore unlike each other."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from franka_wm import processes
from franka_wm.policies import ExploringPolicy

WORLDS = 5


class Constant(TensorDictModuleBase):
    """Writes one action, and a plan that counts what was carried to it."""

    def __init__(self, value: float, plans: bool = False) -> None:
        super().__init__()
        self.value, self.plans = value, plans
        self.in_keys = ["state"]
        self.out_keys = ["action", "plan"] if plans else ["action"]

    def forward(self, tensordict):
        rows = tensordict.batch_size[0]
        if self.plans:
            tensordict.set("plan", tensordict.get("plan", torch.zeros(rows, 2, 1)) + 1)
        return tensordict.set("action", torch.full((rows, 1), self.value))


def root() -> TensorDict:
    return TensorDict({"state": torch.zeros(WORLDS, 3)}, [WORLDS])


@pytest.fixture(autouse=True)
def _exploring():
    torch.manual_seed(0)
    with set_exploration_type(ExplorationType.RANDOM):
        yield


def test_noise_grows_from_none_in_the_first_world_to_all_of_it_in_the_last() -> None:
    policy = ExploringPolicy(Constant(0.1), noise=0.2)
    actions = torch.stack([policy(root())["action"] for _ in range(4000)]).squeeze(-1)
    torch.testing.assert_close(actions.std(0), torch.linspace(0, 0.2, WORLDS), atol=0.01, rtol=0)
    torch.testing.assert_close(actions.mean(0), torch.full((WORLDS,), 0.1), atol=0.02, rtol=0)


def test_noise_grows_over_the_worlds_of_all_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, told = ExploringPolicy(Constant(0.0), noise=0.2), []
    monkeypatch.setattr(torch, "randn_like", torch.ones_like)
    told.append(policy(root())["action"])
    monkeypatch.setattr(processes, "count", lambda: 3)
    for rank in range(3):
        monkeypatch.setattr(processes, "rank", lambda rank=rank: rank)
        told.append(policy(root())["action"])
    torch.testing.assert_close(told[0].squeeze(-1), torch.linspace(0, 0.2, WORLDS))
    torch.testing.assert_close(torch.cat(told[1:]).squeeze(-1), torch.linspace(0, 0.2, 3 * WORLDS))


def test_no_gradient_is_recorded_and_worlds_need_a_planner() -> None:
    class Trained(Constant):
        def forward(self, tensordict):
            tensordict = super().forward(tensordict)
            weight = torch.ones((), requires_grad=True)
            return tensordict.set("action", weight * tensordict.get("action"))

    assert not ExploringPolicy(Trained(0.1), noise=0.2)(root())["action"].requires_grad
    with pytest.raises(ValueError, match="needs a planner"):
        ExploringPolicy(Constant(0.1), planner_worlds=1)


def test_actions_stay_within_their_bounds() -> None:
    assert ExploringPolicy(Constant(0.9), noise=2.0)(root())["action"].abs().max() <= 1.0


def test_the_last_worlds_act_with_the_planner_and_carry_its_plan() -> None:
    policy = ExploringPolicy(Constant(0.1), planner=Constant(-0.5, plans=True), planner_worlds=2)
    assert set(policy.out_keys) == {"action", "plan"}
    step = policy(root())
    assert step["action"].squeeze(-1).tolist() == pytest.approx([0.1, 0.1, 0.1, -0.5, -0.5])
    step = policy(step)
    assert step["plan"][:, 0, 0].tolist() == [0, 0, 0, 2, 2]  # the second decision saw the first one's plan


def test_one_world_alone_has_all_of_the_noise() -> None:
    policy = ExploringPolicy(Constant(0.0), noise=0.2)
    actions = torch.cat([policy(root()[:1])["action"] for _ in range(2000)])
    assert abs(float(actions.std()) - 0.2) < 0.02


def test_planners_are_told_the_last_executed_action() -> None:
    seen = []

    class Looking(Constant):
        def forward(self, tensordict):
            seen.append(tensordict.get("action", None))
            return super().forward(tensordict)

    policy = ExploringPolicy(Constant(0.1), planner=Looking(-0.5, plans=True), planner_worlds=2)
    policy(policy(root()))
    assert seen[0] is None and seen[1].squeeze(-1).tolist() == pytest.approx([-0.5, -0.5])


def test_without_exploration_it_is_the_policy_alone() -> None:
    policy = ExploringPolicy(Constant(0.1), noise=0.5, planner=Constant(-0.5, plans=True), planner_worlds=2)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert policy(root())["action"].unique().tolist() == pytest.approx([0.1])
