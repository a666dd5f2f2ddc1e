"""Several tasks at once: every world is as it would be alone, and each task is judged by itself."""

import json
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.utils import check_env_specs

from franka_wm import conf
from franka_wm.envs import FrankaEnv, MultiTaskEnv, multitask
from franka_wm.envs.multitask_config import MultiTaskConfig, multi_task_config
from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import play_episodes, summarize
from franka_wm.evaluation.results import point
from franka_wm.evaluation.rollouts import gather_episodes, mixture
from franka_wm.policies.scripted import NoopPolicy
from franka_wm.report.seeds import seeds_table
from franka_wm.report.table import evaluation_tables
from franka_wm.seeding import derive_seed
from franka_wm.training import build
from franka_wm.training.settings import RunSettings
from franka_wm.training.spaces import Spaces

STEPS = 9
SHORT = {"reach": 4, "push": 6}


@pytest.fixture(scope="module")
def config() -> MultiTaskConfig:
    values = RunSettings.of(conf.compose("env=multitask")).env.values["tasks"]
    tasks = {name: {**values[name], "substeps": 1, "episode_length": steps} for name, steps in SHORT.items()}
    return multi_task_config({"kind": "multitask", "tasks": tasks})


@pytest.fixture(scope="module")
def env(config) -> MultiTaskEnv:
    return MultiTaskEnv(config, num_envs=5, device="cpu", seed=3)


def actions() -> torch.Tensor:
    return torch.rand(STEPS, 5, 8, generator=torch.Generator().manual_seed(0)) * 2 - 1


def play(env, given: torch.Tensor) -> tuple[TensorDict, TensorDict]:
    """Roots, and what came next, of steps with automatic resets: batch size (steps, worlds)."""
    now, roots, after = env.reset(), [], []
    for action in given:
        roots.append(now.select(*env.observation_spec.keys()))
        step, now = env.step_and_maybe_reset(now.set("action", action))
        after.append(step["next"].clone())
    return torch.stack(roots), torch.stack(after)  # type: ignore[return-value]


@pytest.mark.parametrize("worlds", [4, 5])
def test_every_world_is_as_it_would_be_alone(env, config, worlds: int) -> None:
    """As many of each task, or more of the first."""
    env = env if worlds == 5 else MultiTaskEnv(config, num_envs=worlds, device="cpu")
    env.set_seed(3)
    given = actions()[:, :worlds]
    roots, after = play(env, given)
    assert env.sizes == {"state": 28, "joint_target": 8, "objects": 13, "goal": 3} and env.action_dim == 8
    assert torch.equal(roots["task"][0], torch.eye(2)[[0, 1, 0, 1, 0][:worlds]])
    for k, (name, one) in enumerate(config.tasks.items()):
        count, seed = len(range(k, worlds, 2)), derive_seed("task", 3, name)
        alone = FrankaEnv(one, num_envs=count, device="cpu", seed=seed)
        own_roots, own_after = play(alone, given[:, k::2, : alone.action_dim])
        for together, apart in ((roots[:, k::2], own_roots), (after[:, k::2], own_after)):
            for key in apart.keys():  # noqa: SIM118
                found, size = together[key], apart[key].shape[-1]
                assert torch.equal(found[..., :size], apart[key]), (name, key)
                assert not found[..., size:].any(), (name, key)
    assert not after["objects"][:, 0::2].any()  # reach has none
    ends = after["done"][..., 0].nonzero().tolist()
    assert [3, 0] in ends and [5, 1] in ends and [3, 1] not in ends  # each task at its own time


class Plainly:
    """In place of `side_stream`: one after the other."""

    opened: list["Plainly"] = []

    def __init__(self, *inputs: torch.Tensor, lane: int = 0) -> None:
        self.inputs, self.lane, self.outputs = inputs, lane, ()
        self.opened.append(self)

    def __enter__(self) -> "Plainly":
        return self

    def __exit__(self, *_: object) -> None: ...

    def join(self, *outputs: torch.Tensor) -> None:
        self.outputs = outputs


def test_each_task_steps_in_a_lane_of_its_own(env, monkeypatch) -> None:
    monkeypatch.setattr(multitask, "side_stream", Plainly)
    Plainly.opened.clear()
    env.step(env.reset().set("action", actions()[0]))
    assert [one.lane for one in Plainly.opened] == [0, 1]
    assert all(one.inputs[0].shape == (5, 8) for one in Plainly.opened)
    observed = [len([*one.observation_spec.keys()]) for one in env.envs.values()]
    # All that a step made is handed over: observations, the reward, and at least three marks.
    assert all(len(one.outputs) > count + 3 for one, count in zip(Plainly.opened, observed, strict=True))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_tasks_step_side_by_side_as_one_after_the_other(monkeypatch) -> None:
    """All eight, through ends of episodes; contacts are summed in any order on a GPU, so these are compared loosely."""
    given = RunSettings.of(conf.compose("env=multitask")).env.values["tasks"]
    tasks = {name: {**values, "episode_length": 12} for name, values in given.items()}
    config = multi_task_config({"kind": "multitask", "tasks": tasks})
    generator = torch.Generator().manual_seed(0)
    moves = (torch.rand(30, 64, 8, generator=generator) * 2 - 1).cuda()
    found = []
    for apart in (False, True):
        if not apart:
            monkeypatch.setattr(multitask, "side_stream", Plainly)
        else:
            monkeypatch.undo()
        found.append(play(MultiTaskEnv(config, num_envs=64, device="cuda", seed=3), moves)[1])
    (one, other), count = found, len(tasks)
    for k, name in enumerate(tasks):
        state = one["state"][:, k::count], other["state"][:, k::count]
        if name in ("reach", "track"):
            torch.testing.assert_close(*state, rtol=1e-4, atol=1e-4)
        else:
            assert ((state[0] - state[1]).abs().amax(-1) < 0.02).float().mean() > 0.95, name
        assert torch.equal(one["done"][:, k::count], other["done"][:, k::count])


def test_a_reset_by_mask_touches_the_worlds_that_it_names(env) -> None:
    env.set_seed(3)
    play(env, actions()[:2])
    before = env.step(TensorDict({"action": actions()[2]}, [5]))["next"]
    mask = torch.tensor([False, False, False, True, True]).unsqueeze(-1)
    after = env._reset(TensorDict({"_reset": mask}, [5]))
    assert torch.equal(after["is_init"], mask)
    changed = (after["state"] != before["state"]).any(-1, keepdim=True)
    assert torch.equal(changed, mask)
    first = env.reset(seed=7)["state"].clone()
    assert torch.equal(env.reset(seed=7)["state"], first) and not torch.equal(
        env.reset(seed=8)["state"], first
    )


def test_it_is_an_environment_of_torchrls(env) -> None:
    check_env_specs(env)
    collector = Collector(
        TransformedEnv(env, RewardSum()), env.rand_action, frames_per_batch=5 * 12, total_frames=5 * 12
    )
    data = next(iter(collector))
    collector.shutdown()
    for world in range(5):
        total = 0.0
        for t in range(12):
            total += float(data["next", "reward"][world, t])
            assert abs(float(data["next", "episode_reward"][world, t]) - total) < 1e-4
            if data["next", "done"][world, t]:
                total = 0.0


def test_a_model_of_them_knows_what_their_actions_lack(env) -> None:
    assert env.action_masks == [[1.0] * 7 + [0.0], [1.0] * 8]
    spaces = Spaces.from_dict(json.loads(json.dumps(Spaces.of_env(env).as_dict())))
    run = RunSettings.of(conf.compose("env=multitask", "scale=smoke", "device=cpu"))
    model: Any = build.make_model(run, spaces, "cpu").eval()
    action = model.policy(model.encode(env.reset()), deterministic=True)
    assert (action[0::2, 7] == 0).all() and (action[1::2, 7] != 0).all()


def test_statistics_tell_tasks_apart(env) -> None:
    env.set_seed(3)
    env.statistics()
    _, after = play(env, actions())
    found = env.statistics()
    done = after["done"][..., 0]
    assert found["episodes"] == int(done.sum()) == 3 * 2 + 2
    lengths = [4] * 6 + [6] * 2
    assert found["length"] == pytest.approx(sum(lengths) / 8)
    assert {"success/reach", "success/push"} <= set(found)
    assert (found["episodes/reach"], found["episodes/push"]) == (6, 2)
    assert "return" not in env.statistics()  # nothing has ended since


def test_worlds_go_on_from_a_state(env) -> None:
    env.set_seed(3)
    play(env, actions()[:2])
    state = env.get_state()
    first = [env.step(TensorDict({"action": a}, [5]))["next"].clone() for a in actions()[2:4]]
    env.set_state(state)
    for a, expected in zip(actions()[2:4], first, strict=True):
        found = env.step(TensorDict({"action": a}, [5]))["next"]
        assert all(torch.equal(found[key], expected[key]) for key in ("state", "objects", "reward"))
    for wrong in ({}, state.clone().set("push", torch.zeros(2))):
        with pytest.raises(UserError, match="must be the TensorDict that get_state"):
            env.set_state(wrong)
    with pytest.raises(UserError, match="these worlds are of reach, push"):
        env.set_state(state.exclude("push"))
    with pytest.raises(UserError, match="push has another number of worlds"):
        env.set_state(state.clone().set("push", state["push"][:1]))
    now = env.get_state()
    # Of the second task: the first has not moved either.
    with pytest.raises(UserError, match="joint_q must be"):
        env.set_state(state.clone().set("push", state["push"].exclude("joint_q")))
    assert not torch.equal(now["reach", "joint_q"], state["reach", "joint_q"])
    assert torch.equal(env.get_state()["reach", "joint_q"], now["reach", "joint_q"])


def test_nothing_leaves_poses_of_one_task_and_joints_of_another_as_they_are(config) -> None:
    tasks = {
        "reach": config.tasks["reach"],
        "push": replace(config.tasks["push"], action_mode="joint_position"),
    }
    env = MultiTaskEnv(MultiTaskConfig(tasks=tasks), num_envs=2, seed=0)
    assert "noop" not in build.make_scripted_policies(env)


def test_each_task_has_its_expert(env) -> None:
    policies = build.make_scripted_policies(env)
    assert set(policies) == {"noop", "random", "expert"}
    now = env.reset()
    acted = policies["expert"](now.clone())["action"]
    for k, (name, one) in enumerate(env.envs.items()):
        own = build.make_scripted_policies(one)
        alone = own.get("expert", own.get("ik"))(env.split(now)[name])["action"]
        assert torch.allclose(acted[k::2, : alone.shape[-1]], alone, atol=1e-5)
    for count in (1, 4):  # an evaluation may play some of the worlds
        some = policies["expert"](now[:count].clone())["action"]
        assert torch.allclose(some, acted[:count], atol=1e-5)  # another batch, other roundings


def test_success_of_a_task_counts_its_own_worlds_alone(env, monkeypatch) -> None:
    step = env._step

    def succeeding(tensordict):
        out = step(tensordict)
        return out.set("success", env.one_hot[:, 1:2].bool() & (torch.arange(5).unsqueeze(-1) > 1))

    monkeypatch.setattr(env, "_step", succeeding)
    played = play_episodes(env, lambda td: td.set("action", torch.zeros(5, 8)), seed=1)
    own = played["task_success"]
    assert torch.equal(own["push"].isnan(), env.one_hot[:, 0].bool())
    assert own["push"][[1, 3]].tolist() == [0.0, 1.0]
    assert own["reach"][[0, 2, 4]].tolist() == [0.0, 0.0, 0.0]
    found = summarize(played)
    assert found["success"]["mean"] == pytest.approx(0.2) and found["task_success"]["push"]["mean"] == 0.5
    assert found["task_success"]["push"]["low"] > 0.05  # Wilson's interval of one in two
    table, _ = evaluation_tables({"planner": found})
    assert table.header[:4] == ["policy", "success [%]", "reach [%]", "push [%]"]
    assert table.rows[0][3].startswith("50 (")
    assert point({"planner": found})["eval/planner/success_push"] == 0.5
    assert "| policy | success [%] | reach [%] | push [%] | return |" in seeds_table([{"planner": found}])


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"tasks": {}}, "must name at least one task"),
        ({"tasks": [1]}, "must be tasks by name"),
        ({"tasks": {"a": {"kind": "gym"}}}, r"env\.tasks\.a: must be a preset of the arm"),
        ({"tasks": {"a": {"kind": "franka", "observations": ["pixels"]}}}, "observe vectors alone"),
        ({"tasks": {"a": {"kind": "franka", "substeps": 0}}}, r"env\.tasks\.a: .*substeps"),
        ({"tasks": {"a": {"kind": "franka"}}, "fps": 3}, r"options of one task are env\.tasks\.NAME\.fps"),
    ],
)
def test_what_does_not_fit_is_one_line(values, said) -> None:
    with pytest.raises(UserError, match=said):
        multi_task_config({"kind": "multitask", **values})


def test_fewer_worlds_than_tasks(config) -> None:
    with pytest.raises(UserError, match="2 tasks need at least as many worlds"):
        MultiTaskEnv(config, num_envs=1, device="cpu")


def test_diagnostics_see_each_task_at_random_and_by_the_model(env) -> None:
    """By turns of all tasks: with an even number of them a turn of single worlds gives each task one policy alone."""

    class Always(NoopPolicy):
        def __init__(self, action: float) -> None:
            super().__init__(env.action_dim)
            self.action = action

        def forward(self, tensordict: Any) -> Any:
            super().forward(tensordict)["action"].fill_(self.action)
            return tensordict

    policies: Any = {"random": Always(0.5), "policy": Always(-0.5)}
    played, _ = gather_episodes(env, mixture(policies, env), steps=1)
    assert played["action"][:, 0, 0].tolist() == [0.5, 0.5, -0.5, -0.5, 0.5]


def test_what_cannot_be_is_one_line(config) -> None:
    with pytest.raises(UserError, match="auto_reset=standard: tasks together need native"):
        MultiTaskConfig(tasks=config.tasks, auto_reset="standard")
    for seed in (-1, 1.5, "a"):
        with pytest.raises(UserError, match="seed="):
            MultiTaskEnv(config, num_envs=2, device="cpu", seed=seed)  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"first_world=-2: must be"):  # as of one task
        MultiTaskEnv(config, num_envs=2, device="cpu", first_world=-2)
