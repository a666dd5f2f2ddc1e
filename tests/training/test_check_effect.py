"""What would have no effect: options are refused, or said where files of tuned values set them; images are said."""

from __future__ import annotations

import pytest

from franka_wm.errors import UserError
from franka_wm.training.check import _check_parts, check

MUZERO = ("env=reach_fixed", "model=muzero", "planner=mcts")
LEWM = ("env=reach_goal_image", "model=lewm")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("model.imitation_coef=10",), "model.imitation_coef=10: needs demonstrations, replay.demos=FOLDER"),
        (("replay.demo_share=0.3",), "replay.demo_share=0.3: needs demonstrations"),
        (("replay.demo_share_end=0.1",), "replay.demo_share_end=0.1: needs demonstrations"),
        ((*MUZERO, "objective.action_penalty=1"), "objective.action_penalty=1: model=muzero plans without"),
        ((*MUZERO, "objective.policy_penalty=1"), "objective.policy_penalty=1: model=muzero plans without"),
        ((*MUZERO, "objective.smoothness_penalty=1"), "objective.smoothness_penalty=1: model=muzero plans"),
        (
            (*MUZERO, "objective.name=reward_value", "objective.action_penalty=1"),
            "plans without an objective",
        ),
        (
            (*MUZERO, "objective=reward_value"),
            "objective=reward_value: model=muzero plans without .* at auto",
        ),
        ((*MUZERO, "objective.summed=false"), "objective.summed=False: is of objective=goal_image"),
        ((*LEWM, "model.reward_head=true"), "model.reward_head=true: no objective reads it"),
    ],
)
def test_what_would_do_nothing_is_refused(words: tuple[str, ...], said: str, settled) -> None:
    with pytest.raises(UserError, match=said) as refused:
        check(settled("device=cpu", "scale=smoke", *words))
    assert "\n" not in str(refused.value)


def test_how_the_policy_explores_is_said_where_it_does_not_act(settled, capsys) -> None:
    """Files of tuned values set it, so that it is no error."""
    words = ("device=cpu", "scale=smoke", "collector.planner_worlds=2", "collector.noise=0.3")
    check(settled(*words))
    assert "collector" not in capsys.readouterr().out
    for actor in ("random", "planner"):
        check(settled(*words, f"collector.policy={actor}"))
        said = capsys.readouterr().out
        assert "collector.planner_worlds=2: is for collector.policy=policy" in said
        assert "collector.noise=0.3: is for collector.policy=policy and does nothing here" in said
        assert f"the worlds act by {actor}\n" in said
        check(settled(*words[:2], f"collector.policy={actor}", "collector.noise=0"))
        assert "collector" not in capsys.readouterr().out


def test_images_to_be_standardised_are_said_where_nothing_is(settled, capsys) -> None:
    words = ("device=cpu", "scale=smoke", "env=reach_pixels", "model=tdmpc2_pixels")
    for standardize, said in (("true", 0), ("false", 1)):
        check(settled(*words, "model.standardize_images=true", f"trainer.standardize={standardize}"))
        assert capsys.readouterr().out.count("does nothing with trainer.standardize=false") == said


@pytest.mark.parametrize(
    ("words", "unread"),
    [
        (("env=push_pixels", "model=tdmpc2_pixels"), "pixels_wrist"),
        (("env=push_pixels", "model=tdmpc2_pixels", "model.observations=[pixels,pixels_wrist,state]"), None),
        (("env=reach_pixels", "model=tdmpc2"), "pixels"),
        (LEWM, None),
        ((*LEWM, "env.cameras=[front,side]"), "pixels_side, goal_pixels_side"),
        (("env=reach",), None),
    ],
)
def test_images_that_nothing_reads_are_said(
    words: tuple[str, ...], unread: str | None, settled, capsys
) -> None:
    check(settled("device=cpu", "scale=smoke", *words))
    lines = [line for line in capsys.readouterr().out.splitlines() if "not read" in line]
    assert lines == ([] if unread is None else [f"not read by the model: {unread} (model.observations)"])


@pytest.mark.parametrize(
    ("words", "drawn", "said"),
    [
        (("env=reach",), "{color: 0.5, camera_target: 0.1, mass: 0.1}", ["color=0.5", "camera_target=0.1"]),
        (("env=reach_pixels",), "{color: 0.5, brightness: 0.5, camera_position: 0.1}", []),
        (
            ("env=push_pixels", "env.cameras=[wrist]"),
            "{color: 0.5, camera_position: 0.1}",
            ["camera_position=0.1"],
        ),
        (("env=push_pixels", "env.cameras=[side]"), "{camera_position: 0.1}", []),
        (("env=reach", "env.observations=[depth,state]"), "{color: 0.5, camera_target: 0.1}", ["color=0.5"]),
        (("env=reach_pixels",), "{}", []),
    ],
)
def test_randomization_that_no_image_shows_is_said(
    words: tuple[str, ...], drawn: str, said: list[str], settled, capsys
) -> None:
    check(settled("device=cpu", "scale=smoke", *words, f"env.randomization={drawn}"))
    lines = [line for line in capsys.readouterr().out.splitlines() if "no image shows it" in line]
    assert [line.split(": does nothing")[0] for line in lines] == [f"env.randomization.{one}" for one in said]


def test_images_that_only_the_second_stage_reads_are_said(settled, capsys) -> None:
    words = ("env=reach_goal_image", "env.cameras=[front,side]", "model=action_world_model", "planner=cem")
    words = (*words, "model.observations=[pixels,pixels_side]", "pretrain=jepa", "scale=smoke", "device=cpu")
    check(settled(*words))
    said = "the first stage does not see pixels_side, which the model reads: "
    assert f"{said}'pretrain.model.observations=[pixels,pixels_side]'" in capsys.readouterr().out.splitlines()
    check(settled(*words, "pretrain.model.observations=[pixels,pixels_side]"))
    assert "first stage" not in capsys.readouterr().out


PIXELS = ("env=reach_pixels", "model=tdmpc2_pixels")


@pytest.mark.parametrize(
    ("words", "unseen"),
    [
        (PIXELS, True),
        ((*PIXELS, "dataset=lerobot", "dataset.root=there", "trainer=offline"), True),
        ((*PIXELS, "env.goal_sampling=fixed"), False),
        ((*PIXELS, "env.show_goal=true"), False),
        ((*PIXELS, "model.observations=[pixels,state]"), False),
        ((*PIXELS, "model.observations=[pixels,goal]"), False),
        (("env=reach", "model=tdmpc2", "env.observations=[joint_target]"), True),
        (("env=reach", "model=tdmpc2"), False),
        (("env=push_pixels", "model=tdmpc2_pixels"), False),  # the disc is drawn
        (("env=push_pixels", "model=tdmpc2_pixels", "env.show_goal=false"), True),
        (("env=push_pixels", "model=tdmpc2", "model.observations=[joint_target]"), True),  # it reads no image
        (
            ("env=drawer", "model=tdmpc2", "model.observations=[joint_target]"),
            False,
        ),  # no goal but the drawer
        (LEWM, False),
    ],
)
def test_a_goal_that_changes_and_is_not_seen_is_said(
    words: tuple[str, ...], unseen: bool, settled, capsys
) -> None:
    _check_parts(settled("device=cpu", "scale=smoke", *words))
    assert ("the model reads nothing that shows it" in capsys.readouterr().out) is unseen
