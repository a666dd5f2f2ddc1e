"""Which scale a command has: the user's, else an experiment's, else the device's."""

from __future__ import annotations

from pathlib import Path

import pytest

from franka_wm.commands.entry import with_scale
from franka_wm.commands.overrides import compose
from franka_wm.errors import UserError


def test_scale_is_chosen_by_the_device(capsys) -> None:
    assert with_scale(["scale=smoke", "seed=1"]) == ["scale=smoke", "seed=1"]
    assert capsys.readouterr().out == ""
    assert with_scale(["device=cpu"]) == ["device=cpu", "scale=laptop"]
    assert "scale=laptop" in capsys.readouterr().out
    assert with_scale(["device=cuda", "scale=auto"]) == ["device=cuda", "scale=gpu"]


def experiment(folder: Path, name: str, scale: str | None) -> str:
    """The override that lets Hydra find it."""
    (folder / "experiment").mkdir(exist_ok=True)
    chosen = "" if scale is None else f"defaults:\n  - override /scale: {scale}\n"
    (folder / "experiment" / f"{name}.yaml").write_text(f"# @package _global_\n{chosen}seed: 7\n")
    return f"hydra.searchpath=[file://{folder}]"


def test_the_scale_of_an_experiment_goes_before_the_devices_and_the_users_before_both(
    capsys, tmp_path: Path
) -> None:
    for name, scale in (("small", "smoke"), ("same", "laptop"), ("plain", None)):
        found = experiment(tmp_path, name, scale)
    for device in ("cpu", "cuda"):
        words = [found, f"device={device}"]
        for name, scale in (("small", "smoke"), ("same", "laptop")):
            command = with_scale([*words, f"experiment={name}"])
            assert f"scale={scale}, by the experiment" in capsys.readouterr().out
            assert compose(command).scale == scale
        command = with_scale([*words, "experiment=small", "scale=laptop"])
        cfg = compose(command)
        assert cfg.scale == "laptop" and cfg.collector.num_envs == 64
        assert (
            with_scale([*words, "experiment=plain"])[-1]
            == {"cpu": "scale=laptop", "cuda": "scale=gpu"}[device]
        )
        assert with_scale([*words, "experiment=small", "scale=auto"])[-1].startswith("scale=")
    assert with_scale([found, "experiment=small,same"]) == [found, "experiment=small,same"]
    assert "scale=laptop, smoke, by the experiment" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        with_scale([found, "experiment=small,plain"])
    assert "some experiments of this sweep choose a scale" in capsys.readouterr().err


def test_a_device_of_an_experiment_is_that_of_the_scale(monkeypatch, tmp_path: Path) -> None:
    found = experiment(tmp_path, "mine", None)
    with (tmp_path / "experiment" / "mine.yaml").open("a") as file:
        file.write("device: cpu\n")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    for words in ((), ("scale=auto",)):
        assert with_scale([found, "experiment=mine", *words])[-1] == "scale=laptop"
    assert with_scale([found, "experiment=mine", "device=cuda"])[-1] == "scale=gpu"


def test_devices_of_a_sweep_that_want_two_scales_are_refused(capsys, tmp_path: Path) -> None:
    """The first alone would decide how large the others are."""
    for device in ("cpu", "cuda"):
        found = experiment(tmp_path, f"on_{device}", None)
        with (tmp_path / "experiment" / f"on_{device}.yaml").open("a") as file:
            file.write(f"device: {device}\n")
    for words in (["experiment=on_cpu,on_cuda"], ["device=cpu,cuda"]):
        with pytest.raises(SystemExit):
            with_scale([found, *words])
        assert (
            "some devices of this sweep want scale=gpu, others scale=laptop; add scale="
            in capsys.readouterr().err
        )
    assert with_scale([found, "experiment=on_cuda,on_cpu", "scale=smoke"])[-1] == "scale=smoke"
    assert with_scale(["device=cuda:0,cuda:1"])[-1] == "scale=gpu"


def test_a_scale_as_a_value_beside_numbers_of_another_is_refused(tmp_path: Path) -> None:
    found = experiment(tmp_path, "wrong", None)
    with (tmp_path / "experiment" / "wrong.yaml").open("a") as file:
        file.write("scale: smoke\n")
    for words in ((), ("scale=laptop",)):
        with pytest.raises(
            UserError, match=r"the value smoke beside the numbers of scale=laptop; .*override /scale"
        ):
            compose([found, "experiment=wrong", *words])
    assert compose([found, "experiment=wrong", "scale=smoke"]).scale == "smoke"
