"""``replay.future``: refused where nothing reads it, drawn in a run, not in its first stage; plans near its policy."""

from __future__ import annotations

import pytest
import torch

from franka_wm.errors import UserError
from franka_wm.models.lewm import LeWorldModel
from franka_wm.planning import GoalImage, GoalPolicyPenalty, Sum
from franka_wm.training import build
from franka_wm.training.check import check
from franka_wm.training.load import load_model
from franka_wm.training.spaces import Spaces

GOALS = ("device=cpu", "scale=smoke", "env=reach_goal_image", "model=lewm", "replay.future=true")


def test_it_needs_heads_that_read_it(settled) -> None:
    with pytest.raises(
        UserError, match=r"replay.future=true: .* model=lewm does not have here; set model.goal_"
    ):
        check(settled(*GOALS))
    with pytest.raises(UserError, match="model=tdmpc2 does not have"):
        check(settled("device=cpu", "scale=smoke", "env=reach", "replay.future=true"))
    for option in ("goal_policy_coef", "goal_steps_coef"):
        check(settled(*GOALS, f"model.{option}=1"))


def test_not_beside_demonstrations(settled, tmp_path) -> None:
    with pytest.raises(UserError, match=r"replay.future=true: does not go with replay.demos; train on"):
        check(settled(*GOALS, "model.goal_policy_coef=1", f"replay.demos={tmp_path}"))


def test_a_run_draws_them_to_the_end_of_its_episodes(settled) -> None:
    run = settled(*GOALS, "model.goal_policy_coef=1")
    replay = build.make_replay_buffer(run, torch.device("cpu"))
    assert replay.future is not None and replay.future.episode_length == run.env.episode_length
    assert build.make_replay_buffer(settled(*GOALS[:-1]), torch.device("cpu")).future is None


def test_a_first_stage_has_no_goals(settled) -> None:
    words = ("device=cpu", "scale=smoke", "env=reach_goal_image", "model=action_world_model", "pretrain=jepa")
    run = settled(*words, "replay.future=true", "model.goal_policy_coef=1")
    assert run.replay.future and not run.first_stage().replay.future


def test_plans_are_kept_near_a_policy_towards_goals(settled) -> None:
    words = ("device=cpu", "scale=smoke", "env=reach_goal_image", "model=lewm", "objective.policy_penalty=3")
    run = settled(*words, "model.goal_policy_coef=1")
    spaces = Spaces.of_config(run.env.arm, discrete=False)
    objective = build.make_objective(run, build.make_model(run, spaces, torch.device("cpu")))
    assert isinstance(objective, Sum)
    image, penalty = (term for _, term in objective.terms)
    assert isinstance(image, GoalImage) and isinstance(penalty, GoalPolicyPenalty)
    assert penalty.weight == 3 and penalty.reader is image
    run = settled(*words)
    with pytest.raises(UserError, match="model=lewm has no policy; leave it at 0"):
        build.make_objective(run, build.make_model(run, spaces, torch.device("cpu")))


def test_a_resumed_run_keeps_the_unit_of_distances(train, tmp_path, capsys) -> None:
    words = (
        "env=reach_goal_image",
        "env.image_size=32",
        "model=lewm",
        "planner=icem",
        "planner.iterations=1",
    )
    more = ("replay.future=true", "model.goal_steps_coef=1", "trainer.updates=2", "evaluation.during=[]")
    train(*words, *more, folder=tmp_path / "first")
    again = ("env.episode_length=12", "trainer.updates=4")
    train(f"resume={tmp_path}/first", *again, folder=tmp_path / "second")
    assert "follow: episode_length=8 (here 12)\n" in capsys.readouterr().out
    for folder in ("first", "second"):
        model = load_model(tmp_path / folder)
        assert isinstance(model, LeWorldModel) and model.goal_heads is not None
        assert model.goal_heads.episode_length == 8
