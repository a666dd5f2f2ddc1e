"""A run's worlds: which processes they have, and what is asked before they are built."""

from __future__ import annotations

import multiprocessing
import sys
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from franka_wm.conf import compose
from franka_wm.device import prefer_speed
from franka_wm.errors import FrankaError, UserError
from franka_wm.training import build
from franka_wm.training.checkpoint import load_checkpoint, save_checkpoint
from franka_wm.training.place import left_by, make_absolute, occupied
from franka_wm.training.run import Run, import_plugins, open_loggers, resumed
from franka_wm.training.settings import RunSettings
from franka_wm.training.spaces import Spaces
from small_checkpoint import save


@pytest.mark.parametrize("workers", [0, 2])
def test_worlds_of_other_libraries_have_processes_of_their_own_if_asked(workers: int, tmp_path: Path) -> None:
    """Those of training alone: the evaluation's worlds step in this one."""
    words = (
        "env=gym",
        "collector.num_envs=4",
        "evaluation.episodes=2",
        f"collector.workers={workers}",
    )
    before = set(multiprocessing.active_children())
    settings = RunSettings.of(compose("scale=smoke", "device=cpu", *words))
    env, eval_env = Run(settings, tmp_path).build_environments()
    assert env is not None and eval_env is not None
    try:
        assert len(set(multiprocessing.active_children()) - before) == workers
        assert Spaces.of_env(env) == Spaces.of_env(eval_env)
    finally:
        env.close()
        eval_env.close()


def test_recorded_data_are_opened_before_worlds_are_built(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """What is wrong with them is a line in seconds, not after minutes of compiling."""

    def opened(*_: object) -> None:
        raise UserError("damaged")

    monkeypatch.setattr(build, "open_recorded", opened)
    monkeypatch.setattr(build, "make_evaluation_env", lambda *_: pytest.fail("built"))
    arguments = ("scale=smoke", "device=cpu", "dataset=lerobot", "dataset.root=there", "trainer=offline")
    with pytest.raises(UserError, match="damaged"):
        Run(RunSettings.of(compose(*arguments)), tmp_path).build_environments()


def test_values_of_a_resumed_run_keep_their_range(settled, tmp_path: Path, capsys) -> None:
    """With another discount, or other bounds of rewards, the same outputs would stand for other values."""
    settings = settled("scale=smoke", "device=cpu", "env=reach_fixed")
    here = Spaces.of_config(settings.env.arm, discrete=False)
    began = replace(here, episode_length=100, reward_bounds=(-9.0, 0.0))
    saved = save(tmp_path / "checkpoint", extra={"spaces": began.as_dict()})
    run = Run(settings, tmp_path, load_checkpoint(saved))
    assert run.as_saved(here) == began
    assert (
        f"follow: episode_length=100 (here {here.episode_length}), reward_bounds=(" in capsys.readouterr().out
    )
    assert run.as_saved(began) == began and not capsys.readouterr().out
    models = [build.make_model(settings, spaces) for spaces in (run.as_saved(here), began, here)]
    assert models[0].two_hot.support.equal(models[1].two_hot.support)
    assert not models[0].two_hot.support.equal(models[2].two_hot.support)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ("one", "must be a list of modules"),
        (5, "must be a list of modules"),
        (None, "must be a list of modules"),
        ([5], "must be a list of modules"),
        ([""], "must be a list of modules"),
        ([".x"], "must be a list of modules"),
        (["no_such_module_of_mine"], "no module 'no_such_module_of_mine'"),
        (["torn"], "torn fails: SyntaxError: "),
        (["raising"], r"raising fails: ValueError: boom \(.*raising.py, line 1\)"),
        (["leaving"], "leaving fails: SystemExit: 3"),
        (["lacking"], "lacking fails: No module named 'not_there'; install it, or mend lacking"),
    ],
)
def test_plugins_that_cannot_be_imported_are_one_line(names, said: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    texts = {"torn": "def f(:", "raising": "raise ValueError('boom')", "leaving": "raise SystemExit(3)"}
    texts["lacking"] = "import not_there"
    for name, text in texts.items():
        (tmp_path / f"{name}.py").write_text(text)
    with pytest.raises(UserError, match=said) as caught:
        import_plugins(names)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("word", "instead"),
    [
        ("scale=gpu", ""),
        ("size=gpu", ""),
        ("seed=7", ""),
        ("planner=icem", r", or change single values \(planner.key=…\)"),
    ],
)
def test_a_resumed_run_keeps_what_it_was(word: str, instead: str, tmp_path: Path) -> None:
    """The weights are of the first seed and scale, whatever the folder of the second would say."""
    words = ("scale=smoke", "device=cpu", "env=reach_fixed", "seed=0")
    began = OmegaConf.create(OmegaConf.to_container(compose(*words), resolve=True))
    save_checkpoint(tmp_path, model=torch.nn.Linear(1, 1), config=began, counters={})
    cfg = compose(f"resume={tmp_path}", word)
    kept = f"{word}: a run that resumes keeps its {word.partition('=')[0]}; leave it out{instead}$"
    with pytest.raises(FrankaError, match=kept):
        resumed(cfg, [f"resume={tmp_path}", word])
    same = [f"resume={tmp_path}", "scale=smoke", "seed=0", "trainer.updates=50"]
    _, merged = resumed(compose(*same), same)
    assert merged.trainer.updates == 50 and merged.seed == 0
    save_checkpoint(tmp_path, model=torch.nn.Linear(1, 1), config=began, counters={"updates": 80.0})
    assert resumed(compose(*same), same)[1].trainer.updates == 80, (
        "what is written is what the weights have had"
    )


def test_what_a_model_had_found_itself_is_told_from_what_was_asked_for(tmp_path: Path) -> None:
    began = OmegaConf.create(OmegaConf.to_container(compose("scale=smoke", "device=cpu"), resolve=True))
    began.model.value_low, began.model.value_high, began.derived = -3.2, 3.2, ["value_high", "value_low"]
    save_checkpoint(tmp_path, model=torch.nn.Linear(1, 1), config=began, counters={})
    for words, derived in (
        ([], ["value_high", "value_low"]),
        (["model.value_low=-9"], ["value_high"]),
    ):
        words = [f"resume={tmp_path}", *words]
        assert resumed(compose(*words), words)[1].derived == derived
    began.derived = {"value_high": 1}
    save_checkpoint(tmp_path, model=torch.nn.Linear(1, 1), config=began, counters={})
    with pytest.raises(UserError, match="is no list of names"):
        resumed(compose(words[0]), words[:1])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["model.observations=[pixels,pixels_wrist,state]"], ["state in model.observations"]),
        (
            ["model.observations=[pixels,goal]", "env.show_goal=true"],
            ["goal in model.observations", "env.show_goal=true"],
        ),
        (["model.observations=[pixels,pixels_wrist,joint_target]"], []),
    ],
)
def test_what_tells_a_goal_beside_its_image_is_said(words: list[str], told: list[str], settled) -> None:
    assert settled("env=push_goal_image", "model=lewm", *words).told_beside_image == told
    assert not settled("env=push_pixels", "model=tdmpc2_pixels", *words).told_beside_image
    assert not settled("env=reach_fixed_goal_image", "model=lewm", *words).told_beside_image


def test_a_value_means_the_same_with_resume(tmp_path: Path) -> None:
    """Hydra's grammar, not YAML's; and what is Hydra's own is none of the run's."""
    words = ("scale=smoke", "device=cpu", "env=reach_fixed")
    began = OmegaConf.create(OmegaConf.to_container(compose(*words), resolve=True))
    save_checkpoint(tmp_path, model=torch.nn.Linear(1, 1), config=began, counters={})
    resume = f"resume={tmp_path}"

    def merged(*more: str) -> Any:
        cfg = compose(resume, *[word for word in more if not word.startswith("hydra")])
        return resumed(cfg, [resume, *more])[1]

    found = merged("trainer.schedule=no", "trainer.lr=1e-3", "env.home=[0,1]", "hydra/launcher=joblib")
    assert found.trainer.schedule == "no" and found.trainer.lr == 1e-3 and found.env.home == [0, 1]
    assert found.keys() == began.keys() and merged("hydra.sweep.dir=x").keys() == began.keys()
    with pytest.raises(FrankaError, match=r"~trainer\.schedule: a run that resumes keeps all its options"):
        merged("~trainer.schedule")


def test_the_first_steps_are_learned_before_more_is_gathered(train, tmp_path: Path, monkeypatch) -> None:
    """Three batches of five steps of three worlds, each before ten updates; the second is not gathered."""
    gathered, fast = [], []

    def asked(device: torch.device, *, onednn: bool) -> None:
        fast.append((device, onednn))

    monkeypatch.setattr("franka_wm.training.run.prefer_speed", asked)
    for updates in (0, 11):  # the second in whole batches of updates
        words = (f"collector.seed_updates={updates}", "evaluation.during=[]", f"trainer.onednn={updates > 0}")
        saved = train(*words, folder=tmp_path / f"{updates}")
        run = RunSettings.of(saved.config, saved=True)
        assert saved.counters["updates"] == run.trainer.updates == 30
        assert saved.counters["env_steps"] == run.collector.num_envs * run.planned_steps()
        gathered.append(saved.counters["env_steps"])
    assert gathered[0] - gathered[1] == 3 * 5
    assert fast == [(torch.device("cpu"), False), (torch.device("cpu"), True)]


@pytest.mark.parametrize(("device", "fast"), [("cuda:0", True), ("cpu", False)])
def test_what_a_gpu_may_round_and_try(device: str, fast: bool, monkeypatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(torch, "set_float32_matmul_precision", asked.append)
    monkeypatch.setattr(torch.backends.cudnn, "benchmark", False)
    prefer_speed(torch.device(device))
    assert (asked, torch.backends.cudnn.benchmark) == (["high"] * fast, fast)


@pytest.mark.parametrize(
    ("words", "updates", "steps"),
    [
        (["collector.seed_updates=0"], 0, 15),
        (["collector.seed_updates=30"], 0, 5),  # that of the untrained actor
        (["collector.seed_updates=11"], 20, 5),  # those after 20
        (["collector.seed_updates=11"], 5, 10),  # resumed without replay: anew
        (["replay.demos=there", "replay.demo_updates=20"], 0, 10),
    ],
)
def test_room_is_asked_for_what_will_be_gathered(words: list[str], updates: int, steps: int, settled) -> None:
    run = settled("device=cpu", "scale=smoke", *words)
    assert run.planned_steps(updates) == run.collector.seed_steps + steps


def test_a_first_stage_gathers_all_the_time(settled) -> None:
    """What the second stage's policy learns alone, or from demonstrations, is no matter of an encoder's."""
    words = (
        "experiment=two_stages",
        "collector.seed_updates=20",
        "replay.demos=there",
        "replay.demo_updates=20",
    )
    run = settled("device=cpu", "scale=smoke", *words)
    assert run.updates_alone == 20 and run.first_stage().updates_alone == 0


def test_a_robot_of_ones_own_is_found_from_any_folder(train, tmp_path: Path) -> None:
    """And no other one by that name is taken for it."""
    (tmp_path / "robot").mkdir()
    text = (files("franka_wm.envs.robots") / "fr3.urdf").read_text()
    (tmp_path / "robot" / "own.urdf").write_text(text)
    words = ("env.robot=urdf", "env.urdf_path=robot/own.urdf", "evaluation.during=[]")
    saved = train(*words, "trainer.updates=10")
    assert saved.config["env"]["urdf_path"] == str(tmp_path / "robot" / "own.urdf")
    typed = OmegaConf.create(OmegaConf.to_container(OmegaConf.load(tmp_path / "run" / "config.yaml")))
    typed.env.urdf_path = "robot/own.urdf"
    assert left_by(tmp_path / "run", typed) == "finished"  # the same command again
    assert typed.env.urdf_path == "robot/own.urdf"


def test_files_anywhere_in_an_environment_are_named_from_the_root(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("wedge.obj", "embedded"):
        (tmp_path / name).touch()
    scene = {"objects": [{"name": "wedge", "file": "wedge.obj", "at": [0.4, 0.0]}], "same": "${env.robot}"}
    cfg = OmegaConf.create({"env": {"robot": "embedded", "scene": scene, "goal": None}})
    make_absolute(cfg)
    scene["objects"][0]["file"] = str(tmp_path / "wedge.obj")
    assert OmegaConf.to_container(cfg.env) == {"robot": "embedded", "scene": scene, "goal": None}


def test_a_run_does_not_write_into_a_dataset(tmp_path: Path) -> None:
    """What it leaves would be published with that."""
    assert occupied(tmp_path, None) is None
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").touch()
    assert "a dataset is there; choose another folder" in (occupied(tmp_path, None) or "")


@pytest.mark.parametrize(("first_stage", "updates"), [(None, None), (False, 30), (True, 0)])
def test_loggers_are_told_from_where_a_run_goes_on(
    first_stage: bool | None, updates: int | None, settled, tmp_path: Path, monkeypatch
) -> None:
    """A first stage logs nothing, so that all there is comes after it."""
    told: list[object] = []
    monkeypatch.setattr(
        "franka_wm.training.run.make_loggers", lambda *given, **named: told.append(named.get("updates")) or []
    )
    config = {"whole_run": {}} if first_stage else {}
    checkpoint: Any = None
    if first_stage is not None:
        checkpoint = SimpleNamespace(config=config, counters={"updates": 30.0})
    assert open_loggers(settled("scale=smoke"), tmp_path, checkpoint) == [] and told == [updates]
