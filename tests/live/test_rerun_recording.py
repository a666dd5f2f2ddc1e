"""A recording for the Rerun viewer, read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from franka_wm.errors import UserError
from franka_wm.live.commanded import kinematic_planner
from franka_wm.live.rerun_recording import record_episode
from franka_wm.policies.scripted import IKPolicy

rr = pytest.importorskip("rerun", reason="needs the extra rerun")


def read(path: Path) -> list:
    """The recording's pieces."""
    from rerun.experimental import RrdReader

    return list(RrdReader(path).store().stream())


def column(chunks: list, entity: str, part: str) -> list:
    """The values of one component of an entity, in the order of the steps that it was logged in."""
    rows = []
    for chunk in chunks:
        if str(chunk.entity_path) == entity and not chunk.is_static:
            table = chunk.to_record_batch()
            name = next(n for n in table.schema.names if part in n)
            rows += zip(table["step"].to_pylist(), table[name].to_pylist(), strict=True)
    rows.sort(key=lambda row: row[0])
    assert [step for step, _ in rows] == list(range(len(rows)))
    return [value for _, value in rows]


def test_an_episode_reads_back(small_env, tmp_path: Path) -> None:
    env = small_env(
        1, goal_sampling="reachable", observations=("pixels", "state", "joint_target"), image_size=16
    )
    policies = {"planner": kinematic_planner(env), "ik": IKPolicy(env.kinematics, env.config)}
    path = record_episode(env, policies, tmp_path / "a" / "episode.rrd", policy="planner", steps=6, seed=3)
    assert [file.name for file in path.parent.iterdir()] == ["episode.rrd"]
    recording = read(path)
    distance = np.array(column(recording, "/distance", "Scalars")).ravel()
    assert len(distance) == 7, "the start and six steps"
    assert distance[-1] < distance[0]
    assert np.isclose(distance[-1], float(env.goal_distance()[0]), atol=1e-6)
    tool = np.array(column(recording, "/tool", "positions")).reshape(-1, 3)
    goal = np.array(column(recording, "/goal", "positions")).reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(tool - goal, axis=1), distance, atol=1e-6)
    plans = column(recording, "/plan", "strips")
    assert [len(strips) for strips in plans] == [0, 1, 1, 1, 1, 1, 1], "no plan before the first decision"
    assert np.array(plans[1]).shape == (1, 7, 3)
    entities = {str(chunk.entity_path) for chunk in recording}
    assert {"/camera", "/reward", "/joints/1", "/arm/link7", "/trail"} <= entities
    assert sum("/arm/base/" in e for e in entities) == 2, "the base's two shapes"


def test_bad_names_are_one_line(small_env, tmp_path: Path) -> None:
    env = small_env(1)
    policies = {"ik": IKPolicy(env.kinematics, env.config)}
    with pytest.raises(UserError, match=r"must end in \.rrd"):
        record_episode(env, policies, tmp_path / "episode.bin")
    with pytest.raises(UserError, match="policy='planner': choose from ik; that one needs a checkpoint"):
        record_episode(env, policies, tmp_path / "episode.rrd", policy="planner")
    assert not list(tmp_path.iterdir())
