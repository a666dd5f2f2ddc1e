"""Episodes that the simulator ends are told; what a world does after its own episode does not spoil it."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from franka_wm.commands import evaluate_checkpoint
from franka_wm.envs import FrankaEnv, MultiTaskEnv
from franka_wm.envs.multitask_config import MultiTaskConfig
from franka_wm.errors import UserError
from franka_wm.evaluation import robustness
from franka_wm.evaluation.closed_loop import play_episodes
from franka_wm.evaluation.protocol import evaluate_policies
from franka_wm.policies.scripted import NoopPolicy
from franka_wm.report.diagnostics import robustness_table

LENGTH = 4


class Breaks(NoopPolicy):
    """Before the second step, a joint of world 1 moves at a speed that is no number."""

    def __init__(self, env: FrankaEnv):
        super().__init__(env.action_dim)
        self.env, self.asked = env, 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.asked == 1:
            self.env.simulation.tensors.joint_qd.view(self.env.num_envs, -1)[1] = torch.nan
        self.asked += 1
        return super().forward(tensordict)


@pytest.fixture(scope="module")
def env(small_env) -> FrankaEnv:
    return small_env(3, episode_length=LENGTH)


def test_broken_worlds_are_counted_and_said(env: FrankaEnv, capsys) -> None:
    found = evaluate_policies(env, {"it": Breaks(env)})
    rows, summary = found.episodes["it"], found.policies["it"]
    assert rows["cut_short"].tolist() == [0.0, 1.0, 0.0] and rows["length"].tolist() == [LENGTH, 2, LENGTH]
    assert summary["cut_short"] == 1 and summary["episodes"] == 3
    assert "warning: it: the simulator cut 1 of 3 episodes short" in capsys.readouterr().out
    whole = evaluate_policies(env, {"noop": NoopPolicy()})
    assert "cut_short" not in whole.policies["noop"] and capsys.readouterr().out == ""


@pytest.mark.parametrize("at_once", [False, True])
def test_they_are_no_successes_wherever_they_stood(small_env, at_once: bool) -> None:
    """Everywhere is near enough here; of several tasks at once, too."""
    near = {"episode_length": LENGTH, "success_distance": 5.0}
    env = arm = small_env(4, **near)
    if at_once:
        env = MultiTaskEnv(
            MultiTaskConfig(tasks={"one": arm.config, "other": arm.config}), num_envs=4, device="cpu"
        )
        arm = env.envs["other"]
    found = evaluate_policies(env, {"it": Breaks(arm)})
    rows, summary = found.episodes["it"], found.policies["it"]
    cut = 3 if at_once else 1  # world 1 of its task's two
    kept = [float(k != cut) for k in range(4)]
    assert rows["success"].tolist() == rows["success_once"].tolist() == kept
    tasks = {"one": 1.0, "other": 0.5} if at_once else {}
    assert {name: rate["mean"] for name, rate in summary.get("task_success", {}).items()} == tasks
    for name in ("success", "success_once"):
        assert (summary[name] if at_once else summary[name]["5"])["mean"] == 0.75


def test_shifted_worlds_that_break_are_counted() -> None:
    """All end at the goal in both worlds; where they were cut short there they are no successes, and nothing works."""
    near = {"final_distance": torch.full((40,), 0.01)}
    whole = TensorDict({**near, "success": torch.ones(40), "cut_short": torch.zeros(40)}, [40])
    cut = TensorDict({**near, "success": torch.zeros(40), "cut_short": torch.ones(40)}, [40])
    found = robustness._compared(cut, whole, 0.05)
    assert found["verdict"] == "breaks" and found["cut_short"] == 40
    assert robustness._compared(cut, cut.clone(), 0.05)["verdict"] == "never worked"
    assert robustness._compared(whole, cut, 0.05)["cut_short"] == 40
    whole = robustness._compared(whole, whole.clone(), 0.05)
    assert whole["verdict"] == "holds" and "cut_short" not in whole
    rows = robustness_table({"mass": {"ik": found}, "gains": {"ik": whole}}, success_distance=0.05).rows
    assert [row[-1] for row in rows] == ["breaks (40 cut short)", "holds"]


def test_they_are_said_of_shifted_worlds(monkeypatch, capsys) -> None:
    found = {"ik": {"verdict": "breaks", "cut_short": 3, "final_distance": {"mean": 0.1}}}
    monkeypatch.setattr(
        evaluate_checkpoint, "robustness", lambda agent, episodes, report: report("mass", found)
    )
    evaluate_checkpoint._shift(None, 40, {"protocol": {}}, print)  # type: ignore[arg-type]
    assert "warning: ik: the simulator cut 3 of 40 episodes short" in capsys.readouterr().out


def test_a_solver_that_cannot_randomise_is_refused_before_anything_is_played(small_env) -> None:
    agent = SimpleNamespace(env=small_env(2, solver="featherstone"))
    with pytest.raises(UserError, match=r"shifts need env\.solver=mujoco"):
        robustness.check_shiftable(agent)  # type: ignore[arg-type]


def test_what_comes_after_an_episode_does_not_spoil_it(env: FrankaEnv, monkeypatch) -> None:
    """World 1 plays on after step 2; a reward, or a pose, that is no number there is of no episode that counts."""
    expected, step, steps = play_episodes(env, Breaks(env), seed=2), env.step_and_maybe_reset, 0

    def odd(tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        nonlocal steps
        after, following = step(tensordict)
        steps += 1
        if steps > 2:
            after["next", "reward"][1] = env.simulation.tensors.next_true_state[1, 14:17] = torch.nan
            env.simulation.tensors.action[1] = torch.nan
        return after, following

    monkeypatch.setattr(env, "step_and_maybe_reset", odd)
    found = play_episodes(env, Breaks(env), seed=2)
    assert steps == LENGTH and (found == expected).all()
