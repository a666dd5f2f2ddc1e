"""The Gymnasium view: its spaces, and what it says where an episode ends."""

import importlib
import sys

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from franka_wm.conf import compose
from franka_wm.envs import FrankaConfig, FrankaEnv, tasks
from franka_wm.envs.gym import REACH_V0, FrankaGymEnv, FrankaVectorEnv, register
from franka_wm.errors import UserError

SMALL = {"image_size": 32, "substeps": 4, "gravity_compensation": True, "device": "cpu"}
STATE = {**SMALL, "observations": ("state",)}


@pytest.fixture
def actions() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (8, 3, 7)).astype(np.float32)


def test_made_by_name_and_inside_its_spaces() -> None:
    envs = gymnasium.make_vec(
        "franka_wm.envs.gym:franka_wm/Reach-v0", num_envs=2, image_size=32, device="cpu"
    )
    assert envs.num_envs == 2
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    config = envs.unwrapped.env.config
    assert {key: getattr(config, key) for key in REACH_V0} == REACH_V0
    observation, info = envs.reset(seed=0)
    assert envs.observation_space.contains(observation)
    assert observation["pixels"]["front"].shape == (2, 32, 32, 3)
    assert set(info) == {"is_success"}
    envs.action_space.seed(0)
    actions = envs.action_space.sample()
    assert actions.shape == (2, 7)
    observation, reward, terminated, truncated, info = envs.step(actions)
    assert envs.observation_space.contains(observation)
    assert envs.single_observation_space.contains({
        "pixels": {"front": observation["pixels"]["front"][0]},
        "agent_pos": observation["agent_pos"][0],
        "environment_state": observation["environment_state"][0],
    })  # fmt: skip
    assert reward.shape == terminated.shape == truncated.shape == info["is_success"].shape == (2,)
    assert terminated.dtype == truncated.dtype == info["is_success"].dtype == np.bool_
    envs.close()
    envs.close()


def test_actions_are_as_many_as_the_mode_has() -> None:
    """With ``ee_delta``, three: the space says so, and what it samples is played."""
    view = FrankaVectorEnv(2, **STATE, action_mode="ee_delta", seed=0)
    env = FrankaEnv(view.env.config, num_envs=2, device="cpu", seed=0)
    assert view.single_action_space.shape == (3,) and view.action_space.shape == (2, 3)
    view.action_space.seed(0)
    view.reset()
    action = view.action_space.sample()
    expected = env.step(env.reset().set("action", torch.from_numpy(action)))["next", "state"]
    assert np.array_equal(view.step(action)[0]["agent_pos"], expected[:, :7].numpy())
    with pytest.raises(UserError, match=r"\(2, 7\).*\(2, 3\)"):
        view.step(np.zeros((2, 7), np.float32))


def test_what_else_was_asked_for_is_observed() -> None:
    """Under its own name, as the arm itself has it; nothing that was asked for is dropped."""
    options = {"image_size": 16, "substeps": 2, "device": "cpu", "cameras": ("front", "wrist")}
    asked = ("pixels", "segmentation", "depth", "state", "joint_target", "objects", "contacts")
    one = gymnasium.make("franka_wm/Lift-v0", observations=asked, **options).unwrapped
    assert isinstance(one, FrankaGymEnv) and isinstance(one.observation_space, gymnasium.spaces.Dict)
    others = {*asked, "pixels_wrist", "segmentation_wrist", "depth_wrist"} - {"pixels", "state"}
    assert set(one.observation_space) == others | {"pixels", "agent_pos", "environment_state"}
    observation = one.reset(seed=0)[0]
    present = FrankaEnv(one.env.config, num_envs=1, device="cpu").reset(seed=0)
    assert np.array_equal(observation["agent_pos"], present["state"][0].numpy()), "fingers and tool, too"
    kept = {key: observation[key].copy() for key in others}
    moved = one.step(np.ones(8, np.float32))[0]
    for each in (observation, moved):
        assert one.observation_space.contains(each)
    for key in others:
        assert np.array_equal(observation[key], kept[key]) and np.array_equal(kept[key], present[key][0])
    assert not np.array_equal(moved["joint_target"], kept["joint_target"])


def test_registering_again_changes_nothing() -> None:
    spec = gymnasium.spec("FrankaWM/Reach-v0")
    register()
    assert gymnasium.spec("FrankaWM/Reach-v0") is spec


@pytest.mark.parametrize("auto_reset", ["native", "standard"])
def test_it_is_the_same_simulation_across_episode_ends(auto_reset: str, actions: np.ndarray) -> None:
    """Numbers are the environment's own; at an end, the last and the first observation are where they belong."""
    options = {**SMALL, "episode_length": 3, "auto_reset": auto_reset}
    view = FrankaVectorEnv(3, **options)
    config = FrankaConfig(**{k: v for k, v in options.items() if k != "device"})
    env = FrankaEnv(config, num_envs=3, device="cpu")
    observation, _ = view.reset(seed=5)
    present = env.reset(seed=5)
    for t, action in enumerate(actions):
        assert np.array_equal(observation["agent_pos"], present["state"][:, :7].numpy())
        assert np.array_equal(observation["pixels"]["front"], present["pixels"].numpy())
        stepped, present = env.step_and_maybe_reset(present.set("action", torch.from_numpy(action)))
        observation, reward, terminated, truncated, info = view.step(action)
        after = stepped["next"]
        assert np.array_equal(reward, after["reward"].squeeze(-1).numpy())
        assert not terminated.any()
        ended = (t + 1) % 3 == 0
        assert truncated.tolist() == [ended] * 3
        assert ("final_obs" in info) == ("final_info" in info) == ended
        if ended:
            assert info["_final_obs"].tolist() == info["_final_info"].tolist() == [True] * 3
            for k in range(3):
                last = info["final_obs"][k]
                assert view.single_observation_space.contains(last)
                assert np.array_equal(last["agent_pos"], after["state"][k, :7].numpy())
                assert np.array_equal(last["pixels"]["front"], after["pixels"][k].numpy())
                assert not np.array_equal(last["agent_pos"], observation["agent_pos"][k])


def test_success_is_told_of_the_finished_episode() -> None:
    view = FrankaVectorEnv(2, **STATE, success_distance=10.0, terminate_on_success=True)
    view.reset(seed=0)
    _, _, terminated, truncated, info = view.step(np.zeros((2, 7), np.float32))
    assert terminated.all()
    assert not truncated.any()
    assert info["final_info"]["is_success"].tolist() == [True, True]
    assert not info["is_success"].any(), "the new episode has not succeeded"


def test_seeds_decide_and_lists_of_them_are_gymnasiums() -> None:
    view = FrankaVectorEnv(3, **STATE, goal_sampling="reachable")
    first = view.reset(seed=4)[0]
    assert np.array_equal(view.reset(seed=[4, 5, 6])[0]["agent_pos"], first["agent_pos"])
    assert np.array_equal(view.reset(seed=4)[0]["environment_state"], first["environment_state"])
    assert not np.array_equal(view.reset(seed=7)[0]["agent_pos"], first["agent_pos"])
    assert not np.array_equal(view.reset()[0]["agent_pos"], first["agent_pos"])
    for wrong in ([4, 4, 4], [4], []):
        with pytest.raises(UserError, match="share one seed"):
            view.reset(seed=wrong)


def test_some_worlds_can_be_reset(actions: np.ndarray) -> None:
    view = FrankaVectorEnv(3, **STATE)
    view.reset(seed=0)
    before = view.step(actions[0])[0]["agent_pos"]
    after = view.reset(options={"reset_mask": np.array([False, True, False])})[0]["agent_pos"]
    assert np.array_equal(before[[0, 2]], after[[0, 2]])
    assert not np.array_equal(before[1], after[1])
    # The masked world's clock started again, the others' did not.
    assert view.env.simulation.tensors.step_count.squeeze(-1).tolist() == [1, 0, 1]


def test_results_are_not_overwritten_by_the_next_step(actions: np.ndarray) -> None:
    view = FrankaVectorEnv(3, **SMALL)
    view.reset(seed=0)
    observation, reward, *_ = view.step(actions[0])
    kept = observation["agent_pos"].copy(), observation["pixels"]["front"].copy(), reward.copy()
    view.step(actions[1])
    assert np.array_equal(observation["agent_pos"], kept[0])
    assert np.array_equal(observation["pixels"]["front"], kept[1])
    assert np.array_equal(reward, kept[2])


def test_lerobot_reads_it() -> None:
    utils = pytest.importorskip("lerobot.envs.utils")
    view = FrankaVectorEnv(2, **SMALL, render_mode="rgb_array")
    observation = utils.preprocess_observation(
        view.reset(seed=[0, 1], options={"lerobot_new_rollout": True})[0]
    )
    assert observation["observation.images.front"].shape == (2, 3, 32, 32)
    assert observation["observation.state"].shape == (2, 7)
    assert observation["observation.environment_state"].shape == (2, 3)
    assert view.call("_max_episode_steps")[0] == 50
    assert view.call("task_description") == ("Move the tool to the goal position and hold it there.",) * 2
    frames = view.call("render")
    assert len(frames) == 2
    assert frames[0].shape == (256, 256, 3)
    assert frames[0].std() > 5


def test_wrong_use_is_one_line() -> None:
    with pytest.raises(UserError, match="agent_pos"):
        FrankaVectorEnv(1, **{**SMALL, "observations": ("pixels",)})
    with pytest.raises(UserError, match="unknown environment option"):
        FrankaVectorEnv(1, gravity=0)
    view = FrankaVectorEnv(2, **STATE)
    with pytest.raises(UserError, match="reset"):
        view.step(np.zeros((2, 7), np.float32))
    view.reset()
    with pytest.raises(UserError, match=r"\(2, 7\)"):
        view.step(np.zeros((3, 7), np.float32))
    view.reset(seed=[None, None])  # as Gymnasium may be asked
    for seed in (3.5, -1, "x", [1.5, 2.5]):
        with pytest.raises(UserError, match="must be a whole number of at least 0"):
            view.reset(seed=seed)  # type: ignore[arg-type]
    for given in ({"num_envs": 5}, {"device": "cpu"}, {"substeps": 2}):
        with pytest.raises(UserError, match=f"{next(iter(given))}: env=… is already built"):
            FrankaVectorEnv(env=view.env, **given)


@pytest.mark.filterwarnings("ignore:.*")
@pytest.mark.parametrize("options", [{}, {"action_mode": "ee_delta", "observations": ("state",)}])
def test_gymnasiums_own_check_of_one_arm(options: dict) -> None:
    env = gymnasium.make(
        "franka_wm/Reach-v0", device="cpu", image_size=16, substeps=2, render_mode="rgb_array", **options
    )
    assert env.action_space.shape == ((3,) if options else (7,))
    check_env(env.unwrapped)
    env.close()


def test_one_arm_is_world_0_of_many(actions: np.ndarray) -> None:
    one, many = (
        FrankaGymEnv(**SMALL, goal_sampling="reachable"),
        FrankaVectorEnv(3, **SMALL, goal_sampling="reachable"),
    )
    first, expected = one.reset(seed=3)[0], many.reset(seed=3)[0]
    for action in actions:
        assert one.observation_space.contains(first)
        assert np.array_equal(first["pixels"]["front"], expected["pixels"]["front"][0])
        for key in ("agent_pos", "environment_state"):
            assert np.array_equal(first[key], expected[key][0])
        first, reward, terminated, truncated, info = one.step(action[0])
        expected, rewards, *_ = many.step(action)
        assert reward == rewards[0] and (terminated, truncated) == (False, False)
    assert info == {"is_success": False}


def test_one_arm_stays_finished_until_it_is_reset() -> None:
    one = FrankaGymEnv(**STATE, episode_length=2)
    with pytest.raises(UserError, match="reset"):
        one.step(np.zeros(7, np.float32))
    one.reset(seed=0)
    ended = [one.step(np.zeros(7, np.float32))[3] for _ in range(4)]
    assert ended == [False, True, True, True]
    one.reset()
    assert not one.step(np.zeros(7, np.float32))[3]
    with pytest.raises(UserError, match=r"\(3,\).*\(7,\)"):
        one.step(np.zeros(3, np.float32))


def test_every_task_has_a_name() -> None:
    assert gymnasium.spec("franka_wm/Track-v0").kwargs["task"] == "track"
    tasks.register("named_by_gym", tasks.Reach)
    try:
        register()
        assert gymnasium.spec("franka_wm/NamedByGym-v0").kwargs["task"] == "named_by_gym"
    finally:
        gymnasium.registry.pop("franka_wm/NamedByGym-v0")


@pytest.mark.parametrize("task", ["reach", "lift", "push", "pick", "stack", "drawer", "peg"])
def test_a_name_is_the_task_of_the_configuration(task: str) -> None:
    """In its length, rate, start and camera; what is observed is Gymnasium's."""
    given = gymnasium.spec(f"franka_wm/{task.capitalize()}-v0").kwargs
    preset = compose(f"env={task}").env
    for name in {*given, "fps", "pose_noise", "camera_distance"} - {"observations"}:
        default = {"task": "reach"}.get(name, FrankaConfig.__dataclass_fields__[name].default)
        assert given.get(name, default) == preset[name], name
    assert given["observations"] == ("pixels", "state")


def test_arms_without_a_seed_play_other_episodes() -> None:
    options = {"observations": ("state",), "device": "cpu", "substeps": 2}
    for make in (gymnasium.make, gymnasium.make_vec):
        envs = [make("franka_wm/Reach-v0", **options) for _ in range(2)]
        goals = [env.reset()[0]["environment_state"] for env in envs]
        assert not np.array_equal(*goals)
        again = [env.reset(seed=3)[0]["environment_state"] for env in envs]
        assert np.array_equal(*again)


def test_what_is_to_be_done_is_told() -> None:
    view = FrankaVectorEnv(1, task="lift", observations=("state",), device="cpu", substeps=2)
    assert (view.task, view.task_description) == ("lift", "Lift the cube.")


def test_without_gymnasium_the_extra_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "franka_wm.envs.gym")
    with pytest.raises(UserError, match=r"franka-wm\[gym\]"):
        importlib.import_module("franka_wm.envs.gym")
