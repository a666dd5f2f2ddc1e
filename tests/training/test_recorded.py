"""Datasets by name are compared with the arm as those in a folder are, before their rows are fetched."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import httpx
import huggingface_hub
import pytest
import torch
from huggingface_hub import constants
from lerobot.utils import constants as lerobot_constants

from fake_hub import TOKEN, Hub
from franka_wm.commands import main as cli
from franka_wm.data.lerobot import publish, source
from franka_wm.data.lerobot.schema import PROVENANCE
from franka_wm.data.lerobot.source import find_dataset
from franka_wm.errors import UserError
from franka_wm.training.build import open_recorded
from franka_wm.training.check import check

ARM = ("env=reach", "env.substeps=1", "env.episode_length=8", "seed=0", "device=cpu")
WORDS = ("scale=smoke", *ARM, "dataset=lerobot", "trainer=offline")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of inverse kinematics."""
    root = tmp_path_factory.mktemp("recorded") / "reach"
    assert cli.main(["collect", f"out={root}", "policy=ik", "episodes=3", "num_envs=3", *ARM]) == 0
    return root


@pytest.fixture
def hub(recorded: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hub]:
    """One that holds the dataset as user/reach, and that the Hub's client asks."""
    one = Hub()
    files = {f.relative_to(recorded).as_posix(): f.read_bytes() for f in recorded.rglob("*") if f.is_file()}
    one.repos["datasets/user/reach"] = {"files": files, "private": False, "tags": {}, "commits": 1}
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(lerobot_constants, "HF_LEROBOT_HOME", tmp_path / "home")
    monkeypatch.setattr(lerobot_constants, "HF_LEROBOT_HUB_CACHE", tmp_path / "hub")
    download = partial(huggingface_hub.snapshot_download, endpoint=one.url, token=TOKEN)
    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    yield one
    one.close()


@pytest.mark.parametrize("by_name", [True, False])
def test_a_dataset_by_name_is_compared_as_one_in_a_folder(
    by_name: bool, recorded: Path, hub: Hub, settled, capsys
) -> None:
    named = "dataset.repo_id=user/reach" if by_name else f"dataset.root={recorded}"
    check(settled(*WORDS, named))
    for change, said in (
        (
            "env.action_scale=0.2",
            r"recorded with env\.action_scale=0\.085, this run has 0\.2, so actions mean",
        ),
        ("env.fps=20", "30 frames per second, the environment 20"),
    ):
        with pytest.raises(UserError, match=said) as refused:
            check(settled(*WORDS, named, change))
        assert "\n" not in str(refused.value) and ("fps" in change or str(refused.value).startswith(named))
    capsys.readouterr()
    check(settled(*WORDS, named, "env.success_distance=0.02"))
    assert f"{named}: recorded with env.success_distance=0.05" in capsys.readouterr().out
    fetched = [path for _, path in hub.requests if "/resolve/" in path]
    assert bool(fetched) == by_name and not [path for path in fetched if "/meta/" not in path]


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (httpx.ReadTimeout("The read operation timed out"), "the Hub cannot be reached"),
        (
            OSError("Consistency check failed: 3 of 5 bytes\nmore"),
            r"cannot be fetched.*Consistency check failed",
        ),
    ],
)
def test_what_fails_while_a_dataset_comes_is_one_line(error, says: str, hub: Hub, monkeypatch) -> None:
    def fails(*_, **__) -> None:
        raise error

    monkeypatch.setattr(huggingface_hub, "snapshot_download", fails)
    with pytest.raises(UserError, match=rf"^dataset\.repo_id=user/reach: {says}") as refused:
        find_dataset("user/reach")
    assert "\n" not in str(refused.value)


def test_the_tag_that_publishing_sets_is_asked_for(hub: Hub, monkeypatch) -> None:
    assert publish.VERSION_TAG is source.VERSION_TAG
    monkeypatch.setattr(source, "VERSION_TAG", "v9.9")
    find_dataset("user/reach", meta=True)
    assert any("/revision/v9.9" in path for _, path in hub.requests)


def test_its_rows_follow_when_they_are_read(recorded: Path, hub: Hub) -> None:
    part = find_dataset("user/reach", meta=True)
    assert not (part / "data").exists()
    whole = find_dataset("user/reach")
    names = {f.relative_to(whole).as_posix() for f in whole.rglob("*") if f.is_file()}
    assert names == set(hub.repos["datasets/user/reach"]["files"])
    assert json.loads((whole / PROVENANCE).read_text()) == json.loads((recorded / PROVENANCE).read_text())


@pytest.mark.parametrize("by_name", [True, False])
def test_a_dataset_without_rewards_is_refused_before_it_is_decoded(
    by_name: bool, recorded: Path, hub: Hub, settled, tmp_path
) -> None:
    """By name without an arm, as it is opened: nothing is fetched for the check."""
    root = tmp_path / "set"
    shutil.copytree(recorded, root)
    info = json.loads((root / "meta/info.json").read_text())
    del info["features"]["next.reward"]
    (root / "meta/info.json").write_text(json.dumps(info))
    hub.repos["datasets/user/reach"]["files"]["meta/info.json"] = (root / "meta/info.json").read_bytes()
    where = "dataset.repo_id=user/reach" if by_name else f"dataset.root={root}"
    words = ("scale=smoke", "env=none", "dataset=lerobot", "trainer=offline", where)
    words += (f"dataset.cache_dir={tmp_path / 'cache'}", "device=cpu")
    run = settled(*words)
    with pytest.raises(UserError, match="no reward, which model=tdmpc2 learns from"):
        open_recorded(run, torch.device("cpu")) if by_name else check(run)
    assert not (tmp_path / "cache").exists()
    check(settled(*words, "model=lewm", "model.observations=[state]"))


def test_cameras_of_a_dataset_by_name_are_compared(recorded: Path, hub: Hub, settled) -> None:
    """Alone with an arm: what trains without one is shown to none, and nothing is fetched for it here."""
    check(
        settled("scale=smoke", "env=none", "dataset=lerobot", "trainer=offline", "dataset.repo_id=user/reach")
    )
    assert not hub.requests
    words = ("scale=smoke", "device=cpu", "dataset=lerobot", "trainer=offline", "dataset.repo_id=user/reach")
    with pytest.raises(UserError, match="pixels"):
        check(settled(*words, "env=reach_pixels", "model=tdmpc2_pixels"))
