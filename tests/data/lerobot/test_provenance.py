"""Whether a recording was made in the same environment, from what it says of that."""

from dataclasses import fields
from pathlib import Path

import pytest

from franka_wm.data.lerobot.provenance import (
    DYNAMICS,
    LOOKS,
    MEANING,
    VIEWS,
    other_option,
    other_scene,
    recorded_sessions,
    recorded_tasks,
    told,
)
from franka_wm.data.lerobot.schema import PROVENANCE
from franka_wm.envs import FrankaConfig
from franka_wm.envs.ranges import Randomization
from franka_wm.errors import UserError

NOT_COMPARED = {
    *("pose_noise", "goal", "home", "goal_sampling", "goal_noise"),  # where episodes start and lead to
    *("episode_length", "end_when_lost"),  # where they are cut off
    *("gripper", "observations", "frame_stack"),  # features have it, or single images
    *("scene", "randomization"),  # by its bodies, by each range
    *("mesh_detail", "max_contacts", "auto_reset"),  # what there is room for, and no number or hardly a pixel
}


def test_every_option_is_compared_or_is_left_out_for_a_reason() -> None:
    every = {field.name for field in fields(FrankaConfig)} | {"urdf_path"}
    every |= {f"randomization.{field.name}" for field in fields(Randomization)}
    named = [*MEANING, *DYNAMICS, *VIEWS, *LOOKS, *NOT_COMPARED]
    assert sorted(named) == sorted(every)


def test_what_is_other_is_said_of_all_options_at_once() -> None:
    """Of a config as a run has it, with tuples and ranges in a dataclass."""
    now = vars(FrankaConfig(substeps=4, target_kd=(40.0,) * 7, randomization=Randomization(mass=0.1)))
    there = {"substeps": 16, "target_kd": 40.0, "randomization": {"mass": 0.0}, "solver": "mujoco", "fps": 30}
    assert [*told([{"config": {"env": there}}], now)] == [
        "recorded with env.substeps=16, env.randomization.mass=0.0, this run has 4, 0.1; "
        "what its actions do is as recorded"
    ]
    there = {"enable_shadows": True, "randomization": {"color": 0.2}}
    assert [*told([{"config": {"env": there}}], now)] == []
    assert [*told([{"config": {"env": there}}], now, looks=True)] == [
        "recorded with env.enable_shadows=true, env.randomization.color=0.2, this run has false, 0.0; "
        "its images look as recorded"
    ]


def test_other_masses_are_said_and_other_bodies_are_not() -> None:
    """These are refused where they are seen."""
    cube = {"name": "cube", "at": [0.5, 0.0]}
    now = {"task": "lift", "scene": {"objects": [cube]}}
    for change, lines in (({"mass": 1}, 1), ({"size": [0.06] * 3, "mass": 1}, 0), ({"turn": 1.0}, 0)):
        there = {"task": "lift", "scene": {"objects": [cube | change]}}
        said = [*told([{"config": {"env": there}}], now)]
        assert len(said) == lines and all("other masses or friction in env.scene" in line for line in said)


def test_a_recording_from_before_an_option_had_what_it_does_by_itself() -> None:
    now = {"task": "push", "disc_radius": 0.1, "disc_spread": 0.09}
    assert other_option([{"config": {"env": {"task": "push"}}}], now) == ("disc_spread", 0.0)
    assert other_option([{"config": {"env": now}}], now) is None
    assert other_option([{"config": {"env": now}}], {**now, "disc_radius": 0.05}) == ("disc_radius", 0.1)
    assert other_option([{}], now) is None, "nothing is known of how it was recorded"


def test_the_scene_of_a_task_that_is_not_known_here_is_not_compared() -> None:
    """The plugin that has it may be on another machine; of a known one other bodies are told apart."""
    env = {"task": "push", "scene": None}
    for task, other in (("hover", False), ("stack", True), ("push", False)):
        there = [{"config": {"env": {"task": task, "scene": None}}}]
        assert other_scene(there, env, images=False) is other


@pytest.mark.parametrize(
    "strange", ['{"sessions": [1]}', '{"sessions": [{"config": []}]}', '{"sessions": 1}']
)
def test_sessions_of_another_form_end_in_one_line(tmp_path: Path, strange: str) -> None:
    assert recorded_sessions(tmp_path) == []
    (tmp_path / PROVENANCE).parent.mkdir(parents=True)
    (tmp_path / PROVENANCE).write_text('{"sessions": null}')
    assert recorded_sessions(tmp_path) == []
    (tmp_path / PROVENANCE).write_text(strange)
    with pytest.raises(UserError, match="copy or download the dataset again"):
        recorded_sessions(tmp_path)
    (tmp_path / PROVENANCE).write_text('{"sessions": [{"config": {"env": {"task": "push"}}}, {}]}')
    assert recorded_tasks(recorded_sessions(tmp_path)) == {"push"}
