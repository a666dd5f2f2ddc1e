"""Diagnostics of an exact model: each number is the one that it is called."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from franka_wm.evaluation import closed_loop, diagnose
from franka_wm.evaluation.open_loop import steps_until_forgotten
from franka_wm.models import WorldModel
from franka_wm.training import build

LENGTH = 4


class Exact(WorldModel):
    """Points on a line: z' = z + a; where every step pays 1, its value is what follows, discounted."""

    observation_sizes = {"position": 1}
    action_dim, latent_dim = 1, 1

    def __init__(self, discount: float = 0.5) -> None:
        super().__init__()
        self.discount = discount

    def encode(self, observation: Any) -> Any:
        return observation.get("position")

    def next(self, z: Any, action: Any) -> Any:
        return z + action

    def value(self, z: Any) -> Any:
        return torch.full_like(z, 1 / (1 - self.discount))


def held(positions: torch.Tensor, latents: torch.Tensor, images: Any = None) -> diagnose.Held:
    """Episodes (E, T) at these places along x, with these latents (E, T + 1)."""
    count, steps = positions.shape
    physical = torch.zeros(count, steps, 20)
    physical[..., 14] = positions
    moved = latents[:, 1:] - latents[:, :-1]
    episodes = TensorDict({"physical": physical, "action": moved.unsqueeze(-1)}, batch_size=[count, steps])
    valid = torch.ones(count, steps + 1, dtype=torch.bool)
    return diagnose.Held(episodes, latents.unsqueeze(-1), valid, images)


@pytest.mark.parametrize("discount", [0.5, 0.8])
def test_values_are_held_against_returns_of_the_models_own_discount(
    discount: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = LENGTH + steps_until_forgotten(discount)
    never = torch.zeros(2, steps, 1, dtype=torch.bool)
    step = {"reward": torch.ones(2, steps, 1), "done": never, "terminated": never, "position": never.float()}
    root = {"valid": torch.ones(2, steps, dtype=torch.bool), "position": never.float()}
    played = TensorDict({**root, "next": TensorDict(step, batch_size=[2, steps])}, batch_size=[2, steps])
    compared: list[torch.Tensor] = []
    monkeypatch.setattr(build, "make_evaluation_env", lambda *a, **k: None)
    monkeypatch.setattr(diagnose, "gather_episodes", lambda *a, **k: (played, None))
    monkeypatch.setattr(diagnose, "arm_of", lambda env: None)
    monkeypatch.setattr(diagnose, "value_calibration", lambda *pair: compared.extend(pair) or {})
    env = SimpleNamespace(config=SimpleNamespace(episode_length=LENGTH), num_envs=2)
    agent: Any = SimpleNamespace(env=env, settings=None, policies={"policy": None}, model=Exact(discount))
    diagnose.calibration(agent)
    values, returns = compared
    wanted = [(1 - discount ** (steps - t)) / (1 - discount) for t in range(LENGTH)] * 2
    torch.testing.assert_close(returns, torch.tensor(wanted))
    torch.testing.assert_close(values, returns, rtol=0.02, atol=0)  # what is cut off weighs less than 2 %


def test_ranks_within_episodes_are_not_those_across() -> None:
    """Latents tell the places within an episode exactly, and are mirrored and far away in every other one."""
    places = torch.tensor([0.0, 1.0, 3.0, 7.0]).repeat(4, 1)
    sign = torch.tensor([1.0, -1.0, 1.0, -1.0]).unsqueeze(1)
    far = torch.tensor([0.0, 50.0, 20.0, 90.0]).unsqueeze(1)
    latents = torch.cat([sign * places + far, sign * 8 + far], 1)
    found = diagnose.open_loop(SimpleNamespace(model=Exact()), held(places, latents), horizon=2)  # type: ignore
    within, across = found["rank_correlation"], found["rank_correlation_across_episodes"]
    mean = [one["mean"] if isinstance(one, dict) else float(one) for one in (within, across)]
    assert mean[0] == pytest.approx(1.0) and mean[1] < 0.9


def test_the_decoder_is_judged_by_episodes_that_it_has_not_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    count, steps = 12, 5
    number = torch.arange(count).view(count, 1)
    images = number.view(count, 1, 1, 1, 1).expand(count, steps, 32, 32, 3).to(torch.uint8)
    seen: dict[str, set[int]] = {}

    def noted(name: str) -> Any:
        def call(*given: Any) -> dict[str, float]:
            latents, shown = given[-2:]
            assert latents.flatten().tolist() == shown[:, 0, 0, 0].tolist()  # each image with its own latent
            seen[name] = set(shown[:, 0, 0, 0].tolist())
            return {"error": 0.0}

        return call

    monkeypatch.setattr(diagnose, "train_decoder", noted("fit"))
    monkeypatch.setattr(diagnose, "decoder_error", noted("judged"))
    monkeypatch.setattr(diagnose, "imagined_beside_real", lambda *a: None)
    nothing = torch.zeros(0, 1), torch.zeros(0, 32, 32, 3, dtype=torch.uint8)
    monkeypatch.setattr(diagnose, "_starts", lambda *a, **k: nothing)
    latents = number.float().expand(count, steps + 1)
    shown = held(torch.zeros(count, steps), latents, images)
    assert diagnose.imagine(SimpleNamespace(model=Exact()), shown) is not None  # type: ignore
    assert seen == {"fit": set(range(10)), "judged": {10, 11}}


def test_a_decision_is_timed_without_the_step_that_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock of its own: decisions take 2 s, the first three 100; each step of the world takes 7."""
    now, decided = [0.0], [0]

    def policy(worlds: str) -> str:
        now[0] += 100 if decided[0] < 3 else 2
        decided[0] += 1
        return worlds

    def step(worlds: str) -> tuple[str, str]:
        now[0] += 7
        return worlds, worlds

    monkeypatch.setattr(closed_loop, "begin", lambda *_: "worlds")
    monkeypatch.setattr(closed_loop, "evaluating", lambda _: nullcontext())
    monkeypatch.setattr(closed_loop.time, "perf_counter", lambda: now[0])
    env: Any = SimpleNamespace(device=torch.device("cpu"), step_and_maybe_reset=step)
    timed: Any = policy
    assert closed_loop.decision_times(env, timed, decisions=5).tolist() == [2.0] * 5
