"""A dataset holds what one environment gives: what is added was recorded in the same one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from franka_wm.data.lerobot.provenance import describe
from franka_wm.data.lerobot.schema import Schema
from franka_wm.data.lerobot.writer import DatasetWriter
from franka_wm.errors import UserError


@pytest.fixture
def added(tmp_path: Path, make_episode):
    """Adds an episode of an environment to ``set``; none is finished, but they are there."""

    def add(schema: Schema, **env: Any) -> int:
        provenance = describe(policy="p", seed=1, config={"env": env})
        with DatasetWriter(
            tmp_path / "set", schema, provenance=provenance, workers=0, shard_frames=1, resume=True
        ) as writer:
            writer.add([make_episode(schema, writer.resumed)])
            return writer.resumed

    return add


@pytest.mark.parametrize(
    ("there", "here", "says"),
    [
        ({"substeps": 4}, {"substeps": 2}, r"env\.substeps=4, this has 2"),
        (
            {"target_ke": 800.0},
            {"target_ke": [800.0] * 6 + [400.0]},
            r"env\.target_ke=800\.0, this has \[800\.0, .* 400\.0\]",
        ),
        ({"limit_velocity": False}, {"limit_velocity": True}, r"env\.limit_velocity=false, this has true"),
        ({"solver": "auto"}, {"solver": "featherstone"}, r"env\.solver=auto, this has featherstone"),
        ({"drawer_opening": 0.1}, {"drawer_opening": None}, r"env\.drawer_opening=0\.1, this has null"),
        (
            {"randomization": {"gains": 0.0, "mass": 0.1}},
            {"randomization": {"gains": 0.2, "mass": 0.1}},
            r"env\.randomization\.gains=0\.0, this has 0\.2",
        ),
    ],
)
def test_other_physics_is_not_mixed(added, make_schema, there: dict, here: dict, says: str) -> None:
    """Gains of one number and of seven, and names of one solver, are the same; so is what was not recorded."""
    schema = make_schema(observations=("state",))
    added(schema, task="reach", **there)
    with pytest.raises(UserError, match=rf"set: what is there was recorded with {says}; give the same"):
        added(schema, task="reach", **here)
    assert added(schema, task="reach") == 1
    same = {"target_ke": [800.0] * 7, "solver": "mujoco"}
    assert added(schema, task="reach", **there | {key: same[key] for key in same if key in there}) == 2


def test_images_that_look_otherwise_are_not_mixed(added, make_schema) -> None:
    added(make_schema(), enable_shadows=False, randomization={"color": 0.0})
    for other in ({"enable_shadows": True}, {"randomization": {"color": 0.1}}):
        with pytest.raises(UserError, match=r"recorded with env\.\S+=\S+, this has"):
            added(make_schema(), **other)


def test_another_camera_is_named_before_its_feature(added, make_schema) -> None:
    added(make_schema(), cameras=["front"])
    with pytest.raises(UserError, match=r"env\.cameras=\['front'\], this has \['wrist'\]"):
        added(make_schema(cameras=("wrist",)), cameras=["wrist"])


def test_where_no_image_is_its_looks_do_not_count(added, make_schema) -> None:
    added(make_schema(observations=("state",)), enable_shadows=False)
    assert added(make_schema(observations=("state",)), enable_shadows=True) == 1


def test_another_task_is_said_before_what_follows_from_it(added, make_schema) -> None:
    added(make_schema(task="push", observations=("state", "objects")), task="push", fps=30, substeps=4)
    with pytest.raises(UserError, match=r"recorded with env\.task=push, this has reach; give the same"):
        added(make_schema(observations=("state",)), task="reach", fps=20, substeps=2)
    with pytest.raises(UserError, match=r"recorded with env\.fps=30, this has 20; give the same"):
        added(make_schema(task="push", observations=("state", "objects"), fps=20), task="push", fps=20)


def test_other_features_are_named_with_both(added, make_schema) -> None:
    """Also where nothing tells of the environment."""
    added(make_schema())
    for schema, says in (
        (make_schema(fps=20.0), "has fps=30, this has 20; give"),
        (
            make_schema("video"),
            r"has features\.observation\.images\.front\.dtype=image, this has video; give",
        ),
        (make_schema(observations=("state",)), r"images\.front=image \[16, 16, 3\], this has none; give"),
    ):
        with pytest.raises(UserError, match=says):
            added(schema)
