"""The task in torch that docs/tasks.md prints: through steps, resets, states, goals by hand and hindsight."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from franka_wm.envs import FrankaConfig, FrankaEnv, TransformedFrankaEnv, tasks
from franka_wm.envs.tasks import Reach, Task, TorchTask
from franka_wm.errors import UserError

N, LENGTH = 4, 6
SMALL = {"substeps": 2, "gravity_compensation": True, "observations": ("state",), "episode_length": LENGTH}


@pytest.fixture(scope="module")
def box(printed_class) -> type[TorchTask]:
    """The printed class."""
    return printed_class("Box(TorchTask)", lines=40)


@pytest.fixture(scope="module")
def make(box: type[TorchTask]) -> Callable[..., FrankaEnv]:
    """An environment of the printed class."""

    def of(num_envs: int = N, *, seed: int = 0, task: type[Task] = box, **changes: Any) -> FrankaEnv:
        config = FrankaConfig(**(SMALL | changes))
        return FrankaEnv(config, num_envs=num_envs, device="cpu", seed=seed, task=task(config))

    return of


def play(env: Any, actions: torch.Tensor, root: TensorDictBase) -> TensorDictBase:
    steps = []
    for action in actions.unbind(1):
        step, root = env.step_and_maybe_reset(root.clone().set("action", action))
        steps.append(step.clone())
    return torch.stack(steps, 1)


def check(env: FrankaEnv, data: TensorDictBase) -> None:
    """Rewards, successes and ends are the task's own; goals are those of seed, world and episode."""
    task, after = env.simulation.task, data["next"]
    assert isinstance(task, TorchTask)
    expected = task.reward(after["state"], data["action"].clamp(-1, 1)).unsqueeze(-1)
    torch.testing.assert_close(after["reward"], expected)
    assert torch.equal(after["success"].squeeze(-1), task.success(after["state"]))
    assert torch.equal(after["terminated"], after["success"])
    for part in (data, after):
        torch.testing.assert_close(part["state"][..., 14:17] - part["state"][..., 17:20], part["goal"])
    begun = data["is_init"].squeeze(-1)
    moved = (data["goal"][:, 1:] != data["goal"][:, :-1]).any(-1)
    assert torch.equal(moved, begun[:, 1:]), "a goal changes where an episode begins, and only there"
    assert torch.equal(after["goal"], data["goal"])
    goals = data["goal"][begun]
    low, high = torch.tensor([0.3, -0.25, 0.3]), torch.tensor([0.5, 0.25, 0.7])
    assert ((goals >= low) & (goals <= high)).all()
    assert goals.unique(dim=0).shape == goals.shape


@pytest.mark.parametrize("auto_reset", ["native", "standard"])
@pytest.mark.parametrize("wrapped", [False, True])
def test_steps_and_resets(make, box, random_actions, auto_reset: str, wrapped: bool, monkeypatch) -> None:
    """Over ends of single worlds by success and of all by time; every way to reset gives the same numbers."""
    monkeypatch.setattr(box, "success", lambda self, state: state[..., 17:20].norm(dim=-1) < 0.2)
    env = make(auto_reset=auto_reset, terminate_on_success=True)
    stepped = TransformedFrankaEnv(env) if wrapped else env
    actions = 2 * random_actions(N, 3 * LENGTH)
    data = play(stepped, actions, stepped.reset(seed=1))
    check(env, data)
    assert data["next", "terminated"].any() and data["next", "truncated"].any()
    assert data["next", "done"].any(0).sum() > data["next", "done"].all(0).sum(), "some worlds end alone"
    assert env.statistics()["episodes"] == data["next", "done"].sum()
    # By hand: step, and a reset by mask where a world is done.
    other = make(terminate_on_success=True)
    root = other.reset(seed=1)
    for t, action in enumerate(actions.unbind(1)):
        step = other.step(root.set("action", action))["next"]
        for key in ("state", "goal", "reward", "success", "done"):
            assert torch.equal(step[key], data["next", key][:, t]), (key, t)
        root = other.reset(step.set("_reset", step["done"])) if step["done"].any() else step


def test_world_k_has_the_same_episodes_whatever_n_is(make, random_actions) -> None:
    played = [play(env, random_actions(n, 13), env.reset(seed=5)) for n in (2, 5) for env in (make(n),)]
    for key in ("goal", "state", "reward", "done"):
        assert torch.equal(played[0]["next", key], played[1]["next", key][:2]), key


def test_states_go_in_and_out(make, random_actions) -> None:
    """Into another environment, with another seed, over the end of the episode."""
    env, other = make(), make(seed=9)
    play(env, random_actions(N, 8), env.reset(seed=2))
    state = env.get_state()
    assert state["draws"].shape == (N, 8)
    future = [play(one, random_actions(N, 8, seed=1), one.set_state(state)) for one in (env, other)]
    assert future[0]["next", "done"].any()
    for key in ("state", "goal", "reward"):
        assert torch.equal(future[0]["next", key], future[1]["next", key]), key


def test_a_goal_set_by_hand_lasts_for_the_episode(make) -> None:
    env, other = make(), make()
    drawn, _ = env.reset(seed=3)["goal"], other.reset(seed=3)
    goals = drawn + torch.tensor([0.05, -0.1, 0.02])
    root, untouched = env.set_goal(goals), other.reset(seed=3)
    actions = torch.zeros(N, LENGTH + 1, 7)
    data, expected = play(env, actions, root), play(other, actions, untouched)
    assert torch.equal(data["next", "goal"][:, :LENGTH], goals.unsqueeze(1).expand(N, LENGTH, 3))
    reward = env.simulation.task.reward(data["next", "state"], actions)
    torch.testing.assert_close(data["next", "reward"].squeeze(-1), reward)
    assert torch.equal(data["goal"][:, LENGTH], expected["goal"][:, LENGTH])


def test_a_masked_reset_changes_no_other_goal(make) -> None:
    env = make()
    root = env.reset(seed=4)
    mask = torch.tensor([[False], [True], [False], [True]])
    after = env.reset(root.clone().set("_reset", mask))
    assert torch.equal((after["goal"] != root["goal"]).any(-1), mask.squeeze(-1))


def test_relabeled_transitions_are_those_of_another_goal(make, random_actions) -> None:
    """What was recorded, relabeled, is what a world with that goal gave for the same actions."""
    env, actions = make(), random_actions(N, LENGTH - 1)
    goal = torch.tensor([0.4, 0.1, 0.5]).expand(N, 3)
    data = play(env, actions, env.reset(seed=6))
    env.reset(seed=6)
    expected = play(env, actions, env.set_goal(goal))
    assert type(env.simulation.task).relabels()
    got = env.simulation.task.relabel(data, goal)
    for key in (
        "state",
        "goal",
        ("next", "state"),
        ("next", "goal"),
        ("next", "reward"),
        ("next", "terminated"),
    ):
        torch.testing.assert_close(got[key], expected[key])


def test_goal_images_show_the_drawn_goals(make) -> None:
    env = make(2, observations=("state", "goal_pixels"), image_size=16)
    first = env.reset(seed=7)
    reached = env.kinematics.forward(env.simulation.tensors.goal_q)
    torch.testing.assert_close(reached, first["goal"], rtol=0, atol=5e-3)
    assert (first["goal_pixels"][0] != first["goal_pixels"][1]).any()


def test_a_broken_world_emits_no_nan(make) -> None:
    env = make()
    action = torch.zeros(N, 7)
    action[1, 2] = float("nan")
    after = env.step(env.reset(seed=0).set("action", action))["next"]
    assert after["truncated"].squeeze(-1).tolist() == [False, True, False, False]
    assert all(torch.isfinite(value.float()).all() for value in after.values(True, True))


def test_the_reward_of_the_present(make) -> None:
    env = make()
    state = env.reset(seed=0)["state"]
    got = env.reward(torch.zeros(N, 7))
    torch.testing.assert_close(got, -state[:, 17:20].norm(dim=-1, keepdim=True))


class Wrong(TorchTask):
    def goal(self, draws: torch.Tensor) -> torch.Tensor:
        return draws[:, :3]

    def reward(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return -state[..., 17:20].norm(dim=-1)

    def success(self, state: torch.Tensor) -> torch.Tensor:
        return state[..., 16] > 0.5


class WrongGoal(Wrong):
    def goal(self, draws: torch.Tensor) -> torch.Tensor:
        return draws


class WrongReward(Wrong):
    def reward(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return state[..., 16:17]


class WrongSuccess(Wrong):
    def success(self, state: torch.Tensor) -> torch.Tensor:
        return state[..., 16]


@pytest.mark.parametrize("task", [WrongGoal, WrongReward, WrongSuccess])
def test_a_function_of_another_shape_or_type_is_one_line(make, task: type[Task]) -> None:
    env = make(task=task)
    with pytest.raises(
        UserError, match=rf"{task.__name__}\.{task.__name__[5:].lower()} gave .* must give"
    ) as caught:
        env.step(env.reset().set("action", torch.zeros(N, 7)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["goal", "reward", "success"])
@pytest.mark.parametrize("given", [None, 1.0], ids=["nothing", "a number"])
def test_a_function_that_gives_no_tensor_is_one_line(make, name: str, given: float | None) -> None:
    task = type("Wrong", (Wrong,), {name: lambda self, *_: given})
    said = rf"^Wrong\.{name} gave {type(given).__name__}, not a tensor; for 4 worlds it must give \(4,"
    with pytest.raises(UserError, match=said):
        env = make(task=task)
        env.step(env.reset().set("action", torch.zeros(N, 7)))


def test_an_error_inside_a_function_is_the_tasks_own(make) -> None:
    task = type("Wrong", (Wrong,), {"reward": lambda self, state, action: state[..., 99]})
    env = make(task=task)
    with pytest.raises(IndexError):
        env.step(env.reset().set("action", torch.zeros(N, 7)))


def test_a_constructor_that_a_run_cannot_call_is_refused_by_register() -> None:
    def wants_more(self, config: FrankaConfig, more: int) -> None: ...

    said = r"register\('mine', Mine\): Mine\(config\) builds it, .*\(missing a required argument: 'more'\)"
    with pytest.raises(UserError, match=said):
        tasks.register("mine", type("Mine", (Wrong,), {"__init__": wants_more}))


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("num_draws", "8", "a whole number of at least 0"),
        ("reward_bounds", 3, "the least and the largest reward of a step"),
        ("reward_bounds", (0.0, -1.0), "the least and the largest reward of a step"),
        ("reward_bounds", ("a", "b"), "the least and the largest reward of a step"),
    ],
)
def test_a_class_attribute_of_another_kind_is_one_line(name: str, value: object, wanted: str) -> None:
    with pytest.raises(UserError, match=rf"^Mine\.{name}=.*: must be {wanted}"):
        type("Mine", (Wrong,), {name: value})


def test_hindsight_reads_the_objects_where_there_are_any(box) -> None:
    assert box(FrankaConfig(**SMALL)).relabel_reads == ("state",)
    scene = {"objects": [{"name": "cube", "size": [0.04, 0.04, 0.04]}]}
    assert box(FrankaConfig(**SMALL, gripper=True, scene=scene)).relabel_reads == ("state", "objects")


def test_hindsight_needs_a_task_that_is_about_a_distance(make) -> None:
    assert not Wrong.relabels()


def test_two_environments_may_be_given_one_task(box: type[TorchTask]) -> None:
    """Each has a copy with its own config: that of the second is none of the first one's."""
    near, far = (FrankaConfig(**SMALL, success_distance=distance) for distance in (0.001, 5.0))
    task = box(near)
    first = FrankaEnv(near, num_envs=2, device="cpu", seed=0, task=task)
    second = FrankaEnv(far, num_envs=2, device="cpu", seed=0, task=task)
    assert task.config is near
    for env, expected in ((first, near), (second, far)):
        assert (
            env.simulation.task.config == env.config
            and env.config.success_distance == expected.success_distance
        )


def test_gradients_of_who_acts_end_at_the_world(make) -> None:
    """A policy in training mode may act in a rollout: its graph neither stays nor comes back in rewards."""
    env = make()
    root, weight = env.reset(), torch.ones(N, 7, requires_grad=True)
    for _ in range(2):
        step = env.step(root.clone().set("action", 0.1 * weight))
        assert not any(value.requires_grad for value in step["next"].values())
        assert not env.simulation.tensors.action.requires_grad
        step["action"].sum().backward()


@pytest.mark.parametrize("wrong", [{"goal": (0.4, 0.0, 0.4)}, {"goal_sampling": "fixed"}])
def test_goals_that_it_draws_itself_are_not_taken(make, wrong: dict[str, Any]) -> None:
    with pytest.raises(
        UserError, match=f"{next(iter(wrong))}=.*: task=Box draws its own goals; leave it out"
    ):
        make(**wrong)


def test_a_goal_of_a_task_given_as_an_object_is_within_reach() -> None:
    class Mine(Reach):
        pass

    config = FrankaConfig(**SMALL, goal=(3.0, 0.0, 3.0))
    with pytest.raises(UserError, match="out of the arm's reach"):
        FrankaEnv(config, num_envs=1, device="cpu", task=Mine(config))
