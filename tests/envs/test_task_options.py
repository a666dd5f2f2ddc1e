"""Options that a task of one's own brings, and what is refused of such a task before anything is built."""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from franka_wm.data.lerobot.provenance import other_option
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.tasks import Task, TorchTask, register, task_class
from franka_wm.errors import UserError
from franka_wm.training.settings import RunSettings

STATE = {"observations": ("state",), "substeps": 2}


class Spot(TorchTask):
    """What a task in torch must define, and an option of each kind."""

    option_defaults = {"radius": 0.5, "turns": 2, "upright": True, "shape": "ring"}

    def goal(self, draws: torch.Tensor) -> torch.Tensor:
        return draws[:, :3] * 0.1 + self.options["radius"]

    def reward(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return state[..., 16] * self.options["turns"]

    def success(self, state: torch.Tensor) -> torch.Tensor:
        return state[..., 16] > self.options["radius"]


@pytest.fixture
def spot() -> None:
    register("spot", Spot)


def line(call: Callable[[], Any]) -> str:
    """The one line that a call is refused with."""
    with pytest.raises(UserError) as caught:
        call()
    text = str(caught.value)
    assert text and "\n" not in text and len(text) < 300
    return text


# -- options -------------------------------------------------------------------------------------------------


def test_defaults_are_overridden_by_the_config(spot: None) -> None:
    config = FrankaConfig(**STATE, task="spot", task_options={"radius": 1, "upright": False})
    assert Spot(config).options == {"radius": 1.0, "turns": 2, "upright": False, "shape": "ring"}
    assert isinstance(config.task_options["radius"], float), "as its default"
    assert replace(FrankaConfig(**STATE, task="spot"), task="reach").task_options == {}, (
        "none but those given"
    )
    assert Spot(FrankaConfig(**STATE)).options == Spot.option_defaults, "of one that the config does not name"
    same = FrankaConfig.from_mapping(json.loads(json.dumps(asdict(config))))
    assert same == config == replace(config) and hash(same) == hash(config)
    assert config != FrankaConfig(**STATE, task="spot")
    assert FrankaConfig().task_options == FrankaConfig(task_options=None).task_options == {}  # type: ignore[arg-type]


def test_goal_and_reward_read_them(spot: None) -> None:
    config = FrankaConfig(**STATE, task="spot", task_options={"radius": 0.3, "turns": 3})
    env = FrankaEnv(config, num_envs=2, device="cpu", seed=0)
    root = env.reset()
    assert ((root["goal"] >= 0.3) & (root["goal"] <= 0.4)).all()
    after = env.step(root.set("action", torch.zeros(2, 7)))["next"]
    torch.testing.assert_close(after["reward"], 3 * after["state"][:, 16:17])


HAS = "task=spot has radius=0.5, turns=2, upright=true, shape=ring"


@pytest.mark.parametrize(
    ("task", "options", "said"),
    [
        ("spot", {"radios": 0.6}, f"task_options.radios=0.6: no such option; {HAS}"),
        ("spot", {"radius": "wide"}, f"task_options.radius='wide': must be a finite number; {HAS}"),
        ("spot", {"radius": float("nan")}, f"task_options.radius=nan: must be a finite number; {HAS}"),
        ("spot", {"radius": None}, f"task_options.radius=None: must be a finite number; {HAS}"),
        ("spot", {"turns": 2.5}, f"task_options.turns=2.5: must be a whole number; {HAS}"),
        ("spot", {"turns": True}, f"task_options.turns=True: must be a whole number; {HAS}"),
        ("spot", {"upright": 1}, f"task_options.upright=1: must be true or false; {HAS}"),
        ("spot", {"shape": 3}, f"task_options.shape=3: must be text; {HAS}"),
        ("spot", [0.6], f"task_options=[0.6]: must be a mapping; {HAS}"),
        (
            "lift",
            {"radius": 0.6},
            "task_options.radius=0.6: no such option; task=lift has none; leave them out",
        ),
    ],
)
def test_what_the_task_does_not_have_is_refused(spot: None, task: str, options: Any, said: str) -> None:
    assert line(lambda: FrankaConfig(**STATE, task=task, task_options=options)) == said


def test_recordings_with_other_options_are_of_another_task(spot: None) -> None:
    def told(recorded: dict[str, Any], now: dict[str, Any] | None) -> tuple[str, Any] | None:
        env = vars(FrankaConfig(**STATE, task="spot", task_options=now or {}))
        return other_option([{"config": {"env": {"task": "spot", **recorded}}}], env)

    assert told({"task_options": {"radius": 0.6, "upright": True}}, None) == (
        "task_options",
        "{radius: 0.6, upright: true}",
    )
    assert told({}, {"radius": 0.6}) == ("task_options", "null"), "from before there were any"
    assert told({"task_options": None}, {"radius": 0.5}) is None, "a default that is typed is the same"
    assert told({"task_options": {"radius": 0.6}}, {"radius": 0.6, "turns": 2}) is None


def test_the_printed_preset(
    root: Path, tmp_path: Path, composed: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """``box.py``, ``ring.py`` and ``mine/env/ring.yaml`` of docs/tasks.md, and the options of its commands."""
    page = (root / "docs" / "tasks.md").read_text()
    files = {"box.py": "class Box(", "ring.py": "class Ring(", "mine/env/ring.yaml": "task: ring"}
    blocks = re.findall(r"```(?:python|yaml)\n(.*?)```", page, re.DOTALL)
    (tmp_path / "mine" / "env").mkdir(parents=True)
    for name, part in files.items():
        (tmp_path / name).write_text(next(block for block in blocks if part in block))
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("ring")

    def arm(*overrides: str) -> FrankaConfig:
        return RunSettings.of(composed(f"hydra.searchpath=[file://{tmp_path}/mine]", *overrides)).env.arm

    ring = re.findall(r"env=ring (env\.task_options\S+?)`", page)
    whole = re.findall(r"env=reach env\.task=ring '(env\.task_options=.+?)'", page)
    assert len(ring) == len(whole) == 1
    preset = arm("env=ring")
    assert (preset.task, preset.episode_length, preset.task_options["ring_radius"]) == ("ring", 40, 0.2)
    for config in (arm("env=ring", *ring), arm("env=reach", "env.task=ring", *whole)):
        assert config.task_class(config).options == {"ring_radius": 0.15, "ring_height": 0.5}
    env = FrankaEnv(arm("env=ring", *ring), num_envs=16, device="cpu", seed=0)
    away = env.reset()["goal"] - torch.tensor([0.4, 0.0, 0.5])
    torch.testing.assert_close(away.norm(dim=-1), torch.full((16,), 0.15))


def test_the_preset_of_the_example(root: Path, composed: Callable[..., Any]) -> None:
    register("raise_tool", importlib.import_module("examples.add_a_task").RaiseTool)
    place = f"hydra.searchpath=[file://{root}/examples/conf]"
    arm = RunSettings.of(composed(place, "env=raise_tool", "env.task_options.height=0.8")).env.arm
    env = FrankaEnv(arm, num_envs=1, device="cpu", seed=0)
    assert env.reset()["goal"][0, 2] == pytest.approx(0.8)


# -- classes and names ---------------------------------------------------------------------------------------


def test_a_name_of_the_package_is_refused_one_of_ones_own_is_not() -> None:
    assert line(lambda: register("reach", Spot)) == (
        "register('reach', …): the package has this name; choose another"
    )
    register("spot", Spot)
    again = type("Again", (Spot,), {})
    register("spot", again)
    assert task_class("spot") is again and FrankaConfig(task="spot").task_class is again


def test_an_own_option_that_no_task_of_the_package_reads_points_to_the_new_way() -> None:
    ring = type("Ring", (Spot,), {"own_options": ("success_distance", "ring_radius")})
    said = line(lambda: register("ring", ring))
    assert said.startswith("Ring.own_options: ring_radius is none of success_distance, track_radius")
    assert "Ring.option_defaults" in said and "'env.task_options={ring_radius: …}' sets it" in said


@pytest.mark.parametrize(
    ("base", "defined", "said"),
    [
        (TorchTask, ("reward", "success"), "define goal, reward and success; goal is missing"),
        (TorchTask, ("goal",), "define goal, reward and success; reward and success are missing"),
        (Task, ("reset",), "define reset and reward_and_success; reward_and_success is missing"),
    ],
)
def test_what_a_task_must_define(base: type[Task], defined: tuple[str, ...], said: str) -> None:
    ring = type("Ring", (base,), {name: lambda *_: None for name in defined})
    assert line(lambda: register("ring", ring)) == f"Ring must {said}"
    further = type("Further", (ring,), {})
    assert line(lambda: register("ring", further)) == f"Further must {said}"
    if base is TorchTask:  # given as an object, too
        assert line(lambda: ring(FrankaConfig(**STATE))) == f"Ring must {said}"


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("rewards", lambda self, state: state, "must be a tuple of words, .*; the function is called reward"),
        ("rewards", "dense", "rewards='dense': must be a tuple of words"),
        ("own_options", "disc_radius", "own_options='disc_radius': must be a tuple of words"),
        ("option_defaults", ("radius",), "must be a mapping, such as {'radius': 0.5}"),
        (
            "option_defaults",
            {"place": (0.1, 0.2)},
            r"place is \(0.1, 0.2\); must be one of: .*a finite number",
        ),
        ("options", {"radius": 0.5}, "Ring.options: is read; name the defaults option_defaults"),
    ],
)
def test_what_a_class_says_must_be_of_its_kind(name: str, value: Any, said: str) -> None:
    assert re.search(said, line(lambda: type("Ring", (Spot,), {name: value})))


def test_options_are_not_set_by_a_constructor(spot: None) -> None:
    def constructor(self: Task, config: FrankaConfig) -> None:
        self.options = {"radius": 1.0}  # type: ignore[assignment]

    ring = type("Ring", (Spot,), {"__init__": constructor})
    assert (
        line(lambda: ring(FrankaConfig(**STATE)))
        == "Ring.options: is read; name the defaults option_defaults"
    )


def test_a_part_in_warp_needs_no_functions() -> None:
    parts = {name: lambda *_: None for name in ("goal", "reward_and_success")}
    type("Mixed", (TorchTask,), parts).check_defined()
    said = line(lambda: type("Half", (TorchTask,), {"reward_and_success": parts["goal"]}).check_defined())
    assert said == "Half must define goal; goal is missing"
