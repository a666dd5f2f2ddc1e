"""A dataset that is recorded on the live page: what it says of its robot, and how much of it is kept."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest
from torchrl.envs import RewardSum, StepCounter, TransformedEnv

from franka_wm.data.lerobot.episodes import UNKNOWN_EPISODE
from franka_wm.data.lerobot.provenance import recorded_sessions
from franka_wm.data.lerobot.schema import SEED
from franka_wm.envs import FrankaConfig, FrankaEnv, robots
from franka_wm.live import recorder
from franka_wm.live.recorder import DatasetRecorder
from franka_wm.live.session import Session
from franka_wm.policies.scripted import NoopPolicy

URDF = Path(robots.__file__).with_name("fr3.urdf")


def test_it_says_of_which_robot_it_is(tmp_path: Path) -> None:
    config = FrankaConfig(robot="urdf", observations=("state", "joint_target"))
    env = FrankaEnv(config, num_envs=1, device="cpu", seed=0, urdf_path=URDF)
    session = Session(env, {"noop": NoopPolicy(env.action_dim)}, seed=5)
    session.start_recording("dataset")
    for _ in range(2):
        session.step()
        session.reset()
    root = session.stop_recording(tmp_path / "own")
    (said,) = recorded_sessions(root)
    assert said["config"]["env"]["urdf_path"] == str(URDF) and said["config"]["env"]["robot"] == "urdf"
    (file,) = root.glob("data/**/*.parquet")
    assert pq.read_table(file)[SEED].to_pylist() == [[5, 0, UNKNOWN_EPISODE]] * 2


def test_without_a_robot_of_ones_own_it_says_that(make_session, tmp_path: Path) -> None:
    session = make_session(policy="noop")
    session.start_recording("dataset")
    session.step()
    (said,) = recorded_sessions(session.stop_recording(tmp_path / "plain"))
    assert said["config"]["env"]["urdf_path"] is None


def test_it_is_full_when_its_steps_fill_the_memory(make_session, monkeypatch: pytest.MonkeyPatch) -> None:
    small = make_session(policy="noop")
    large = make_session(policy="noop", observations=("pixels", "state", "joint_target"), image_size=32)
    monkeypatch.setattr(recorder, "MEMORY", 7 * 32 * 32 * 3)  # a step has two images, and vectors
    for session, most, kept in ((large, 20_000, 3), (large, 2, 2), (small, 20_000, 5)):
        session.start_recording("dataset", most=most)
        assert [session.step().recording for _ in range(5)] == [min(k, kept) for k in range(1, 6)]
    monkeypatch.setattr(recorder, "MEMORY", 1)  # a step that is too large by itself is kept
    small.start_recording("dataset")
    assert [session.step().recording for _ in range(2)] == [1, 1]


def test_the_arm_is_found_under_several_transforms(make_session) -> None:
    env = make_session(policy="noop").env
    many = TransformedEnv(TransformedEnv(env, StepCounter()), RewardSum(), auto_unwrap=False)
    session = Session(many, {"noop": NoopPolicy(env.action_dim)})
    assert session.arm is env and DatasetRecorder(many).arm is env
