"""A scene and a task with objects of one's own, as docs/tasks.md prints them: no file of the package is touched."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
import yaml

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.evaluation.closed_loop import play_episodes
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training.settings import RunSettings


def test_the_printed_scene(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (root / "docs" / "tasks.md").read_text()
    scene = next(b for b in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if "name: ball" in b)
    code = next(b for b in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "kitchen.yaml" in b)
    (tmp_path / "kitchen.yaml").write_text(scene)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(code, names)
    env, observation = names["env"], names["observation"]
    assert observation["objects"].shape == (16, 39)
    assert [body.name for body in env.config.resolved_scene.objects] == ["cube", "can", "ball"]
    action = torch.zeros(16, 8)
    for _ in range(20):
        observation = env.step(observation.set("action", action))["next"]
    heights = observation["objects"].view(16, 3, 13)[..., 2]
    assert torch.allclose(heights, torch.tensor([0.02, 0.055, 0.03]).expand(16, 3), atol=1e-3)
    assert not observation["done"].any()


def test_the_printed_environment_of_a_preset(root: Path) -> None:
    page = (root / "docs" / "tasks.md").read_text()
    code = next(b for b in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "conf.compose" in b)
    names: dict = {}
    exec(code.replace("1024", "2"), names)
    env = names["env"]
    assert (env.config.task, env.config.episode_length, env.config.pose_noise) == ("lift", 90, 0.02)
    assert env.reset()["objects"].shape == (2, 13)


def test_the_printed_mesh(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (root / "docs" / "tasks.md").read_text()
    surface = next(b for b in re.findall(r"```text\n(.*?)```", page, re.DOTALL) if b.startswith("v "))
    scene = next(b for b in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if "file: wedge.obj" in b)
    (tmp_path / "wedge.obj").write_text(surface)
    monkeypatch.chdir(tmp_path)
    env = FrankaEnv(FrankaConfig(task="lift", scene=yaml.safe_load(scene)), num_envs=2, device="cpu")
    observation, action = env.reset(), torch.zeros(2, 8)
    for _ in range(10):
        observation = env.step(observation.set("action", action))["next"]
    assert torch.allclose(env.simulation.tensors.objects[:, 2], torch.tensor(0.015), atol=1e-3)


def test_the_printed_randomization(root: Path) -> None:
    page = (root / "docs" / "tasks.md").read_text()
    text = next(b for b in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if "object_size" in b)
    env = FrankaEnv(FrankaConfig(task="lift", **yaml.safe_load(text)), num_envs=4, device="cpu")
    env.reset()
    heights = env.simulation.tensors.objects[:, 2]
    assert heights.unique().numel() == 4 and ((heights - 0.02).abs() < 0.0041).all()


def test_the_printed_collisions(root: Path) -> None:
    page = (root / "docs" / "tasks.md").read_text()
    text = next(b for b in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if "collisions:" in b)
    config = FrankaConfig(gripper=True, observations=("state",), **yaml.safe_load(text))
    env = FrankaEnv(config, num_envs=2, device="cpu")
    assert env.simulation.model.shape_label.count("post") == 2
    assert "link5_8" in env.simulation.model.shape_label


def test_the_printed_scene_of_a_run(root: Path, tmp_path: Path, composed) -> None:
    page = (root / "docs" / "tasks.md").read_text()
    text = next(b for b in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if b.startswith("defaults:"))
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "kitchen.yaml").write_text(text)
    arm = RunSettings.of(composed(f"hydra.searchpath=[file://{tmp_path}]", "env=kitchen")).env.arm
    assert arm.task == "lift" and arm.resolved_scene is not None
    assert [(body.name, body.spread) for body in arm.resolved_scene.objects] == [("cube", (0.1, 0.15))]
    assert (arm.randomization.object_size, arm.randomization.color, arm.collisions) == (0.2, 0.2, "arm")


def test_the_printed_task_and_its_expert(printed_class, composed) -> None:
    topple = printed_class("Topple(TorchTask)", lines=40)
    config = RunSettings.of(composed("env=lift", "env.task=topple")).env.arm  # it has registered itself
    assert config.num_objects == 1 and config.resolved_scene is topple.scene
    env = FrankaEnv(config, num_envs=32, device="cpu", seed=0)
    played = play_episodes(env, ExpertPolicy(env.simulation.task, env.kinematics, config), seed=2)
    assert played["success_once"].mean() > 0.95
    observation = env.reset(seed=3)
    assert not observation["success"].any()
    for _ in range(10):
        observation = env.step(observation.set("action", torch.zeros(32, 8)))["next"]
    assert not observation["success"].any()  # nothing falls by itself
    assert env.reward(torch.zeros(32, 8)).shape == (32, 1)


def test_an_own_config_is_not_the_tasks_scene() -> None:
    scene = {"objects": [{"name": "brick", "size": [0.06, 0.03, 0.02], "at": [0.45, 0.1]}]}
    config = FrankaConfig.from_mapping({"task": "lift", "scene": scene})
    assert config.resolved_scene is not None
    assert [body.name for body in config.resolved_scene.objects] == ["brick"]
