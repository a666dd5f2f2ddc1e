"""Shifted worlds: never narrower than those of training, and compared with worlds of the same solver."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from franka_wm.evaluation import robustness
from franka_wm.evaluation.robustness import SHIFTS, UNSHIFTED, Shift
from franka_wm.training import build

FRICTION = "joint friction to 5 N·m"


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What every environment was made with. An episode ends 1 cm away, 2 with another solver, 1 more with friction."""
    found: list[dict[str, Any]] = []

    def make(settings: Any, **given: Any) -> Any:
        found.append(given)
        return SimpleNamespace(given=given)

    def play(env: Any, policy: Any, *, seed: int) -> TensorDict:
        own = env.given.get("randomization", {})
        cm = 1.0 + ("solver_iterations" in env.given) + (own.get("friction", 0) > 0)
        return TensorDict(
            {
                "final_distance": torch.full((4,), cm / 100),
                "success": torch.ones(4, dtype=torch.bool),
                "cut_short": torch.zeros(4),
            },
            batch_size=[4],
        )

    monkeypatch.setattr(build, "make_evaluation_env", make)
    for name, other in (
        ("play_episodes", play),
        ("check_shiftable", lambda agent: None),
        ("success_distance", lambda env: 0.05),
        ("seeded", lambda *_: nullcontext()),
    ):
        monkeypatch.setattr(robustness, name, other)
    return found


def agent(**own: float) -> Any:
    settings = SimpleNamespace(values={"env": {"randomization": own}})
    return SimpleNamespace(
        settings=settings,
        model=SimpleNamespace(image_sizes={}),
        policies={"ik": object(), "noop": object()},
        env=None,
    )


def test_a_shift_narrows_no_range_that_the_run_had(made: list[dict[str, Any]]) -> None:
    shifts = {"gains": SHIFTS["servo gains ± 40 %"], "late": Shift({"action_latency": 3})}
    robustness.robustness(agent(gains=0.6, action_latency=1, mass=0.1), episodes=4, shifts=shifts)
    assert [one["randomization"] for one in made] == [
        {"gains": 0.6, "action_latency": 1, "mass": 0.1},
        {"gains": 0.6, "action_latency": 1, "mass": 0.1},
        {"gains": 0.6, "action_latency": 3, "mass": 0.1},
    ]


def test_another_solver_is_no_part_of_what_friction_does(made: list[dict[str, Any]]) -> None:
    """Three centimetres with it: one is the world's as trained, one the solver's, one the friction's."""
    found = robustness.robustness(agent(), episodes=4, shifts={FRICTION: SHIFTS[FRICTION]})
    assert found[UNSHIFTED]["ik"]["change"] is None
    assert found[FRICTION]["ik"]["change"]["mean"] == pytest.approx(0.01)
    assert made[-1]["solver_iterations"] == 30 and "randomization" not in made[-1]
    assert len(made) == 3  # one for all policies
