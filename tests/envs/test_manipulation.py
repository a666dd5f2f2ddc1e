"""Gripper, scenes and contacts: what is held stays held, worlds do not touch one another, bad scenes are refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.constants import MOST_OPEN
from franka_wm.envs.scene import Body, Obstacle, Scene
from franka_wm.envs.tasks import Lift
from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import play_episodes
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training.settings import RunSettings
from presets import LIFT

OBSERVED = ("state", "joint_target", "objects", "contacts")
PRESET = LIFT | {"observations": OBSERVED}
CUBE = Body(name="cube", at=(0.5, 0.0))


def make(num_envs: int = 2, *, seed: int = 0, **changes) -> FrankaEnv:
    return FrankaEnv(FrankaConfig(**(PRESET | changes)), num_envs=num_envs, device="cpu", seed=seed)


def expert(env: FrankaEnv) -> ExpertPolicy:
    return ExpertPolicy(env.simulation.task, env.kinematics, env.config)


def grips(env: FrankaEnv, grip: float) -> torch.Tensor:
    """An arm at rest."""
    action = torch.zeros(env.num_envs, env.action_dim)
    action[:, -1] = grip
    return action


@pytest.fixture(scope="session")
def preset(composed) -> Callable[[str], FrankaConfig]:
    """The config of ``env=NAME``."""

    def make_config(name: str) -> FrankaConfig:
        return RunSettings.of(composed(f"env={name}")).env.arm

    return make_config


@pytest.fixture(scope="module")
def lifted() -> tuple[FrankaEnv, torch.Tensor]:
    """32 worlds after the expert's episode, and whether each succeeded at its end."""
    env = make(32, seed=1, episode_length=200)
    policy, observation = expert(env), env.reset()
    for _ in range(60):
        observation = env.step(policy(observation))["next"]
    return env, observation


# -- what a config brings ---------------------------------------------------------------------------------------


def test_a_task_brings_gripper_scene_and_home() -> None:
    config = FrankaConfig(task="lift")
    assert (config.action_dim, config.state_dim, config.target_dim, config.num_objects) == (8, 28, 8, 1)
    assert config.resolved_scene is Lift.scene and config.start_pose == Lift.home
    plain = FrankaConfig()
    assert (plain.action_dim, plain.state_dim, plain.target_dim) == (7, 20, 7)
    assert plain.resolved_scene is None and not plain.has_gripper


def test_specs() -> None:
    env = make(2)
    check_env_specs(env)
    assert env.observation_spec["objects"].shape == (2, 13)
    assert env.action_spec.shape == (2, 8)


def test_a_scene_as_yaml_has_it() -> None:
    scene = {
        "objects": [
            {"name": "can", "shape": "cylinder", "size": [0.03, 0.1], "mass": 0.2, "at": [0.5, 0.1]},
            {"name": "ball", "shape": "sphere", "size": [0.025], "at": [0.5, -0.1]},
            {"name": "pill", "shape": "capsule", "size": [0.02, 0.04], "at": [0.6, 0.0]},
        ],
        "obstacles": [{"name": "wall", "size": [0.02, 0.3, 0.1], "at": [0.7, 0.0, 0.05]}],
    }
    env = make(2, task="reach", gripper=True, scene=scene)
    observation = env.reset()
    heights = observation["objects"].view(2, 3, 13)[:, :, 2]
    assert torch.allclose(heights, torch.tensor([0.05, 0.025, 0.04]).expand(2, 3), atol=1e-4)
    for _ in range(15):
        observation = env.step(observation.set("action", grips(env, 1.0)))["next"]
    can, ball, _pill = observation["objects"].view(2, 3, 13).unbind(1)
    assert torch.allclose(
        can[:, :3], torch.tensor([0.5, 0.1, 0.05]), atol=1e-3
    )  # both stand where they were put
    assert torch.allclose(ball[:, 2], torch.tensor(0.025), atol=1e-3)
    assert env.simulation.model.shape_label.count("wall") == 2


# -- the gripper ------------------------------------------------------------------------------------------------


def test_the_fingers_follow_one_command_at_their_speed() -> None:
    env = make(2, task="reach", gripper=True, observations=("state", "joint_target"))
    observation = env.reset()
    assert torch.allclose(observation["state"][:, 20:22], torch.tensor(MOST_OPEN))
    per_step = 0.2 / env.config.fps
    for step in range(1, 13):
        observation = env.step(observation.set("action", grips(env, -1.0)))["next"]
        told = max(MOST_OPEN - step * per_step, 0.0)
        assert torch.allclose(observation["joint_target"][:, 7], torch.tensor(told), atol=1e-6)
    assert observation["state"][:, 20:22].abs().max() < 1e-3
    for _ in range(10):
        observation = env.step(observation.set("action", grips(env, 0.0)))["next"]
    assert (observation["state"][:, 20:22] - 0.5 * MOST_OPEN).abs().max() < 1e-3


def test_a_command_that_is_no_number_breaks_its_world_alone() -> None:
    env = make(2)
    action = grips(env, 1.0)
    action[1, 7] = torch.nan
    after = env.step(env.reset().set("action", action))["next"]
    assert after["truncated"].squeeze(-1).tolist() == [False, True]
    assert all(after[key].isfinite().all() for key in OBSERVED)
    assert env.statistics()["nonfinite"] == 1


# -- physics ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["push", "pick", "stack"])
def test_experts_succeed_in_every_world(name: str, preset) -> None:
    """32 worlds of each preset; `lift` has its own test. Nothing is lost, nothing overflows."""
    env = FrankaEnv(preset(name), num_envs=32, device="cpu", seed=1)
    played = play_episodes(env, expert(env), seed=1)
    assert played["success"].all(), played["success"].nonzero()
    assert env.statistics()["overflow"] == 0


def test_an_expert_recovers() -> None:
    """It strays on its way (noise), and the cube is dropped once: the fingers are opened while it is carried."""
    env = make(32, seed=1, episode_length=200)
    generator = torch.Generator().manual_seed(0)
    policy = ExpertPolicy(env.simulation.task, env.kinematics, env.config, noise=0.2, generator=generator)
    observation = env.reset()
    for step in range(150):
        decided = policy(observation)
        if 34 <= step < 40:
            decided["action"][:, -1] = 1.0
        observation = env.step(decided)["next"]
        if step == 50:
            assert (observation["objects"][:, 2] < 0.1).float().mean() > 0.9  # it fell
    assert observation["success"].all()


def test_the_expert_lifts_in_every_world(lifted) -> None:
    env, observation = lifted
    assert observation["success"].all()
    assert env.statistics()["overflow"] == 0


def test_what_is_held_stays(lifted) -> None:
    """Two seconds at rest: the cube slips by less than 0.1 mm; each finger presses into it by less than 1 mm."""
    env, observation = lifted
    for _ in range(20):  # the arm comes to rest
        observation = env.step(observation.set("action", grips(env, -1.0)))["next"]
    before = observation["objects"][:, 2] - observation["state"][:, 16]
    for _ in range(60):
        observation = env.step(observation.set("action", grips(env, -1.0)))["next"]
    slipped = (observation["objects"][:, 2] - observation["state"][:, 16] - before).abs()
    assert slipped.max() < 1e-4, slipped.max()
    between = 0.5 * observation["state"][:, 20:22].sum(-1) + 0.001  # from the middle to a pad's face
    assert (0.02 - between).max() < 1e-3
    assert observation["success"].all()


def test_more_physics_steps_make_harder_contacts(monkeypatch) -> None:
    """At 480 Hz nothing is ever deeper than 1 mm in anything, also where fingers close and the arm sets off."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    env = make(4, seed=1, substeps=16)
    env.simulation.bodies = bodies = import_module("penetration").Watched(env.simulation)
    policy, observation = expert(env), env.reset()
    for _ in range(40):
        observation = env.step(policy(observation))["next"]
    assert (observation["objects"][:, 2] > 0.1).all()
    assert 1e-5 < float(bodies.depth.numpy().max()) < 1e-3


def test_the_fingers_feel_what_they_hold(lifted) -> None:
    """Each pushes with its servo's stiffness times what it is stopped short of: 18.3 mm of 1000 N/m."""
    _env, observation = lifted
    expected = 1000.0 * observation["state"][:, 20:22]
    assert (observation["contacts"] - expected).abs().max() < 1.0
    assert (make(2).reset()["contacts"] == 0).all()


def test_a_cube_rests_on_the_table_without_sinking_or_creeping() -> None:
    env = make(4)
    observation = env.reset()
    start = observation["objects"].clone()
    for _ in range(30):
        observation = env.step(observation.set("action", grips(env, 1.0)))["next"]
        assert (observation["objects"][:, 2] - start[:, 2]).abs().max() < 2e-5  # not even at first
    assert (observation["objects"][:, :2] - start[:, :2]).abs().max() < 1e-5
    assert (observation["objects"][:, 2] - 0.02).abs().max() < 1e-3
    assert observation["objects"][:, 7:].abs().max() < 1e-3


# -- worlds -----------------------------------------------------------------------------------------------------


def played(
    num_envs: int, actions: list[torch.Tensor] | None = None
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """World 0's observations over the end of an episode and into the next one, in the cube's grip and out of it.

    Args:
        num_envs: How many worlds the expert plays.
        actions: What world 0 does instead: the rounding of torch's own functions, which the expert calls, differs with
            the size of a batch on some machines.

    Returns:
        (75, D) observations, and world 0's actions.
    """
    env = make(num_envs, seed=3)
    policy, observation, out, done = expert(env), env.reset(), [], []
    for step in range(75):
        decided = policy(observation)
        if actions is not None:
            decided["action"][0] = actions[step]
        done.append(decided["action"][0].clone())
        after, observation = env.step_and_maybe_reset(decided)
        out.append(torch.cat([after["next"][key][0].flatten() for key in (*OBSERVED, "reward", "goal")]))
    return torch.stack(out), done


def test_a_world_is_the_same_whatever_their_number() -> None:
    alone, actions = played(1)
    for num_envs in (2, 8):
        assert torch.equal(alone, played(num_envs, actions)[0]), num_envs


def test_a_masked_reset_leaves_other_worlds_alone() -> None:
    env = make(3)
    observation = env.reset()
    for _ in range(5):
        observation = env.step(observation.set("action", grips(env, -1.0)))["next"]
    mask = torch.tensor([[False], [True], [False]])
    again = env.reset(observation.clone().set("_reset", mask))
    for key in OBSERVED:
        assert torch.equal(again[key][[0, 2]], observation[key][[0, 2]]), key
    assert not torch.equal(again["objects"][1], observation["objects"][1])
    tool = env.kinematics.forward(again["state"][:, :7])  # its links moved with its joints
    assert torch.allclose(tool, again["state"][:, 14:17], atol=1e-4)
    assert again["state"][1, 20] == pytest.approx(MOST_OPEN)


def test_a_state_that_was_saved_in_the_cubes_grip_goes_on_bit_for_bit() -> None:
    env = make(3, episode_length=200)
    policy, observation = expert(env), env.reset()
    for _ in range(30):
        observation = env.step(policy(observation))["next"]
    saved, first = env.get_state(), []
    for turn in range(2):
        observation = env.set_state(saved) if turn else observation
        for k in range(15):
            observation = env.step(policy(observation.exclude("action")))["next"]
            if turn:
                assert all(torch.equal(observation[key], first[k][key]) for key in OBSERVED), k
            else:
                first.append(observation.clone())


def test_an_object_that_is_not_finite_breaks_its_world_alone() -> None:
    env = make(3)
    observation, action = env.reset(), grips(env, 1.0)
    env.simulation.tensors.rest_q[1, 3] = torch.nan
    after, following = env.step_and_maybe_reset(observation.set("action", action))
    assert after["next", "truncated"].squeeze(-1).tolist() == [False, True, False]
    for root in (after["next"], following):
        assert all(root[key].isfinite().all() for key in OBSERVED)
    for _ in range(5):
        following = env.step(following.set("action", action))["next"]
    assert all(following[key].isfinite().all() for key in OBSERVED)
    assert env.statistics()["nonfinite"] == 1


@pytest.mark.parametrize("reset", ["native", "standard"])
def test_lost_contacts_are_counted_and_marked_and_end_the_episode(caplog, reset: str) -> None:
    """Five boxes in a heap for which there is not nearly enough room."""
    boxes = tuple(Body(name=f"box{k}", at=(0.45 + 0.05 * (k % 2), -0.2 + 0.1 * k)) for k in range(5))
    env = make(2, task="reach", gripper=True, scene=Scene(objects=boxes), max_contacts=28, auto_reset=reset)
    observation = env.reset()
    rest_q = env.simulation.tensors.rest_q.view(2, -1)
    for k in range(5):  # thrown into one another
        rest_q[:, 2 + 7 * k : 5 + 7 * k] = torch.tensor([0.5, 0.004 * k, 0.021 + 0.01 * k])
    marked = 0
    for _ in range(3):
        assert not observation["overflow"].any()  # what begins is not marked
        step, observation = env.step_and_maybe_reset(observation.set("action", grips(env, 1.0)))
        assert torch.equal(step["next", "overflow"], step["next", "truncated"])
        marked += int(step["next", "overflow"].sum())
    assert marked == env.statistics(clear=False)["overflow"]
    with caplog.at_level("WARNING"):
        assert env.statistics(clear=False)["overflow"] == env.statistics()["overflow"] > 0
    assert [record.message for record in caplog.records].count(caplog.messages[0]) == 1
    assert "raise max_contacts" in caplog.text


@pytest.mark.parametrize("ends", [True, False])
def test_an_object_off_the_table_ends_the_episode_or_not(ends: bool) -> None:
    env = make(2, end_when_lost=ends)
    observation = env.reset()
    env.simulation.tensors.rest_q[1, 2] = 1.2  # beyond the edge, in the air
    after = env.step(observation.set("action", grips(env, 1.0)))["next"]
    assert after["truncated"].squeeze(-1).tolist() == [False, ends]
    assert not after["terminated"].any()


def test_objects_start_apart_everywhere_anew() -> None:
    boxes = tuple(Body(name=f"box{k}", at=(0.5, 0.0), spread=(0.1, 0.2), turn=1.0) for k in range(4))
    wall = Obstacle(name="wall", size=(0.1, 0.1, 0.1), at=(0.5, 0.0, 0.05))
    env = make(64, task="reach", gripper=True, scene=Scene(objects=boxes, obstacles=(wall,)))
    seen = [env.reset()["objects"].view(64, 4, 13)[..., :2] for _ in range(2)]
    assert not torch.equal(*seen)
    for places in seen:
        among = torch.cdist(places, places) + torch.eye(4)
        assert among.min() > 0.04 * 2**0.5  # circles around 4 cm boxes
        assert (places - torch.tensor([0.5, 0.0])).norm(dim=-1).min() > 0.05 + 0.028
        assert (places[..., 0] - 0.5).abs().max() <= 0.1 and places[..., 1].abs().max() <= 0.2


# -- bad input --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"gripper": False}, "task=lift needs the gripper"),
        ({"task": "reach", "scene": Scene(objects=(CUBE,)), "observations": ("state",)}, "set gripper=true"),
        ({"solver": "featherstone"}, "solver=mujoco"),
        ({"task": "reach", "observations": ("objects",)}, "has no objects"),
        ({"task": "reach"}, "touches nothing"),
        ({"reward": "normalized"}, "reward='normalized': must be one of dense, sparse"),
        ({"gripper_force": 100.0}, "gripper_force=100.0: must be from 1 to 70"),
        ({"home": (0.0, 1.0)}, "7 joint angles"),
        ({"scene": {"objects": [{"name": "cube", "mass": 0}]}}, "scene.cube.mass=0: must be from 0.001"),
        ({"scene": {"objects": [{"name": "cube", "size": [0.04, 0.04]}]}}, "give 3 numbers"),
        ({"scene": {"objects": [{"name": "cube", "shape": "cone"}]}}, "must be one of box, cylinder"),
        ({"scene": {"objects": [{"name": "cube", "weight": 1}]}}, "scene.cube: unknown 'weight'"),
        ({"scene": {"objcts": []}}, "scene: unknown 'objcts'; known: articulated, objects"),
        ({"scene": "kitchen.yaml"}, "must be a mapping, not the name of a file; write 'env.scene={"),
        ({"scene": {"objects": [{"name": "ball", "shape": "sphere", "size": 1}]}}, "give 1 number ("),
        (
            {"scene": {"objects": [{"name": "cube", "at": [3, 0]}]}},
            "starts 3.00 m from the base; the arm reaches",
        ),
        (
            {"scene": {"objects": [{"name": "cube", "at": [1.5, 0], "spread": [0.1, 0]}]}},
            "1.40 to 1.60 m from",
        ),
        ({"scene": {"objects": [{"name": "cube"}, {"name": "cube"}]}}, "each name only once"),
        ({"scene": {"objects": [{"name": "a"}, {"name": "b"}]}}, "scene.b: stands in something else"),
        ({"scene": {"table": {"size": [0.3, 0.4, 0.05]}, "objects": [{"name": "a"}]}}, "table's edge"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(changes: dict, said: str) -> None:
    with pytest.raises(UserError) as caught:
        FrankaConfig(**(PRESET | changes))
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert "scene.scene" not in str(caught.value)


def test_a_goal_that_would_be_drawn_over_is_refused() -> None:
    with pytest.raises(
        UserError, match=r"goal=\(0.4, 0.0, 0.2\): task=pick draws its own goals; leave it out"
    ):
        FrankaConfig(**(PRESET | {"task": "pick", "goal_sampling": "reachable", "goal": (0.4, 0.0, 0.2)}))
    with pytest.raises(
        UserError, match=r"goal=\(0.4, 0.0, 0.2\): with goal_sampling=reachable each episode draws"
    ):
        FrankaConfig(goal_sampling="reachable", goal=(0.4, 0.0, 0.2))


@pytest.mark.parametrize("task", ["lift", "push", "pick", "stack", "drawer", "peg"])
def test_options_of_other_goals_are_refused_with_a_gripper(task: str, preset: Callable) -> None:
    for name, value in (("goal_sampling", "fixed"), ("goal_noise", 0.3)):
        with pytest.raises(
            UserError, match=f"^{name}={value}: task={task} draws its own goals; leave it out"
        ):
            replace(preset(task), **{name: value})
    assert not preset(task).fixed_goal and not FrankaConfig(task=task).fixed_goal
    assert FrankaConfig(task="reach").fixed_goal and not FrankaConfig(goal_sampling="reachable").fixed_goal


def test_too_little_room_for_contacts_is_refused() -> None:
    with pytest.raises(UserError, match="needs at least 12"):
        FrankaConfig(**PRESET, max_contacts=5)


def test_the_expert_says_what_it_needs() -> None:
    reach = FrankaEnv(FrankaConfig(observations=("state",)), device="cpu")
    with pytest.raises(UserError, match="task=reach has none"):
        expert(reach)
    with pytest.raises(UserError, match="joint_delta or joint_position"):
        expert(make(1, action_mode="ee_delta"))
    with pytest.raises(UserError, match="needs gravity_compensation=true"):
        expert(make(1, gravity_compensation=False))


def test_own_tasks_bring_their_scene_as_well() -> None:
    """A task given as an object, without a name."""

    class Tower(Lift):
        scene = Scene(objects=(CUBE, Body(name="other", at=(0.6, 0.1))))

    config = FrankaConfig(observations=("state",))
    env = FrankaEnv(config, num_envs=1, device="cpu", task=Tower(config))
    assert env.config.num_objects == 2 and env.action_dim == 8
