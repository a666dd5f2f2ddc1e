"""The arm as LeRobot's environment: what it observes is what a dataset holds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from franka_wm.data.lerobot.schema import PROVENANCE
from franka_wm.errors import UserError

if TYPE_CHECKING:  # inside the tests otherwise: LeRobot's environments take ten seconds to import
    from franka_wm.data.lerobot_env import FrankaWMEnv

OPTIONS = {
    "observations": ("pixels", "goal_pixels", "state"),
    "cameras": ("front", "wrist"),
    "image_size": 16,
    "substeps": 1,
    "episode_length": 3,
}


@pytest.fixture(scope="module")
def config() -> FrankaWMEnv:
    from lerobot.envs.configs import EnvConfig

    from franka_wm.data.lerobot_env import FrankaWMEnv

    made = EnvConfig.get_choice_class("franka_wm")(options=OPTIONS, device="cpu")
    assert isinstance(made, FrankaWMEnv)
    return made


def test_observations_are_those_of_a_dataset(config: FrankaWMEnv) -> None:
    """LeRobot's own conversion gives the features that were announced, of the announced sizes."""
    from lerobot.envs.factory import make_env
    from lerobot.envs.utils import env_to_policy_features, preprocess_observation

    envs = make_env(config, n_envs=2, use_async_envs=True)
    (env,) = envs["franka_wm"].values()
    observation, info = env.reset(seed=[5, 6])
    assert env.observation_space.contains(observation)
    features = env_to_policy_features(config)
    converted = preprocess_observation(observation)
    announced = {name: feature.shape for name, feature in features.items() if name != "action"}
    assert announced == {
        "observation.images.front": (3, 16, 16),
        "observation.images.wrist": (3, 16, 16),
        "observation.images.goal": (3, 16, 16),
        "observation.images.goal_wrist": (3, 16, 16),
        "observation.state": (20,),
        "observation.environment_state": (3,),
    }
    assert {name: tuple(value.shape[1:]) for name, value in converted.items()} == announced
    assert info["is_success"].shape == (2,)
    # tool − goal, the last three of the state, and the goal agree with the tool.
    state, goal = observation["agent_pos"], observation["environment_state"]
    assert np.allclose(state[:, 14:17] - goal, state[:, 17:20], atol=1e-6)
    pictures = observation["pixels"]
    assert not np.array_equal(pictures["front"], pictures["wrist"])
    assert not np.array_equal(pictures["front"], pictures["goal"])
    for step in range(3):
        observation, reward, _, truncated, info = env.step(np.zeros((2, 7), np.float32))
        assert (truncated == (step == 2)).all() and (reward <= 0).all()
        assert "is_success" not in info, "LeRobot counts a success of any step"
    assert info["final_info"]["is_success"].shape == (2,)
    assert info["final_obs"][0]["agent_pos"].shape == (20,)
    assert env.call("_max_episode_steps") == (3, 3)
    assert env.call("task_description")[0].startswith("Move the tool")
    assert env.call("render")[0].shape == (256, 256, 3)
    env.close()


def test_settings_of_a_dataset(tmp_path: Path) -> None:
    from franka_wm.data.lerobot_env import FrankaWMEnv, recorded_settings

    path = tmp_path / PROVENANCE
    path.parent.mkdir(parents=True)

    def provenance(*settings: dict) -> None:
        path.write_text(json.dumps({"sessions": [{"config": {"env": s}} for s in settings]}))

    env = {"kind": "franka", "urdf_path": None, "fps": 20.0, "observations": ["state"], "episode_length": 7}
    provenance(env, env)
    config = FrankaWMEnv(dataset=str(tmp_path), options={"episode_length": 9})
    assert config.fps == 20 and config.config.episode_length == 9
    assert config.config.observations == ("state",) and "pixels/front" not in config.features
    provenance(env, env | {"fps": 30.0})
    with pytest.raises(UserError, match="recorded with different settings"):
        FrankaWMEnv(dataset=str(tmp_path))
    provenance(env | {"urdf_path": "arm.urdf"})  # another robot would be driven by its actions
    with pytest.raises(UserError, match=r"recorded with a robot of its own, env\.urdf_path=arm\.urdf"):
        FrankaWMEnv(dataset=str(tmp_path))
    with pytest.raises(UserError, match=r"has no meta/franka_wm/provenance\.json"):
        recorded_settings(str(tmp_path / "nothing"))


def test_a_dataset_of_a_run_that_stacked_pictures_shows_single_ones(tmp_path: Path) -> None:
    """As `export` writes it: the run's configuration, and of each stack the newest picture."""
    from franka_wm.data.lerobot_env import FrankaWMEnv

    path = tmp_path / PROVENANCE
    path.parent.mkdir(parents=True)
    env = {**OPTIONS, "kind": "franka", "urdf_path": None, "observations": ["pixels", "state"]}
    sessions = [{"config": {"env": env | {"frame_stack": count}}} for count in (3, 1)]
    path.write_text(json.dumps({"sessions": sessions}))
    config = FrankaWMEnv(dataset=str(tmp_path), device="cpu")
    assert config.features["pixels/front"].shape == (16, 16, 3)
    (env,) = config.create_envs(2)["franka_wm"].values()
    assert env.reset(seed=[5, 6])[0]["pixels"]["front"].shape == (2, 16, 16, 3)
    env.close()


def test_refused() -> None:
    from franka_wm.data.lerobot_env import FrankaWMEnv

    with pytest.raises(UserError, match="unknown"):
        FrankaWMEnv(options={"speed": 3})
    with pytest.raises(UserError, match="drives joints"):
        FrankaWMEnv(options={"action_mode": "ee_delta"})
    with pytest.raises(UserError, match="state"):
        FrankaWMEnv(options={"observations": ["pixels"]}, device="cpu").create_envs(1)


def test_same_seed_same_episode(config: FrankaWMEnv) -> None:
    (a,) = config.create_envs(1)["franka_wm"].values()
    (b,) = config.create_envs(1)["franka_wm"].values()
    first, second = (env.reset(seed=[3])[0]["environment_state"] for env in (a, b))
    assert np.array_equal(first, second)
    assert torch.from_numpy(first).isfinite().all()
    a.close()
    b.close()
