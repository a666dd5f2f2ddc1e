"""The configuration's files: everything composes, columns follow scale and size, experiments are what was measured."""

from __future__ import annotations

import re
import shlex
from itertools import product
from pathlib import Path

import hydra
import pytest
import yaml
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from franka_wm.conf import FOLDER, SCALES, compose, hydra_session, use_present_names
from franka_wm.errors import UserError

ROOT = Path(__file__).resolve().parents[1]
ROWS = {
    "discrete_actions": "muzero-gpu",
    "cartpole": "cartpole-cpu",
    "images_fixed": "images-fixed-gpu",
    "images": "images-goal-gpu",
    "goal_image": "lewm-gpu",
    "two_stages": "action-world-model-gpu",
    "control_suite": "reacher-hard-gpu",
    "control_suite_dreamer": "dreamer-walker-gpu",
    "push": "push-gpu",
    "lift": "lift-gpu",
    "demonstrations": "pick-demos-gpu",
}
"""Experiment → the row of the results that measured it, or will."""
TASKS = {"control_suite_dreamer": ("env.name=walker", "env.task=walk")}
"""What is typed beside an experiment's name in its row's command."""
OF_MEASURING = ("evaluation.episodes", "evaluation.during", "trainer.checkpoint_replay", "device")


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (FOLDER / group).glob("*.yaml"))


def flat(cfg: object, name: str = "") -> dict[str, object]:
    """Every value, resolved, by its dotted name."""
    values = OmegaConf.to_container(cfg, resolve=True) if OmegaConf.is_config(cfg) else cfg  # type: ignore[arg-type]
    if not isinstance(values, dict) or not values:
        return {name: values}
    return {k: v for key, value in values.items() for k, v in flat(value, f"{name}.{key}".strip(".")).items()}


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("model", options("model"))
def test_every_model_at_every_scale(scale: str, model: str) -> None:
    values = flat(compose(f"model={model}", f"scale={scale}"))
    assert values["scale"] == values["size"] == scale
    assert values["model.name"] == model.removesuffix("_pixels").replace("vjepa", "jepa").replace(
        "lejepa", "jepa"
    )
    assert not [value for value in values.values() if isinstance(value, str) and "${" in value]


@pytest.mark.parametrize("scale", SCALES)
def test_every_planner_and_first_stage_at_every_scale(scale: str) -> None:
    for group in ("planner", "pretrain"):
        for name in options(group):
            assert flat(compose(f"{group}={name}", f"scale={scale}"))["scale"] == scale


@pytest.mark.parametrize(
    ("name", "measured_by", "words"),
    [
        *((name, ROWS[name], TASKS.get(name, ())) for name in options("experiment")),
        ("demonstrations", "drawer-demos-gpu", ("env=drawer", "replay.demos=datasets/drawer")),
        ("demonstrations", "push-demos-cpu", ("env=push", "replay.demos=datasets/push")),
    ],
)
def test_an_experiment_is_its_measured_row(name: str, measured_by: str, words: tuple[str, ...]) -> None:
    rows = yaml.safe_load((ROOT / "benchmarks" / "results" / "rows.yaml").read_text(encoding="utf-8"))
    row = rows["rows"][measured_by]
    section = shlex.split(rows["sections"][row["section"]]["arguments"])
    scale = next(word for word in section if word.startswith("scale="))
    measured = flat(compose(*section, *shlex.split(row["arguments"])))
    named = flat(compose(f"experiment={name}", scale, *words))
    assert {k: v for k, v in named.items() if k not in OF_MEASURING} == {
        k: v for k, v in measured.items() if k not in OF_MEASURING
    }


@pytest.mark.parametrize("env", ["lift", "push"])
def test_a_task_with_a_gripper_is_its_measured_row_but_for_time(env: str) -> None:
    """How long and how fast it trains stands in the row's command: docs/tasks.md says so."""
    rows = yaml.safe_load((ROOT / "benchmarks" / "results" / "rows.yaml").read_text(encoding="utf-8"))["rows"]
    measured = flat(compose("scale=gpu", *shlex.split(rows[f"{env}-gpu"]["arguments"])))
    named = flat(compose(f"env={env}", "scale=gpu"))
    of_time = {f"trainer.{name}" for name in ("updates", "updates_per_batch", "precision", "compile")}
    assert {k for k in named if named[k] != measured[k]} - set(OF_MEASURING) <= of_time


@pytest.mark.parametrize(("name", "scale"), list(product(options("experiment"), SCALES)))
def test_every_experiment_at_every_scale(name: str, scale: str) -> None:
    found = flat(compose(f"experiment={name}", f"scale={scale}"))
    assert found["scale"] == scale
    if scale == "smoke":  # everything once, in a minute
        assert found["trainer.updates"] <= 30 and (found["collector.seed_updates"] or 0) <= 30
        assert not found["trainer.compile"] and not found.get("planner.compile", False)


def test_what_is_typed_wins_over_what_is_tuned() -> None:
    typed = ("env=gym", "model=muzero", "planner=gumbel", "scale=laptop")
    assert compose(*typed).model.n_step == 50
    assert compose(*typed, "model.n_step=7").model.n_step == 7
    assert compose(*typed, "~tuned/task").model.n_step == 5
    assert compose("experiment=cartpole", "trainer.updates=9").trainer.updates == 9


def test_a_model_of_another_size() -> None:
    cfg = compose("scale=gpu", "size=laptop")
    assert (cfg.model.latent_dim, cfg.trainer.updates, cfg.model.lr) == (128, 12_000, 6.0e-4)


def test_a_scale_of_ones_own(tmp_path: Path) -> None:
    own = tmp_path / "scale" / "mine.yaml"
    own.parent.mkdir()
    own.write_text("# @package _global_\ndefaults: [laptop, _self_]\ntrainer: {updates: 77}\n")
    cfg = compose(f"hydra.searchpath=[file://{tmp_path}]", "scale=mine")
    assert (cfg.trainer.updates, cfg.model.latent_dim) == (77, 128)


def test_a_smoke_run_evaluates_each_task_once() -> None:
    assert compose("scale=smoke").evaluation.episodes == 4
    assert compose("scale=smoke", "env=multitask").evaluation.episodes == 8
    assert compose("scale=smoke", "env=multitask", "~env.tasks.peg").evaluation.episodes == 7
    assert compose("scale=smoke", "env=multitask", "evaluation.episodes=9").evaluation.episodes == 9


def test_an_unknown_size_says_which_there_are() -> None:
    with pytest.raises(OmegaConfBaseException, match="size=huge: must be one of smoke, laptop, gpu"):
        OmegaConf.to_container(compose("size=huge"), resolve=True)


def test_a_pretrained_encoder_has_the_scales_size() -> None:
    cfg = compose("pretrain=vjepa", "model=action_world_model", "scale=smoke")
    assert (cfg.pretrain.updates, cfg.pretrain.model.encoder_width, cfg.pretrain.model.window) == (10, 24, 8)


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("env=psuh", "env=psuh: must be one of .*push.*; did you mean push[?]"),
        (
            "env.episode_lenght=10",
            "env[.]episode_lenght: no such option; did you mean env[.]episode_length[?]",
        ),
    ],
)
def test_an_override_that_cannot_be_is_one_line(override: str, line: str) -> None:
    """As on the command line."""
    with pytest.raises(UserError) as caught:
        compose("model=tdmpc2", override)
    assert re.fullmatch(line, str(caught.value)), caught.value


def test_an_option_by_its_former_name_names_the_present_one() -> None:
    with pytest.raises(
        UserError, match=r"model\.fresh_values=true: this option is now called model\.reanalyze"
    ):
        compose("model=muzero", "model.fresh_values=true")


def test_checkpoints_with_former_names_are_read_with_the_present_ones() -> None:
    old = {"model": {"name": "muzero", "fresh_values": True, "unroll": 3}, "collector": {"acts": "ik"}}
    config = OmegaConf.create({**old, "whole_run": old})
    use_present_names(config)
    present = {"name": "muzero", "reanalyze": True, "unroll": 3}
    assert config.model == present and config.whole_run.model == present
    assert config.collector == config.whole_run.collector == {"policy": "ik"}


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("env=dm_control", "env.name=walker", "env.task=walk"), "walker-walk"),
        (("env=gym", "env.name=ALE/Pong-v5"), "ALE-Pong-v5"),
        (("env=push", "env.task=pick"), "push"),
        (("env=none",), "none"),
    ],
)
def test_a_run_s_folder_is_called_by_what_it_simulates(
    words: tuple[str, ...], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With another library by the name there: all of the DeepMind Control Suite were ``dm_control``."""
    with hydra.initialize_config_dir(str(FOLDER), version_base="1.3"):
        cfg = hydra.compose("config", [*words, "seed=4", "hydra.job.num=2"], return_hydra_config=True)
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)
    HydraConfig.instance().set_config(cfg)
    assert Path(cfg.hydra.run.dir).name[9:] == f"{name}-4"  # behind the time
    assert cfg.hydra.sweep.subdir == f"2-{name}"


def test_a_session_leaves_hydra_as_it_was(monkeypatch) -> None:
    """A run in progress has told it of its job."""
    monkeypatch.setattr(HydraConfig.instance(), "cfg", "the job's")
    with hydra_session() as loader:
        HydraConfig.instance().cfg = "another's"
        assert "mppi" in loader.get_group_options("planner")
    assert HydraConfig.instance().cfg == "the job's" and not GlobalHydra.instance().is_initialized()
