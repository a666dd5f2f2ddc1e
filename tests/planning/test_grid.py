"""Every planner of continuous actions × every kind of model.

To add a family: a line in CASES, `"name": learned("name", ...)`.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from franka_wm import models
from franka_wm.conf import compose
from franka_wm.planning import CEM, ICEM, MPPI, GoalDistance, GradientPlanner, RewardPlusValue
from franka_wm.planning.objectives import as_objective
from franka_wm.policies import PlannerPolicy
from franka_wm.training.settings import RunSettings

PLANNERS: dict[str, type] = {"mppi": MPPI, "cem": CEM, "icem": ICEM, "gradient": GradientPlanner}
ENVS = 4


@dataclass
class Case:
    """A model, what is maximised with it, and observations of `ENVS` environments."""

    model: Any
    objective: Any
    observation: Callable[[], TensorDict]
    action_dim: int


# ---------------------------------------------------------------------- toy models


class Linear(models.WorldModel):
    """Reward and value: a damped point that is paid for being at the origin."""

    discount = 0.95

    def __init__(self) -> None:
        super().__init__()
        self.observation_sizes, self.action_dim = {"state": 3}, 3
        self.gain = nn.Parameter(0.2 * torch.eye(3))

    def encode(self, observation):
        return observation["state"]

    def next(self, z, action):
        return 0.9 * z + action @ self.gain

    def reward(self, z, action):
        return -(z.square().sum(-1, keepdim=True) + 0.01 * action.square().sum(-1, keepdim=True))

    def value(self, z):
        return -5.0 * z.square().sum(-1, keepdim=True)

    def policy(self, z, deterministic=False):
        return (-2.0 * z).clamp(-1.0, 1.0)


class Goal(models.WorldModel):
    """No reward: a nonlinear latent in which a goal can be told from the rest."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_sizes, self.action_dim = {"state": 2}, 2
        self.lift = nn.Parameter(torch.tensor([[1.0, 0.5, -0.3], [0.2, -1.0, 0.8]]))

    def encode(self, observation):
        return torch.cat((observation["state"], (observation["state"] @ self.lift).tanh()), -1)

    def next(self, z, action):
        state = z[..., :2] + 0.15 * action
        return torch.cat((state, (state @ self.lift).tanh()), -1)


class Context(models.WorldModel):
    """Memory: z holds the last two positions and whether the older one is real; speed is only in both."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_sizes, self.action_dim = {"state": 2}, 2
        self.gain = nn.Parameter(torch.tensor(0.1))

    def encode(self, observation):
        now = observation["state"]
        return torch.cat((now, now, torch.zeros_like(now[..., :1])), -1)

    def observe(self, observation, previous_z, action, is_init):
        now = observation["state"]
        pushed = torch.cat((previous_z[..., 2:4], now, torch.ones_like(now[..., :1])), -1)
        return torch.where(is_init, self.encode(observation), pushed)

    def next(self, z, action):
        before, now, valid = z[..., :2], z[..., 2:4], z[..., 4:]
        moved = now + 0.8 * valid * (now - before) + self.gain * action
        return torch.cat((now, moved, torch.ones_like(valid)), -1)

    def embed(self, z):
        return z[..., 2:4]


def toy(model: Any, objective: Callable[[Any], Any]) -> Callable[[], Case]:
    def make() -> Case:
        module = model()
        size = module.observation_sizes["state"]
        return Case(
            module,
            objective(module),
            lambda: TensorDict({"state": torch.randn(ENVS, size)}, [ENVS]),
            module.action_dim,
        )

    return make


def learned(name: str, **settings: Any) -> Callable[[], Case]:
    """A family with small random weights, planning for its own rewards and values."""

    def make() -> Case:
        sizes = {"state": 6}
        model = models.make(name, observation_sizes=sizes, action_dim=3, episode_length=20, **settings).eval()
        with torch.no_grad():  # heads start at exactly 0, where nothing is better than anything else
            for parameter in model.parameters():
                if parameter.dim() > 1:
                    parameter.normal_(0.0, 0.3)
        objective = RewardPlusValue(model.reward, model.value, model.discount)
        return Case(model, objective, lambda: TensorDict({"state": torch.randn(ENVS, 6)}, [ENVS]), 3)

    return make


CASES: dict[str, Callable[[], Case]] = {
    "linear": toy(Linear, lambda m: RewardPlusValue(m.reward, m.value, m.discount)),
    "goal": toy(Goal, lambda m: GoalDistance(m.encode(TensorDict({"state": torch.ones(ENVS, 2)}, [ENVS])))),
    "context": toy(Context, lambda m: GoalDistance(torch.ones(2), embed=m.embed)),
    "dreamer": learned("dreamer", deter_dim=16, hidden_dim=16, codes=4, classes=4, blocks=2, bins=41),
    "tdmpc2": learned("tdmpc2", latent_dim=16, encoder_dim=16, hidden_dim=16),
}


# ---------------------------------------------------------------------- the grid


@pytest.fixture(params=CASES)
def case(request):
    torch.manual_seed(0)
    return CASES[request.param]()


def planner_settings(name: str) -> dict:
    """What `planner=NAME` says at the scale of its paper, but for what is the policy's."""
    scale = "laptop" if name == "icem" else "gpu"
    planner = RunSettings.of(compose(f"planner={name}", f"scale={scale}")).planner
    return {"name": planner.name, **planner.options}


@pytest.fixture(params=PLANNERS)
def planner(request, case, root):
    """With the numbers of its file in conf/planner."""
    settings = planner_settings(request.param)
    assert settings.pop("name") == request.param
    return PLANNERS[request.param](action_dim=case.action_dim, **settings)


def imagined(case, objective, z, plan):
    """What the model and the objective expect of plans (E, H, A): (E,)."""
    latents = [z.unsqueeze(1)]
    for t in range(plan.shape[1]):
        latents.append(case.model.next(latents[-1], plan[:, None, t]))
    return objective(torch.stack(latents, 2), plan.unsqueeze(1)).squeeze(1)


def test_the_plan_is_finite_within_bounds_and_better_than_doing_nothing(case, planner):
    observation = case.observation()
    objective = as_objective(case.objective).bind(observation)
    prior = case.model.policy if case.model.has_policy else None
    with torch.no_grad():
        z = case.model.encode(observation)
        result = planner.plan(z, case.model.next, objective, prior=prior)
        plan = result["best"] if "best" in result.keys() else result["plan"]  # noqa: SIM118
        assert plan.shape == (ENVS, planner.horizon, case.action_dim)
        assert result["action"].shape == (ENVS, case.action_dim) and result["value"].shape == (ENVS, 1)
        assert all(torch.isfinite(value).all() for value in result.values())
        assert result["action"].abs().max() <= 1.0 and plan.abs().max() <= 1.0
        planned = imagined(case, objective, z, plan)
        idle = imagined(case, objective, z, torch.zeros_like(plan))
    assert (planned > idle).all()
    assert all(parameter.grad is None for parameter in case.model.parameters())


def test_decisions_follow_each_other_through_a_policy(case, planner):
    """Plan and memory travel in the TensorDict; the second decision has a warm start in half the worlds."""
    policy = PlannerPolicy.for_model(case.model, planner, objective=case.objective, explore=True)
    td = case.observation().set("is_init", torch.ones(ENVS, 1, dtype=torch.bool))
    for step in range(3):
        td = policy(td)
        assert td["action"].shape == (ENVS, case.action_dim)
        assert torch.isfinite(td["action"]).all() and td["action"].abs().max() <= 1.0
        assert torch.isfinite(td["plan"]).all()
        td = td.clone().update(case.observation())
        td["is_init"] = (torch.arange(ENVS) % 2 == step % 2).unsqueeze(1)


@pytest.mark.parametrize("name", ["linear", "goal", "context"])
@pytest.mark.parametrize("which", PLANNERS)
def test_closed_loop_beats_doing_nothing(name, which, root):
    """The toys are their own worlds: what is executed counts, not what was imagined."""
    torch.manual_seed(0)
    case = CASES[name]()
    settings = planner_settings(which)
    settings.pop("name")
    planner = PLANNERS[which](action_dim=case.action_dim, **settings)
    policy = PlannerPolicy.for_model(case.model, planner, objective=case.objective, explore=False)
    objective = case.objective
    start = case.observation()

    def final(acts: bool) -> torch.Tensor:
        """Score of staying where 20 steps lead, with the toy's true memory."""
        td = start.clone().set("is_init", torch.ones(ENVS, 1, dtype=torch.bool))
        with torch.no_grad():
            z = case.model.encode(td)
            still = torch.zeros(ENVS, case.action_dim)
            for _ in range(20):
                action = policy(td)["action"] if acts else still
                z = case.model.next(z, action)
                # All three toys hold the present state at a known place.
                state = case.model.embed(z) if name == "context" else z[..., : start["state"].shape[-1]]
                td = td.clone().set("state", state)
                td["is_init"] = torch.zeros(ENVS, 1, dtype=torch.bool)
            return objective(z[:, None, None].expand(-1, 1, 2, -1), torch.zeros(ENVS, 1, 1, case.action_dim))

    acted, idle = final(True), final(False)
    if name == "linear":  # it comes to rest by itself, too
        assert acted.mean() > 0.5 * idle.mean() and acted.mean() < 0.0
    else:
        assert (acted > 0.2 * idle).all()
