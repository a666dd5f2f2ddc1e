"""What is checked before anything is built costs no model."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from franka_wm import models
from franka_wm.errors import UserError
from franka_wm.training import build
from franka_wm.training.check import _check_parts, check, known_spaces
from franka_wm.training.spaces import Spaces

MODELS = (
    (),
    ("env=reach_pixels", "model=tdmpc2_pixels"),
    ("env=reach_fixed", "model=muzero", "planner=gumbel"),
    ("env=reach_goal_image", "model=lewm"),
    ("env=reach_goal_image", "model=action_world_model"),
    ("env=reach_goal_image", "model=vjepa"),
)


def built(settings, monkeypatch) -> nn.Module:
    """The model that a check looks at."""
    made, make = [], build.make_model
    monkeypatch.setattr(build, "make_model", lambda *given: made.append(make(*given)) or made[-1])
    check(settings)
    (model,) = made
    return model


@pytest.mark.parametrize("words", MODELS)
def test_a_check_looks_at_the_shapes_of_the_very_model(words, settled, monkeypatch) -> None:
    settings = settled("device=cpu", "scale=smoke", *words)
    state = torch.get_rng_state()
    sketch = built(settings, monkeypatch)
    assert torch.equal(torch.get_rng_state(), state), "a check drew weights"
    assert {one.device.type for one in sketch.state_dict().values() if torch.is_tensor(one)} == {"meta"}
    whole = build.make_model(
        settings, Spaces.of_config(settings.env.arm, discrete=settings.is_discrete), "cpu"
    )
    shapes = [{k: v.shape for k, v in one.named_parameters()} for one in (sketch, whole)]
    assert shapes[0] == shapes[1] != {}


def test_what_a_constructor_refuses_is_refused_by_the_check(settled) -> None:
    with pytest.raises(UserError, match=r"model=vjepa|model=jepa.*patch_size must divide"):
        check(settled("device=cpu", "scale=smoke", *MODELS[-1], "model.patch_size=7"))


GYM = ("env=gym", "env.name=Pendulum-v1")
TASKS = (
    "env=multitask",
    *(f"~env.tasks.{name}" for name in ("track", "lift", "pick", "stack", "drawer", "peg")),
)
ENVIRONMENTS = (
    ("env=gym", "model=muzero", "planner=gumbel"),  # CartPole: discrete actions
    GYM,
    ("env=dm_control", "+env.observations={state: [to_target, velocity], pose: position}"),
    TASKS,
)


@pytest.mark.parametrize("words", ENVIRONMENTS)
def test_sizes_are_known_before_worlds_are_built(words, settled) -> None:
    if "env=dm_control" in words:
        pytest.importorskip("dm_control")
    settings = settled("device=cpu", "scale=smoke", *words)
    check(settings)
    env = build.make_env(settings, num_envs=2)
    assert known_spaces(settings) == Spaces.of_env(env)
    env.close()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("env=gym", "model=tdmpc2"), "model=tdmpc2 needs continuous actions, here are 2 discrete ones"),
        ((*GYM, "model=tdmpc2_pixels"), "reads 'pixels', here are state"),
        ((*GYM, "model=muzero", "planner=gumbel"), "has discrete actions; this environment's actions are"),
        ((*GYM, "planner=mcts"), "planner=mcts: model=tdmpc2 has continuous actions; use planner=mppi"),
        (("env=gym", "model=muzero"), "planner=mppi: model=muzero has discrete actions; use planner=mcts"),
        (
            (*GYM, "objective=goal_image"),
            r"needs goal_pixels \(here are state\), and a model that reads pixels",
        ),
        (
            (*TASKS, "model=tdmpc2_pixels"),
            "reads 'pixels', here are goal, joint_target, objects, state, ",
        ),
        ((*TASKS, "model=muzero", "planner=gumbel"), "model=muzero has discrete actions"),
        ((*TASKS, "model.observations=[state]"), "model=tdmpc2: .* add task to model.observations"),
    ],
)
def test_a_model_that_does_not_fit_is_refused_before_worlds_are_built(words, said, settled) -> None:
    with pytest.raises(UserError, match=said):
        check(settled("device=cpu", "scale=smoke", *words))


def test_a_family_of_ones_own_is_built_whole(settled, monkeypatch) -> None:
    class Mine(models.family("tdmpc2")):
        def __init__(self, **options):
            super().__init__(**options)
            self.norm = sum(float(one.norm()) for one in self.parameters())  # needs values

    monkeypatch.setitem(models._REGISTERED, "mine", (Mine, ""))
    sketch = built(settled("device=cpu", "scale=smoke", "model.name=mine"), monkeypatch)
    assert {one.device.type for one in sketch.parameters()} == {"cpu"}


def test_more_updates_of_the_first_steps_than_there_are(settled) -> None:
    with pytest.raises(UserError, match=r"collector\.seed_updates=31: must be at most trainer\.updates=30"):
        check(settled("device=cpu", "scale=smoke", "collector.seed_updates=31"))


RECORDED = ("trainer=offline", "dataset=lerobot", "dataset.root=there")


@pytest.mark.parametrize("env", ["multitask", "gym"])
def test_recordings_are_of_the_arm(env: str, settled) -> None:
    with pytest.raises(UserError, match=f"env={env} is not what the arm recorded; use env=none"):
        check(settled("device=cpu", "scale=smoke", f"env={env}", *RECORDED))


def test_a_goal_that_no_image_shows_is_refused_offline_too(settled) -> None:
    words = ("device=cpu", "scale=smoke", "model=lewm", "planner=icem", *RECORDED)
    with pytest.raises(UserError, match="planning to a goal image needs goal_pixels"):
        _check_parts(settled("env=push_pixels", *words))
    _check_parts(settled("env=push_goal_image", *words))
    _check_parts(settled("env=none", *words))


def test_a_model_or_planner_that_is_not_there_is_answered_as_one_chooses_it(settled) -> None:
    """Among all presets, those too that are another one with other settings."""
    planners = "must be one of cem, gradient, gumbel, icem, mcts, mppi; one of your own: plugins="
    wrong = settled("planner.name=crystal_ball")
    for asked in (lambda: build.make_planner(wrong, 7), lambda: check(wrong)):
        with pytest.raises(UserError, match=f"^planner=crystal_ball: {planners}"):
            asked()
    with pytest.raises(
        UserError, match=r"^model=oracle_bone: must be one of .*, tdmpc2, tdmpc2_pixels, vjepa; one"
    ):
        settled("model.name=oracle_bone")
    for preset in ("planner.name=gumbel", "model.name=vjepa"):
        group, name = preset.split(".name=")
        with pytest.raises(UserError, match=rf"^{preset}: write {group}={name}, which sets more than a name"):
            check(settled(preset))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            (*MODELS[-1], "collector.policy=planner"),
            "collector.policy=planner: model=jepa cannot plan; must be one of auto, noop, random, ik, expert",
        ),
        (
            (*MODELS[-1], "collector.policy=policy"),
            "collector.policy=policy: model=jepa has no policy; must be one of auto, noop, random, ik, expert",
        ),
        (
            (*MODELS[2], "collector.policy=random"),
            "collector.policy=random: model=muzero learns from its own search; must be one of auto, planner",
        ),
    ],
)
def test_a_policy_that_the_model_does_not_have_cannot_gather(words, said: str, settled) -> None:
    with pytest.raises(UserError) as refused:
        check(settled("device=cpu", "scale=smoke", *words))
    assert str(refused.value) == said
