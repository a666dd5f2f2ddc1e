"""What can be asked for, and one line for what cannot."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from franka_wm.device import resolve_device
from franka_wm.envs import FrankaConfig, FrankaEnv, tasks
from franka_wm.envs.tasks import Drawer, Reach, TorchTask
from franka_wm.errors import UserError

STATE = {"observations": ("state",)}


def one_line(error: UserError) -> str:
    text = str(error)
    assert text and "\n" not in text and len(text) < 300
    return text


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("substeps", -1),
        ("substeps", 0),
        ("substeps", 2.5),
        ("substeps", True),
        ("image_size", 0),
        ("image_size", -64),
        ("image_size", 100_000),
        ("action_scale", 0.0),
        ("action_scale", float("nan")),
        ("fps", 0),
        ("fps", "fast"),
        ("joint_armature", -0.1),
        ("target_ke", -1.0),
        ("target_ke", (1.0, 2.0)),
        ("target_kd", float("inf")),
        ("target_kd", "stiff"),
        ("target_ke", None),
        ("pose_noise", -0.1),
        ("goal", (0.3, 0.1)),
        ("goal", (0.3, 0.1, float("nan"))),
        ("goal", ("a", "b", "c")),
        ("goal", None),
        ("goal", 0.3),
        ("action_penalty", -1),
        ("camera_fov_degrees", 180),
        ("camera_distance", None),
        ("enable_shadows", "yes"),
        ("solver", "bullet"),
        ("robot", "ur5"),
        ("finger_opening", 0.5),
        ("observations", ()),
        ("observations", ("state", "state")),
        ("observations", ("touch",)),
        ("observations", "state"),
        ("observations", None),
        ("episode_length", 0),
        ("goal_sampling", "sometimes"),
        ("goal_noise", -1.0),
        ("success_distance", 0.0),
        ("terminate_on_success", 1),
        ("solver_iterations", 0),
        ("auto_reset", "maybe"),
    ],
)
def test_impossible_value(name: str, value: Any) -> None:
    with pytest.raises(UserError) as caught:
        FrankaConfig(**{name: value})
    assert name in one_line(caught.value)


def test_impossible_combinations() -> None:
    with pytest.raises(UserError):
        FrankaConfig(camera_distance=0.0, camera_height=0.5, camera_target_height=0.5)
    with pytest.raises(UserError):
        FrankaConfig(solver="featherstone", substeps=3)
    for gain in ("target_ke", "target_kd"):  # without one, no set point may lead: the arm would not move
        with pytest.raises(UserError, match="limit_velocity needs target_ke and target_kd above 0"):
            FrankaConfig(limit_velocity=True, **{gain: 0.0})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"task": "lift", "drawer_opening": 0.3},
            "drawer_opening=0.3: task=lift does not read it, drawer does; leave",
        ),
        ({"track_radius": 0.2}, "track_radius=0.2: task=reach does not read it, track does; leave it at 0.1"),
        ({"task": "peg", "track_period": 2.0}, "track_period=2.0: task=peg does not read it, track does"),
        (
            {"task": "drawer", "success_distance": 0.02},
            "task=drawer does not read it, reach, track",
        ),
        ({"goal_noise": 0.3}, "goal_noise=0.3: is for goals that are drawn"),
        ({"gripper_force": 30.0}, "gripper_force=30.0: needs the gripper; task=reach has none"),
        ({"max_contacts": 30}, "max_contacts=30: needs a scene; task=reach has none"),
        (
            {"task": "drawer", "end_when_lost": False},
            "end_when_lost=False: needs objects; task=drawer has none",
        ),
    ],
)
def test_an_option_that_the_task_does_not_read_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError) as caught:
        FrankaConfig(**STATE, **changes)
    assert said in one_line(caught.value)


def test_options_of_a_task_are_for_it_and_those_that_build_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    class Further(Drawer):
        pass

    class Other(TorchTask):
        own_options = ("track_radius",)
        goal = reward = success = lambda *_: None  # it is not played

    monkeypatch.setattr(tasks, "TASKS", [*tasks.TASKS])
    monkeypatch.setattr(tasks, "_REGISTERED", {})
    tasks.register("further", Further)
    tasks.register("other", Other)
    for task, name, value in (
        ("track", "track_radius", 0.2),
        ("track", "success_distance", 0.02),
        ("drawer", "drawer_opening", 0.3),
        ("further", "drawer_opening", 0.3),
        ("other", "track_radius", 0.2),
    ):
        assert getattr(FrankaConfig(**STATE, task=task, **{name: value}), name) == value
    with pytest.raises(UserError, match="task=other does not read it, drawer does"):
        FrankaConfig(**STATE, task="other", drawer_opening=0.3)


def test_config_is_frozen_and_takes_names_only() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        FrankaConfig().substeps = 3  # type: ignore[misc]
    with pytest.raises(TypeError):
        FrankaConfig(64)  # type: ignore[misc]


def test_unknown_field_lists_the_known() -> None:
    with pytest.raises(UserError) as caught:
        FrankaConfig.from_mapping({"substep": 4})
    text = str(caught.value)
    assert "'substep'" in text and "substeps" in text and "\n" not in text


def test_sequences_from_hydra_become_tuples() -> None:
    config = FrankaConfig.from_mapping(OmegaConf.create({"goal": [0.3, 0.1, 0.5], "target_ke": [1.0] * 7}))
    assert config.goal == (0.3, 0.1, 0.5) and config.gains("target_ke") == (1.0,) * 7
    assert hash(config) == hash(FrankaConfig(goal=(0.3, 0.1, 0.5), target_ke=(1.0,) * 7))


def test_the_yaml_lists_every_field_with_its_default(root: Path) -> None:
    values = OmegaConf.to_container(OmegaConf.load(root / "conf/env/franka.yaml"))
    assert isinstance(values, dict)
    assert values.pop("kind") == "franka" and values.pop("urdf_path") is None
    defaults = dataclasses.asdict(FrankaConfig())
    assert list(values) == list(defaults)
    assert FrankaConfig.from_mapping(values) == FrankaConfig()


def test_defaults_are_the_documented_ones() -> None:
    documented = {
        "image_size": 64,
        "action_scale": 0.25,
        "fps": 30,
        "substeps": 16,
        "joint_armature": 0.1,
        "target_ke": 800,
        "target_kd": 40,
        "pose_noise": 0.35,
        "goal": (0.30, 0.15, 0.55),
        "action_penalty": 0.01,
        "camera_distance": 1.15,
        "camera_height": 0.65,
        "camera_target_height": 0.45,
        "camera_fov_degrees": 60,
        "enable_shadows": False,
        "enable_textures": False,
        "solver": "auto",
        "asset_name": "franka_emika_panda",
        "urdf_relative_path": "urdf/fr3_franka_hand.urdf",
    }
    config = FrankaConfig()
    assert {name: getattr(config, name) for name in documented} == documented


@pytest.mark.parametrize("num_envs", [0, -3, 1.5, True, "8"])
def test_impossible_number_of_worlds(num_envs: Any) -> None:
    with pytest.raises(UserError) as caught:
        FrankaEnv(FrankaConfig(**STATE), num_envs=num_envs, device="cpu")
    assert "num_envs" in one_line(caught.value)


def test_a_task_that_no_plugin_registers_says_what_a_plugin_must_do() -> None:
    """Imported or not: a module that never calls register was imported in vain."""
    with pytest.raises(UserError, match=r"task='box': .*plugins=\[MODULE\].* must call register\(NAME, …\)"):
        FrankaConfig(task="box")


@pytest.mark.parametrize("task", ["lift", Reach])
def test_what_is_no_task_is_refused(task: Any) -> None:
    with pytest.raises(UserError, match=r"task=.*must be an instance of Task.*FrankaConfig\(task=NAME\)"):
        FrankaEnv(FrankaConfig(), num_envs=2, device="cpu", task=task)


def test_goal_out_of_reach() -> None:
    with pytest.raises(UserError) as caught:
        FrankaEnv(FrankaConfig(goal=(3.0, 0.0, 0.0), **STATE), device="cpu")
    assert "reach" in one_line(caught.value)


@pytest.mark.parametrize("device", ["tpu", "meta", "mps", "cpu:7"])
def test_impossible_device(device: str) -> None:
    with pytest.raises(UserError) as caught:
        resolve_device(device)
    assert "device=" in one_line(caught.value)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
@pytest.mark.parametrize("device", ["cuda", "cuda:1"])
def test_cuda_where_there_is_none(device: str) -> None:
    with pytest.raises(UserError) as caught:
        FrankaEnv(FrankaConfig(**STATE), device=device)
    assert "device=cpu" in one_line(caught.value)
    assert resolve_device(None) == resolve_device("auto") == torch.device("cpu")


def test_robot_that_needs_a_path() -> None:
    with pytest.raises(UserError) as caught:
        FrankaEnv(FrankaConfig(robot="urdf", **STATE), device="cpu")
    assert "urdf_path" in one_line(caught.value)
