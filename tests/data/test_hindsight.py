"""Goals in hindsight: exact rewards, of the same episode, never from before the window or past what was written."""

import pytest
import torch
from tensordict import TensorDict

from franka_wm.data.hindsight import Hindsight, reached_later
from franka_wm.data.image_storage import OVERFLOW
from franka_wm.data.replay import make_replay
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.policies.expert import ExpertPolicy

CONFIG = FrankaConfig(
    observations=("state", "joint_target"), goal_sampling="reachable", episode_length=6, substeps=2
)


@pytest.fixture(scope="module")
def env() -> FrankaEnv:
    return FrankaEnv(CONFIG, num_envs=3, device="cpu", seed=5)


@pytest.fixture(scope="module")
def steps(env: FrankaEnv) -> TensorDict:
    """(worlds, time) of smooth enough motion over several episodes."""
    root, out = env.reset(), []
    for _ in range(20):
        step, root = env.step_and_maybe_reset(root.set("action", torch.rand(3, 7) * 2.4 - 1.2))
        out.append(step.clone())
    return torch.stack(out, 1)


def test_the_recorded_goal_gives_the_recorded_transition_again(env: FrankaEnv, steps: TensorDict) -> None:
    goal = steps["goal"]
    for t in range(steps.shape[1]):
        window = steps[:, t : t + 1]
        again = env.simulation.task.relabel(window, goal[:, t])
        assert set(again.keys(True, True)) >= {"state", "goal", ("next", "state"), ("next", "reward")}
        for key in again.keys(True, True):
            torch.testing.assert_close(again[key], window[key], atol=1e-6, rtol=0)


def test_another_goal_changes_reward_and_way_to_the_goal(env: FrankaEnv, steps: TensorDict) -> None:
    window, goal = steps[:, 3:5], torch.tensor([[0.4, 0.1, 0.3]]).expand(3, 3)
    again = env.simulation.task.relabel(window, goal)
    after = window["next", "state"]
    distance = (after[..., 14:17] - goal.unsqueeze(1)).norm(dim=-1, keepdim=True)
    effort = window["action"].clamp(-1, 1).square().mean(-1, keepdim=True)
    torch.testing.assert_close(again["next", "reward"], -distance.tanh() - 0.01 * effort)
    assert torch.equal(again["state"][..., :17], window["state"][..., :17])


def test_sparse_rewards_and_ends_follow_the_new_goal() -> None:
    config = FrankaConfig(
        observations=("state",),
        goal_sampling="reachable",
        episode_length=6,
        substeps=2,
        reward="sparse",
        terminate_on_success=True,
    )
    env = FrankaEnv(config, num_envs=3, device="cpu", seed=1)
    step, _ = env.step_and_maybe_reset(env.reset().set("action", torch.zeros(3, 7)))
    window, tool = step.unsqueeze(1), step["next", "state"][:, 14:17]
    assert not step["next", "success"].any()
    for goal, reached in ((tool + 0.02, True), (tool + 0.2, False)):
        again = env.simulation.task.relabel(window, goal)
        assert (again["next", "terminated"] == reached).all()
        torch.testing.assert_close(again["next", "reward"], torch.full((3, 1, 1), float(reached)))
    sparse = env.simulation.task.relabel(window, step["goal"])
    torch.testing.assert_close(sparse["next", "reward"], window["next", "reward"])
    assert torch.equal(sparse["next", "terminated"], window["next", "terminated"])


@pytest.mark.parametrize("name", ["push", "pick"])
@pytest.mark.parametrize("reward", ["dense", "sparse"])
def test_a_cube_is_judged_for_another_goal_as_the_simulator_does(name: str, reward: str) -> None:
    """Over an expert's episode: on its way, in contact, held, at the goal."""
    config = FrankaConfig(
        task=name,
        observations=("state", "joint_target", "objects"),
        substeps=4,
        action_scale=0.085,
        limit_velocity=True,
        gravity_compensation=True,
        pose_noise=0.02,
        episode_length=70,
        reward=reward,
        terminate_on_success=True,
    )
    env = FrankaEnv(config, num_envs=4, device="cpu", seed=2)
    task, policy = env.simulation.task, ExpertPolicy(env.simulation.task, env.kinematics, env.config)
    root, judged, solved = env.reset(), 0, 0
    # Twice as far is no success; a goal of push keeps the height of a lying cube, whatever is asked for.
    away, up = (0.06, 0.01) if name == "push" else (0.02, 0.003)
    for t in range(65):
        root = policy(root)
        state = env.get_state()
        step = env.step(root)
        window = step.unsqueeze(1)
        same = task.relabel(window, root["goal"])
        torch.testing.assert_close(same["next", "reward"], window["next", "reward"], atol=1e-5, rtol=0)
        if t % 8 == 7:  # the same step with the goal near where the cube is
            goal = step["next", "objects"][:, :3] + torch.tensor([away, 0.0, up]) * (t % 3)
            again = env.set_state(state)
            env.set_goal(goal)
            other = env.step(again.set("action", root["action"]))["next"]
            there = task.relabel(window, goal)["next"]
            torch.testing.assert_close(there["reward"][:, 0], other["reward"], atol=1e-5, rtol=0)
            assert torch.equal(there["terminated"][:, 0], other["success"])
            torch.testing.assert_close(there["state"][:, 0], other["state"], atol=1e-4, rtol=0)
            judged, solved = judged + 1, solved + int(other["success"].sum())
            env.set_state(state)
            step = env.step(root)
        root = step["next"].exclude("reward")
    assert judged == 8 and 0 < solved < 32


def numbered(worlds: int, steps: int, first: int, length: int) -> TensorDict:
    """Steps whose state is (time, world, episode, …), in episodes of so many steps."""
    time = torch.arange(first, first + steps).expand(worlds, steps)
    state = torch.zeros(worlds, steps, 20)
    state[..., 0], state[..., 1] = time, torch.arange(worlds).unsqueeze(1)
    state[..., 2] = time // length
    flags = (time % length == 0).unsqueeze(-1)
    after = {"state": state, "reward": torch.zeros(worlds, steps, 1)}
    return TensorDict({"state": state, "is_init": flags, "next": after}, [worlds, steps])


@pytest.mark.parametrize(
    "written", [9, 23, 40]
)  # not full, wrapped around within an episode, and more than once
def test_goals_are_of_the_same_episode_and_lie_ahead(written: int) -> None:
    seen = []

    def relabel(batch: TensorDict, goal: torch.Tensor) -> TensorDict:
        last = batch["next", "state"][:, -1, :3]
        assert torch.equal(goal[:, 1:], last[:, 1:])  # world and episode
        ahead = goal[:, 0] - last[:, 0]
        assert ahead.min() >= 0
        assert goal[:, 0].max() < written
        seen.append(torch.stack([last[:, 0] % 7, ahead]))
        return TensorDict({("next", "reward"): torch.ones_like(batch["next", "reward"])}, batch.batch_size)

    replay = make_replay(
        capacity=4 * 16,
        num_envs=4,
        window=2,
        batch_size=256,
        device="cpu",
        hindsight=Hindsight(
            relabel, achieved=("state", slice(0, 3)), reads=("state",), share=0.25, episode_length=7
        ),
    )
    for first in range(0, written, 3):
        replay.extend(numbered(4, min(3, written - first), first, 7))
    torch.manual_seed(0)
    shares = [replay.sample()["next", "reward"].mean() for _ in range(20)]
    assert abs(float(torch.stack(shares).mean()) - 0.25) < 0.03
    at, ahead = torch.cat(seen, 1)
    if written > 16:  # every step up to the episode's end is chosen equally often
        counts = torch.bincount(ahead[at == 1].long(), minlength=6).float()
        assert counts[6:].sum() == 0
        assert counts.min() > 20


def test_a_goal_of_the_newest_step_is_found_and_none_past_it() -> None:
    goals = []
    replay = make_replay(
        capacity=2 * 32,
        num_envs=2,
        window=1,
        batch_size=64,
        device="cpu",
        hindsight=Hindsight(
            lambda batch, goal: (goals.append(goal), TensorDict({}, batch.batch_size))[1],
            achieved=("state", slice(0, 3)),
            reads=("state",),
            share=1.0,
            episode_length=50,
        ),
    )
    replay.extend(numbered(2, 5, 0, 50))
    for _ in range(10):
        replay.sample()
    assert torch.cat(goals)[:, 0].max() == 4


def test_what_a_step_with_lost_contacts_led_to_is_no_goal() -> None:
    """It is the last of its episode."""
    data = numbered(2, 12, 0, 6)
    lost = torch.zeros(2, 12, 1, dtype=torch.bool)
    lost[0, 5] = lost[1, 11] = True
    data.set(OVERFLOW, lost)
    starts, worlds = torch.tensor([[0], [6], [0], [6]]), torch.tensor([[0], [0], [1], [1]])
    found = [reached_later(data.transpose(0, 1), starts, worlds, 11, most=6)[0] for _ in range(200)]
    assert [one.unique().tolist() for one in torch.stack(found, 1)] == [
        [0, 1, 2, 3, 4], [6, 7, 8, 9, 10, 11], [0, 1, 2, 3, 4, 5], [6, 7, 8, 9, 10],
    ]  # fmt: skip
