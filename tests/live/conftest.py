"""A session of one cheap arm: a planner that knows its geometry, inverse kinematics, random, nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from franka_wm.live.commanded import kinematic_planner
from franka_wm.live.session import Session
from franka_wm.policies.scripted import IKPolicy, NoopPolicy, SmoothRandomPolicy

LIVE = {
    "goal_sampling": "reachable",
    "action_scale": 0.085,
    "limit_velocity": True,
    "episode_length": 1_000_000,
}


@pytest.fixture(scope="session")
def make_session(small_env) -> Callable[..., Session]:
    def make(*, seed: int = 0, policy: str | None = None, keep_goal: bool = False, **changes: Any) -> Session:
        env = small_env(1, **(LIVE | changes))
        policies = {
            "planner": kinematic_planner(env),
            "ik": IKPolicy(env.kinematics, env.config),
            "random": SmoothRandomPolicy(env.action_dim),
            "noop": NoopPolicy(env.action_dim),
        }
        session = Session(env, policies, policy=policy, seed=seed)
        session.keep_goal = keep_goal
        return session

    return make
