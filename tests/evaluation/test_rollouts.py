"""Held-out experience: who decides in a mixture, and what followed of a step."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from franka_wm.envs.external import ExternalEnv
from franka_wm.envs.external_config import ExternalConfig
from franka_wm.evaluation import diagnose
from franka_wm.evaluation.rollouts import Alternating, followed
from franka_wm.models import WorldModel
from franka_wm.policies.scripted import NoopPolicy
from franka_wm.report.diagnostics import findings
from franka_wm.training import build


class Always(TensorDictModuleBase):
    """One action in every world; keeps the last action that it was shown."""

    in_keys: Any = []
    out_keys: Any = ["action"]

    def __init__(self, action: float) -> None:
        super().__init__()
        self.action = action
        self.saw: Any = None

    def forward(self, tensordict: Any) -> Any:
        self.saw = tensordict.get("action", None)
        return tensordict.set("action", torch.full((4, 2), self.action))


def test_each_policy_of_a_mixture_sees_what_was_done_last() -> None:
    """And not what the policy before it has just decided: a plan's smoothness counts from the executed action."""
    first, second = Always(1.0), Always(-1.0)
    mixture, worlds = Alternating([first, second]), TensorDict({}, batch_size=[4])
    done = mixture(worlds)["action"]
    assert done[:, 0].tolist() == [1.0, -1.0, 1.0, -1.0]
    mixture(worlds)
    assert torch.equal(first.saw, done) and torch.equal(second.saw, done)


def test_followed_by_hand() -> None:
    ended = torch.tensor([0, 0, 1, 0, 0, 0, 1, 0, 0], dtype=torch.bool).view(1, 9, 1)
    never = torch.zeros_like(ended)
    terminated = never.clone()
    terminated[0, 2] = True
    for ends, steps in ((terminated, [0, 1, 2, 3, 4]), (never, [0, 3, 4])):
        known = followed(ended, ends, 3)
        assert known[0].nonzero().flatten().tolist() == steps


class Worthless(WorldModel):
    """Hands the state over; says that nothing is worth anything."""

    observation_sizes = {"state": 3}

    def __init__(self, discount: float) -> None:
        super().__init__()
        self.discount = discount

    def encode(self, observation: Any) -> Any:
        return observation.get("state")

    def value(self, z: Any) -> Any:
        return torch.zeros_like(z[..., :1])


def test_values_are_not_held_against_what_a_time_limit_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pendulum ends its episodes itself, after 200 steps, however long they are to be: the next one is another."""
    pytest.importorskip("gymnasium")

    def make(settings: None, *, num_envs: int, episode_length: int) -> ExternalEnv:
        config = ExternalConfig(kind="gym", name="Pendulum-v1", episode_length=episode_length)
        return ExternalEnv(config, num_envs=num_envs)

    monkeypatch.setattr(build, "make_evaluation_env", make)
    env = SimpleNamespace(config=SimpleNamespace(episode_length=150), num_envs=2)
    agent: Any = SimpleNamespace(env=env, policies={"policy": NoopPolicy(1)}, settings=None)
    agent.model = Worthless(0.95)  # 77 steps later rewards weigh less than 2 %
    assert diagnose.calibration(agent)["samples"] == 2 * (200 - 77 + 1)
    agent.model = Worthless(0.99)
    assert "goes on for 390 steps" in (found := diagnose.calibration(agent))["not_measured"]
    assert "390" in findings({"calibration": found})["value calibration, not measured"]
