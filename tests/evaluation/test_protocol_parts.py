"""The protocol without a trained agent: seeds, rounds, what is divided, what is written down."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from franka_wm import processes
from franka_wm.envs import FrankaEnv
from franka_wm.errors import UserError
from franka_wm.evaluation.protocol import (
    all_worlds,
    describe,
    during_training,
    evaluate_agent,
    evaluate_policies,
    evaluate_run,
    held_out_seeds,
    numbers_to_log,
    protocol,
    thresholds,
)
from franka_wm.evaluation.results import END
from franka_wm.policies.scripted import NoopPolicy, SmoothRandomPolicy

WORLDS, LENGTH = 5, 3


@pytest.fixture(scope="module")
def env(small_env) -> FrankaEnv:
    return small_env(WORLDS, episode_length=LENGTH, goal_sampling="reachable", success_distance=0.4)


class Drawing(NoopPolicy):
    """Does nothing; keeps what it saw and drew at each decision."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[list[float], float]] = []

    def forward(self, tensordict):
        self.seen.append((tensordict["state"].flatten().tolist(), float(torch.rand(()))))
        return super().forward(tensordict)


def test_what_is_usual(env: FrankaEnv) -> None:
    agent = SimpleNamespace(env=env, policies={"noop": NoopPolicy()})
    found = evaluate_agent(agent)
    assert found.policies["noop"]["episodes"] == 100 and list(found.seconds) == ["noop"]
    assert found.worlds == WORLDS and found.seeds == held_out_seeds(20)
    other = evaluate_agent(agent, episodes=2, policies={"other": NoopPolicy()}, timing=False)
    assert list(other.policies) == ["other"] and other.seconds == {}


def test_one_round_of_all_worlds_without_times(env: FrankaEnv) -> None:
    found = evaluate_policies(env, {"noop": NoopPolicy()})
    assert found.policies["noop"]["episodes"] == WORLDS
    assert found.seconds == {} and found.seeds == held_out_seeds(1)


def test_decisions_are_timed_along_the_first_round(env: FrankaEnv) -> None:
    """With its random numbers, so that the same is timed however many rounds there are."""
    policy = Drawing()
    evaluate_policies(env, {"it": policy}, episodes=2 * WORLDS, timing=True)
    first, second, timed = (policy.seen[k * LENGTH] for k in range(3))
    assert timed == first and second[0] != first[0] and second[1] != first[1]


def test_how_many_episodes_and_seeds(env: FrankaEnv) -> None:
    noop = {"noop": NoopPolicy()}
    assert evaluate_policies(env, noop, episodes=2).policies["noop"]["episodes"] == 2
    for refused in (1, 2.5):
        with pytest.raises(UserError, match=f"episodes={refused}"):
            evaluate_policies(env, noop, episodes=refused)
    with pytest.raises(UserError, match="2 rounds"):
        evaluate_policies(env, noop, episodes=WORLDS + 1, seeds=[1])
    found = evaluate_policies(env, noop, episodes=WORLDS + 1, seeds=[1, 2, 3])  # more than are needed
    assert found.seeds == [1, 2] and found.policies["noop"]["episodes"] == WORLDS + 1


@pytest.mark.parametrize("episodes", [5, 7, 6])
def test_two_processes_play_what_one_plays(episodes: int, small_env, monkeypatch) -> None:
    """One after the other, each with three worlds of six; of the second round, the second one may play nothing."""
    policies = {"random": SmoothRandomPolicy(generator=torch.Generator()), "noop": NoopPolicy()}
    few = small_env(3, episode_length=LENGTH, goal_sampling="reachable", success_distance=0.4)
    every = small_env(6, episode_length=LENGTH, goal_sampling="reachable", success_distance=0.4)
    expected = evaluate_policies(every, policies, episodes=episodes)
    told: list[Any] = []
    monkeypatch.setattr(processes, "count", lambda: 2)
    monkeypatch.setattr(processes, "rank", lambda: 1)
    monkeypatch.setattr(processes, "objects", lambda own: told.append(own) or [own, expected_like])
    expected_like = expected.episodes["noop"][:1]
    evaluate_policies(few, policies, episodes=episodes, together=6)
    second = list(told)
    assert [one is None for one in second] == ([False, True] * 2 if episodes == 7 else [False] * 2)
    monkeypatch.setattr(processes, "rank", lambda: 0)
    monkeypatch.setattr(processes, "objects", lambda own: [own, second.pop(0)])
    found = evaluate_policies(few, policies, episodes=episodes, together=6)
    assert found.worlds == 6 and found.policies == expected.policies
    for name, rows in expected.episodes.items():
        assert (found.episodes[name] == rows).all(), name


def test_alone_dividing_changes_nothing(env: FrankaEnv, settled, monkeypatch) -> None:
    noop, settings = {"noop": NoopPolicy()}, settled("evaluation.episodes=8").evaluation
    expected = evaluate_policies(env, noop)
    assert evaluate_policies(env, noop, together=WORLDS).policies == expected.policies
    assert all_worlds(settings, env) == WORLDS
    monkeypatch.setattr(processes, "count", lambda: 2)
    assert all_worlds(settings, env) == 8


def test_thresholds_are_those_of_the_table_and_the_task_s_own(env: FrankaEnv, monkeypatch) -> None:
    assert thresholds(env) == [0.4, 0.05, 0.025, 0.01]
    monkeypatch.setattr(type(env.simulation.task), "success_distance", None)
    assert thresholds(env) == []


def test_how_it_was_measured(env: FrankaEnv, settled, monkeypatch) -> None:
    settings = settled("scale=smoke", "seed=7")
    found = evaluate_policies(env, {"planner": NoopPolicy()}, episodes=6)
    counters = {"updates": 9, "env_steps": 120, "seconds": 3.5}
    told = protocol(settings, env, found, by=END, counters=counters)
    expected = {
        "by": END, "task": "reach", "model": settings.model.name, "planner": settings.planner.name, "seed": 7,
        "updates": 9, "env_steps": 120, "training_seconds": 3.5, "episodes": 6, "worlds": WORLDS,
        "seeds": ", ".join(map(str, held_out_seeds(2))), "success_distance": pytest.approx(0.4), "device": "cpu",
    }  # fmt: skip
    assert {name: told.get(name) for name in expected} == expected
    monkeypatch.setattr(type(env.simulation.task), "success_distance", None)
    less = protocol(settings, env, evaluate_policies(env, {"noop": NoopPolicy()}), by=END, counters={})
    lacks = {"planner", "updates", "env_steps", "training_seconds", "success_distance"}
    assert set(less) == set(told) - lacks


def test_a_point_of_the_curves_is_of_the_first_episodes(env: FrankaEnv) -> None:
    noop = {"noop": NoopPolicy()}
    distances = evaluate_policies(env, noop).episodes["noop"]["final_distance"]
    for episodes, played in ((None, WORLDS), (2, 2), (500, WORLDS)):
        told = numbers_to_log(env, noop, episodes=episodes)
        assert told["eval/noop/final_distance"] == pytest.approx(float(distances[:played].mean()))
        assert 0 <= told["eval/noop/success"] <= 1
    assert numbers_to_log(env, noop, together=WORLDS) == numbers_to_log(env, noop)
    with pytest.raises(UserError, match="episodes=1"):
        numbers_to_log(env, noop, together=1)


def test_a_line_about_a_policy() -> None:
    near = {"final_distance": {"mean": 0.1234}, "return": {"mean": 2.0}, "success": {"0.05": {"mean": 0.5}}}
    assert describe("planner", near) == "  planner: final distance 12.34 cm"
    judged = {"success": {"mean": 0.75}, "return": {"mean": 1.234}}
    assert describe("ik", judged) == "  ik: success 75 %, return 1.23"
    assert describe("ik", {"return": {"mean": 1.234}}) == "  ik: return 1.23"


def test_what_the_trainer_logs(env: FrankaEnv, settled, capsys) -> None:
    settings = settled("evaluation.during=[policy,noop]", "evaluation.during_episodes=2").evaluation
    noop = {"noop": NoopPolicy(), "random": SmoothRandomPolicy(generator=torch.Generator())}
    told = during_training(settings, env, noop)()
    assert told == numbers_to_log(env, {"noop": NoopPolicy()}, episodes=2) and told
    assert during_training(settings, None, noop)() == {}
    capsys.readouterr()
    assert during_training(settings, env, {"random": noop["random"]})() == {}
    assert capsys.readouterr().out == (
        "evaluation.during=[policy,noop]: no such policy acts here, of those there: random; nothing is evaluated while "
        "training\n"
    )
    assert during_training(settled("evaluation.during=[]").evaluation, env, noop)() == {}
    assert capsys.readouterr().out == ""


def test_the_first_process_writes_what_was_found(
    env: FrankaEnv, settled, monkeypatch, tmp_path: Path
) -> None:
    said: list[str] = []
    settings = settled("scale=smoke")
    found = evaluate_run(
        settings, tmp_path, env, {"noop": NoopPolicy()}, counters={"updates": 3}, say=said.append
    )
    written = json.loads((tmp_path / "evaluation.json").read_text())
    assert written["policies"] == found.policies and written["protocol"] == found.protocol
    assert found.protocol["updates"] == 3
    assert said[0] == f"evaluating over {WORLDS} held-out episodes …"
    told = re.escape(describe("noop", found.policies["noop"]))
    assert re.fullmatch(rf"{told}   \(\d+\.\d s\)", said[1]) and len(said) == 2
    (tmp_path / "evaluation.json").unlink()
    monkeypatch.setattr(processes, "is_first", lambda: False)
    evaluate_run(settings, tmp_path, env, {"noop": NoopPolicy()}, counters={}, say=said.append)
    assert not list(tmp_path.iterdir())
