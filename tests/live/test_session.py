"""A live session without a browser: what its controls do to the arm."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from unittest.mock import Mock

import av
import numpy as np
import pytest
import torch

from franka_wm.errors import UserError
from franka_wm.live.frame import Frame
from franka_wm.live.session import Session
from franka_wm.planning.mcts import MCTS
from franka_wm.policies.search import SearchPolicy

LEFT, RIGHT = (0.40, 0.25, 0.45), (0.40, -0.25, 0.45)


def play(session: Session, steps: int) -> Frame:
    frames = [session.step() for _ in range(steps)]
    return frames[-1]


def test_the_tool_follows_a_goal_that_is_dragged(make_session) -> None:
    session = make_session(policy="ik")
    for goal in (LEFT, RIGHT, LEFT):
        moved = session.set_goal(goal)
        np.testing.assert_allclose(moved.goal, goal, atol=1e-6)
        assert moved.distance > 0.1, "the goal must have been moved away from the tool"
        frame = play(session, 40)
        np.testing.assert_allclose(frame.tool, goal, atol=0.02)
        assert frame.distance < 0.02
        assert frame.success


def test_the_planner_follows_it_too_and_shows_where_it_is_going(make_session) -> None:
    torch.manual_seed(0)
    session = make_session(policy="planner")
    session.set_goal(RIGHT)
    start = session.frame()
    frame = session.step()
    assert frame.path is not None
    assert frame.path.shape == (session.planner.horizon + 1, 3)
    ahead = np.linalg.norm(frame.path[-1] - np.array(RIGHT))
    assert ahead < 0.8 * np.linalg.norm(start.tool - np.array(RIGHT)), "the path leads towards the goal"
    assert np.linalg.norm(play(session, 30).tool - np.array(RIGHT)) < 0.05


def test_doing_nothing_ignores_the_goal(make_session) -> None:
    session = make_session(policy="noop")
    before = session.frame().tool
    session.set_goal(RIGHT)
    frame = play(session, 20)
    np.testing.assert_allclose(frame.tool, before, atol=0.02)
    assert frame.distance == pytest.approx(float(np.linalg.norm(frame.tool - np.array(RIGHT))), abs=1e-5)


def test_a_policy_of_any_name_may_be_the_only_one(make_session) -> None:
    session = make_session()
    only = Session(session.env, {"mine": session.policies["noop"]})
    assert only.step().policy == "mine"


def test_another_policy_acts_at_once_and_plans_are_dropped(make_session) -> None:
    session = make_session(policy="planner")
    assert play(session, 2).path is not None
    frame = session.set_policy("noop")
    assert frame.policy == "noop"
    assert frame.path is None
    frame = session.step()
    assert frame.path is None
    targets = session.arm.joint_targets()
    session.step()
    assert torch.equal(session.arm.joint_targets(), targets), "doing nothing commands nothing"
    session.set_policy("planner")
    assert session.step().path is not None
    with pytest.raises(UserError, match="policy='fly': choose from planner, ik, random, noop"):
        session.set_policy("fly")
    assert session.policy == "planner"


def test_settings_rebuild_the_planner_between_two_steps(make_session) -> None:
    session = make_session(policy="planner")
    session.step()
    before = session.planner
    assert {s.name: s.value for s in session.settings} == {
        "horizon": 6, "num_samples": 128, "iterations": 3, "temperature": 2.0,
    }  # fmt: skip
    session.set_planner(horizon=3, num_samples=32, temperature=1.0)
    assert session.planner is not before
    assert (session.planner.horizon, session.planner.num_samples, session.planner.iterations) == (3, 32, 3)
    assert before.horizon == 6
    assert session.step().path.shape == (4, 3)  # and the plan of 6 steps was not carried over


def test_a_setting_that_cannot_be_leaves_the_planner_as_it_is(make_session) -> None:
    session = make_session(policy="planner")
    before = session.planner
    with pytest.raises(UserError, match="num_elites=200: must be at most num_samples"):
        session.set_planner(num_elites=200)
    with pytest.raises(UserError, match="MPPI has no setting 'sharpness'"):
        session.set_planner(sharpness=1.0)
    assert session.planner is before
    del session.policies["planner"]
    with pytest.raises(UserError, match="no planner"):
        session.set_planner(horizon=2)
    assert session.settings == []


def test_a_new_episode_has_another_pose_and_goal(make_session) -> None:
    session = make_session(policy="ik")
    first = play(session, 5)
    frame = session.reset()
    assert frame.episode == first.episode + 1
    assert not np.allclose(frame.goal, first.goal)
    assert frame.reward == 0.0


def test_a_goal_set_by_hand_outlives_the_episode_only_if_asked(make_session) -> None:
    session = make_session(policy="ik")
    session.set_goal(LEFT)
    assert not np.allclose(session.reset().goal, LEFT)
    session.keep_goal = True
    session.set_goal(LEFT)
    np.testing.assert_allclose(session.reset().goal, LEFT, atol=1e-6)
    np.testing.assert_allclose(play(session, 50).tool, LEFT, atol=0.02)


def test_a_moving_goal_that_is_dragged_into_the_ground_stays_above(make_session) -> None:
    session = make_session(policy="noop", task="track")
    np.testing.assert_allclose(session.set_goal((0.4, 0.0, -0.1)).goal, (0.4, 0.0, 0.05))


def test_episodes_that_end_by_themselves_go_on_with_the_kept_goal(make_session) -> None:
    session = make_session(policy="ik", keep_goal=True, episode_length=3)
    session.set_goal(LEFT)
    frames = [session.step() for _ in range(7)]
    assert [f.episode for f in frames] == [0, 0, 1, 1, 1, 2, 2]
    for frame in frames:
        np.testing.assert_allclose(frame.goal, LEFT, atol=1e-6)


def test_reward_and_distance_are_the_environments(make_session) -> None:
    session = make_session(policy="random")
    session.set_goal(RIGHT)
    frame = play(session, 3)
    arm = session.arm
    assert frame.distance == pytest.approx(float(arm.goal_distance()[0]), abs=1e-6)
    assert frame.reward == pytest.approx(float(arm.simulation.tensors.reward[0]), abs=1e-6)
    np.testing.assert_allclose(frame.bodies[:, :3], arm.body_positions()[0], atol=1e-6)


def test_the_thread_steps_while_playing_and_rests_while_paused(make_session) -> None:
    session = make_session(policy="ik")
    session.step()  # compiles
    seen: list[Frame] = []
    enough = threading.Event()

    def listen(frame: Frame) -> None:
        seen.append(frame)
        if len(seen) >= 5:
            enough.set()

    session.listen(listen)
    session.start()
    try:
        time.sleep(0.2)
        assert not seen, "it must not step before it is told to play"
        session.play()
        assert enough.wait(20)
        session.pause()
        count, deadline = -1, time.monotonic() + 20
        while count != len(seen) and time.monotonic() < deadline:  # the step that is under way
            count = len(seen)
            time.sleep(0.3)
        time.sleep(0.3)
        assert len(seen) == count
        session.ask_goal(LEFT)  # also while it rests
        deadline = time.monotonic() + 20
        while not np.allclose(session.goal, LEFT, atol=1e-6) and time.monotonic() < deadline:
            time.sleep(0.02)
        np.testing.assert_allclose(session.goal, LEFT, atol=1e-6)
        assert session.frame().steps == seen[-1].steps
    finally:
        session.stop()
    assert session.error is None
    assert [f.steps for f in seen if f.stepped] == list(range(2, 2 + sum(f.stepped for f in seen)))


def test_time_runs_no_faster_than_the_environment(make_session) -> None:
    session = make_session(policy="noop")
    session.step()
    session.speed = 0.5
    steps = session.frame().steps
    began = time.monotonic()
    session.start()
    session.play()
    while session.frame().steps < steps + 8 and time.monotonic() < began + 20:
        time.sleep(0.02)
    session.stop()
    elapsed = time.monotonic() - began  # on a busy machine more than what was slept
    assert 8 <= session.frame().steps - steps <= 0.5 * session.arm.config.fps * elapsed + 2


def test_what_breaks_in_the_thread_is_kept_and_stops_it(make_session) -> None:
    session = make_session(policy="noop")

    def broken(_tensordict):
        raise RuntimeError("broken policy")

    session.policies["noop"] = broken
    session.start()
    session.play()
    deadline = time.monotonic() + 20
    while session.error is None and time.monotonic() < deadline:
        time.sleep(0.02)
    session.stop()
    assert str(session.error) == "broken policy"
    assert not session.playing


def test_a_recording_is_a_video_with_a_picture_for_every_step(make_session, tmp_path: Path) -> None:
    session = make_session(policy="ik")
    session.set_goal(RIGHT)
    assert session.step().recording is None
    session.start_recording(size=64)
    assert play(session, 6).recording == 6
    path = session.stop_recording(tmp_path / "live.mp4")
    with av.open(str(path)) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        assert float(video.streams.video[0].average_rate) == session.arm.config.fps
    assert len(frames) == 6
    assert frames[0].shape == (64, 64, 3)
    assert not np.array_equal(frames[0], frames[-1]), "the arm moves"
    assert not session.recording
    with pytest.raises(UserError, match="nothing is being recorded"):
        session.stop_recording(tmp_path / "again.mp4")


def test_a_recording_stops_growing_and_an_empty_one_is_not_written(make_session, tmp_path: Path) -> None:
    session = make_session(policy="noop")
    session.start_recording(size=32, most=2)
    assert play(session, 4).recording == 2
    session.start_recording(size=32)
    with pytest.raises(UserError, match="nothing was recorded"):
        session.stop_recording(tmp_path / "empty.mp4")
    assert not list(tmp_path.iterdir())


def test_one_world_only(small_env) -> None:
    with pytest.raises(UserError, match="one world, the environment has 2"):
        Session(small_env(2), {"noop": lambda t: t})


@pytest.mark.slow
def test_a_recording_can_be_a_dataset_of_what_happened(make_session, tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    session = make_session(policy="ik", observations=("pixels", "state", "joint_target"), image_size=16)
    session.step()
    session.start_recording("dataset")
    seen = [session.step() for _ in range(3)]
    session.set_goal(RIGHT)
    seen += [session.step() for _ in range(2)]
    session.reset()  # in the middle: what follows is another episode
    seen += [session.step() for _ in range(4)]
    assert seen[-1].recording == 9
    path = session.stop_recording(tmp_path / "live")
    data = LeRobotDataset("local/live", root=path)
    assert (data.num_episodes, data.num_frames, data.fps) == (2, 9, 30)
    rows = [data[i] for i in range(9)]
    assert [int(row["episode_index"]) for row in rows] == [0] * 5 + [1] * 4
    assert [bool(row["next.truncated"]) for row in rows] == [False] * 4 + [True] + [False] * 3 + [True]
    assert [bool(row["next.done"]) for row in rows] == [bool(row["next.truncated"]) for row in rows]
    rewards = [float(row["next.reward"]) for row in rows]
    np.testing.assert_allclose(rewards, [frame.reward for frame in seen], atol=1e-6)
    goals = np.stack([row["observation.environment_state"].numpy() for row in rows])
    np.testing.assert_allclose(goals[3:5], [RIGHT, RIGHT], atol=1e-6)
    assert not np.allclose(goals[2], RIGHT)
    np.testing.assert_allclose(rows[1]["tool_position"].numpy(), seen[0].tool, atol=1e-6)


def test_what_has_no_place_in_a_dataset_is_said_at_the_start(make_session) -> None:
    session = make_session(policy="noop", observations=("depth", "state", "joint_target"), image_size=16)
    with pytest.raises(UserError, match="depth has no place in a LeRobot dataset"):
        session.start_recording("dataset")
    assert not session.recording


def test_a_tree_search_has_its_settings(make_session) -> None:
    session = make_session()
    search = MCTS(num_actions=3, num_simulations=16, max_depth=4)
    session.policies["planner"] = policy = SearchPolicy(
        search, encode=torch.zeros_like, prediction=Mock(), recurrent=Mock(), observation_keys=["state"]
    )
    assert "num_simulations" in [one.name for one in session.settings]
    session.set_planner(num_simulations=8)
    assert policy.search.num_simulations == session.planner.num_simulations == 8
