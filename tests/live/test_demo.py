"""The agent that the package brings: it loads, it is small, and it moves the tool to the goal."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from franka_wm.commands import main as cli
from franka_wm.commands.demo import AGENT, demo
from franka_wm.commands.view import view
from franka_wm.training.load import load_agent

STEPS = 30


def final_distance(env: Any, policy: Any) -> float:
    """Mean distance of the tool to its goal [m] after STEPS steps of the same first episodes."""
    env.set_seed(7)
    last = env.rollout(STEPS, policy, break_when_any_done=False)["next", "state"][:, -1]
    return float(last[:, 17:20].norm(dim=-1).mean())


def test_packaged_agent_reaches() -> None:
    """Well below doing nothing. A failure to load: the model's code has changed; ``make demo-agent`` trains anew."""
    agent = load_agent(AGENT, num_envs=16, device="cpu")
    with torch.no_grad():
        planned = final_distance(agent.env, agent.policies["planner"])
        idle = final_distance(agent.env, agent.policies["noop"])
    assert planned < 0.5 * idle, (planned, idle)


def test_packaged_agent_is_small_and_anonymous() -> None:
    assert sum(file.stat().st_size for file in AGENT.iterdir()) <= 3 * 2**20
    assert {file.name for file in AGENT.iterdir()} == {
        "manifest.json", "config.yaml", "counters.json", "model.safetensors", "extra.json", "extra.safetensors",
    }  # fmt: skip
    for text in ("config.yaml", "manifest.json", "extra.json"):
        assert not any(part in (AGENT / text).read_text() for part in ("/home/", "/root", "/tmp", "/work"))


def test_demo_serves_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "port=0", "seconds=2", "device=cpu"]) == 0
    assert "http://127.0.0.1:" in capsys.readouterr().out


def test_demo_refuses_another_checkpoint(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "checkpoint=x"]) == 1
    assert "demo: checkpoint: no such option" in capsys.readouterr().err
    assert cli.main(["demo", "--help"]) == 0
    assert "franka-wm view" in capsys.readouterr().out


def test_no_environment_is_offered_which_the_agent_would_refuse() -> None:
    assert cli.main(["demo", "env=reach"]) == 1
    assert "env" not in {one.name for one in demo.params} and "env" in {one.name for one in view.params}
