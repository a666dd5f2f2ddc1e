"""``--config-dir``: presets of one's own, in a run that is checked, scaled and started like any other."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from omegaconf import OmegaConf

from franka_wm.commands import entry, launching, several
from franka_wm.commands import sweep as sweeps
from franka_wm.commands.sweep import Sweep


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A command line with a preset of a folder, in which the command is typed."""
    (tmp_path / "my presets" / "env").mkdir(parents=True)
    (tmp_path / "my presets" / "env" / "kitchen.yaml").write_text("defaults: [lift, _self_]\nfps: 20.0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py"])
    return ["--config-dir=my presets", "env=kitchen", "device=cpu"]


def test_the_scale_is_that_of_the_device(mine: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    begun = []
    entry._run(lambda: begun.append(sys.argv[1:]), mine)
    assert "scale=laptop" in begun[0] and mine[0] in begun[0]
    assert "scale=laptop, by the device" in capsys.readouterr().out


def test_several_processes_are_started(mine: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the command again find the preset, too."""
    started = []
    monkeypatch.setattr(
        launching, "launch", lambda flags, overrides, gpus, _: started.append((overrides, gpus))
    )
    entry._run(lambda: pytest.fail("one process"), [*mine, "gpus=2"])
    [(overrides, gpus)] = started
    assert gpus == 2
    assert several.wanted(overrides) == (2, "cpu")
    assert entry.with_folder(entry.hydra_flags([mine[0], *overrides])) == overrides


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["env.fsp=20"], "env.fsp: no such option; did you mean env.fps?"),
        (
            ["env.scene.objects=[]"],
            "env.scene.objects: no such option; did you mean env.scene?",
        ),  # null there
        (["env.fps=0"], "fps=0: must be above 0"),
        (["hydra.searchpath=[file://other]"], "name all folders in hydra.searchpath="),
    ],
)
def test_what_cannot_be_is_one_line(words: list[str], said: str, mine: list[str], capsys) -> None:
    with pytest.raises(SystemExit):
        entry._run(lambda: pytest.fail("begun"), [*mine, *words])
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
    for path in ("file://nowhere", "nowhere", "file://my presets/env/kitchen.yaml"):
        with pytest.raises(SystemExit):
            entry._run(
                lambda: pytest.fail("begun"), ["device=cpu", "env=kitchen", f"hydra.searchpath=['{path}']"]
            )
        folder = path.removeprefix("file://")
        there = f"(looked for from {Path.cwd()})"
        said = f"error: hydra.searchpath: {folder}: no such folder {there}, and no such package\n"
        assert capsys.readouterr().err == said
    for sign in ("+", "++", "~"):  # Hydra would not look there
        path = f"{sign}hydra.searchpath=[file://my presets]"
        with pytest.raises(SystemExit):
            entry._run(lambda: pytest.fail("begun"), ["device=cpu", "env=reach", path])
        said = capsys.readouterr().err
        assert said == f"error: {path}: write hydra.searchpath=[file://FOLDER], without {sign[0]}\n"
    with pytest.raises(SystemExit):
        entry._run(lambda: pytest.fail("begun"), ["--config-dir=nowhere"])
    assert capsys.readouterr().err == "error: --config-dir=nowhere: no such folder\n"


def test_a_job_of_several_processes_finds_the_presets_of_its_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = "hydra.searchpath=[file://mine]"
    told: Any = SimpleNamespace(
        job=SimpleNamespace(num=0), runtime=SimpleNamespace(output_dir=str(tmp_path / "0")),
        sweep=SimpleNamespace(dir=str(tmp_path)),
        overrides=SimpleNamespace(task=["env=kitchen", "gpus=2"], hydra=["hydra.mode=MULTIRUN", path]),
    )  # fmt: skip
    monkeypatch.setattr(sweeps.HydraConfig, "get", lambda: told)
    started = []
    monkeypatch.setattr(launching, "launch_job", lambda overrides, cfg, folder: started.append(overrides))
    Sweep(["job 0"], [tmp_path / "0"]).run(
        lambda cfg: None, OmegaConf.create({"resume": None, "gpus": 2, "device": "cpu"})
    )
    assert started == [["env=kitchen", "gpus=2", path]]


def test_a_preset_that_is_not_yaml_is_one_line_with_its_place(mine: list[str], capsys) -> None:
    path = Path("my presets/env/kitchen.yaml")
    path.write_text("fps: 20.0\n  horizon: [3\n")
    with pytest.raises(SystemExit):
        entry._run(lambda: pytest.fail("begun"), mine)
    said = capsys.readouterr().err
    assert said.startswith("error: ") and f"{path.resolve()}, line 2: not YAML (mapping values" in said
    assert said.count("\n") == 1


def test_what_an_experiment_of_ones_own_sets_at_the_top_counts(
    mine: list[str], registries_as_before: None
) -> None:
    """Among it the modules to import: without them its task would not be known."""
    Path("own_box.py").write_text(
        "from franka_wm.envs.tasks import Reach, register\nregister('own_box', type('Box', (Reach,), {}))\n"
    )
    Path("my presets/experiment").mkdir()
    Path("my presets/experiment/own.yaml").write_text(
        "# @package _global_\nplugins: [own_box]\nseed: 7\nsize: smoke\nenv: {task: own_box}\n"
    )
    begun = []
    words = [mine[0], "experiment=own", "device=cpu"]
    entry._run(lambda: begun.append(entry.compose(sys.argv[2:])), words)
    [cfg] = begun
    assert cfg.plugins == ["own_box"] and (cfg.seed, cfg.size, cfg.env.task) == (7, "smoke", "own_box")
    entry._run(lambda: begun.append(entry.compose(sys.argv[2:])), [*words, "seed=3"])
    assert begun[-1].seed == 3
