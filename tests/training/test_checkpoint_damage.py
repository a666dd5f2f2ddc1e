"""Checkpoints: whole after a kill at any step, and clear about what is wrong."""

import copy
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import nn

from franka_wm.errors import UserError
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from franka_wm.training.optimizer_state import load_optimizer_state, optimizer_state
from small_checkpoint import Small, save, some_replay, train


class Other(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.Linear(3, 3)


# -- whole or not at all -----------------------------------------------------------------------------------


class Killed(BaseException):
    """Not an Exception: no handler in the code under test may run, as after SIGKILL."""


def die_at(monkeypatch: pytest.MonkeyPatch, step: int) -> list[str]:
    """From the given call on, every call that changes the disk kills. Returns the names of those before."""
    calls: list[str] = []

    def wrap(name: str, real: Callable) -> Callable:
        def call(*args, **kwargs):
            if len(calls) >= step:
                raise Killed
            calls.append(name)
            return real(*args, **kwargs)

        return call

    monkeypatch.setattr(os, "rename", wrap("rename", os.rename))
    monkeypatch.setattr(os, "fsync", wrap("fsync", os.fsync))
    monkeypatch.setattr(shutil, "rmtree", wrap("rmtree", shutil.rmtree))
    return calls


def test_a_kill_at_any_step_leaves_the_old_or_the_new_checkpoint(tmp_path: Path) -> None:
    models = {1: Small(), 2: Small(), 3: Small()}
    finished, seen = False, []
    step = 0
    while not finished:
        folder = tmp_path / str(step) / "checkpoint"
        save(folder, models[1], step=1)
        with pytest.MonkeyPatch.context() as patch:
            calls = die_at(patch, step)
            try:
                save(folder, models[2], step=2)
                finished = True
            except Killed:
                pass
        for place in (folder, latest_checkpoint(folder), latest_checkpoint(folder.parent)):
            checkpoint = load_checkpoint(place)
            restored = Small()
            checkpoint.load_model(restored)
            which = checkpoint.counters["env_steps"]
            assert which in (1, 2)
            assert torch.equal(restored.first.weight, models[int(which)].first.weight)
        seen.append(which)
        # The next save recovers from whatever was left, and tidies up.
        save(folder, models[3], step=3)
        assert load_checkpoint(folder).counters == {"env_steps": 3}
        assert [p.name for p in folder.parent.iterdir()] == ["checkpoint"]
        step += 1
    assert {"rename", "fsync", "rmtree"} == set(calls)
    assert seen[0] == 1
    assert seen[-1] == 2
    assert sorted(seen) == seen  # once the new one is there, it stays


def test_a_kill_during_the_first_save_leaves_no_checkpoint(tmp_path: Path, monkeypatch) -> None:
    with monkeypatch.context() as patch:
        die_at(patch, 3)
        with pytest.raises(Killed):
            save(tmp_path / "a")
    with pytest.raises(UserError, match="no checkpoint"):
        load_checkpoint(tmp_path / "a")
    with pytest.raises(UserError, match="no checkpoint in"):
        latest_checkpoint(tmp_path)
    save(tmp_path / "a", step=5)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("failing", ["first rename", "second rename", "fsync"])
def test_a_failure_keeps_the_old_checkpoint_and_leaves_nothing_else(
    tmp_path: Path, monkeypatch, failing
) -> None:
    save(tmp_path / "a", step=1)
    rename, renames = os.rename, []

    def failing_rename(source, target):
        renames.append(source)
        if len(renames) == {"first rename": 1, "second rename": 2}.get(failing):
            raise OSError(5, "Input/output error")
        rename(source, target)

    def failing_fsync(_descriptor):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", failing_rename)
        if failing == "fsync":
            patch.setattr(os, "fsync", failing_fsync)
        with pytest.raises(UserError, match=r"cannot write checkpoint .*(Input/output|No space)"):
            save(tmp_path / "a", step=2)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    assert load_checkpoint(tmp_path / "a").counters == {"env_steps": 1}


# -- clear about what is wrong -----------------------------------------------------------------------------


def everything(folder: Path) -> Path:
    model = Small()
    optimizer = torch.optim.Adam(model.parameters())
    train(model, optimizer, 1)
    return save(folder, model, optimizer=optimizer, replay=some_replay(), extra={"x": torch.ones(2)})


def read_all(folder: Path) -> None:
    load_checkpoint(folder).replay()


def test_damage_to_any_file_is_named(tmp_path: Path) -> None:
    folder = everything(tmp_path / "a")
    names = sorted(p.name for p in folder.iterdir())
    assert len(names) == 12
    for name in names:
        path = folder / name
        whole = path.read_bytes()
        for kept in (len(whole) - 1, len(whole) // 2, 0):
            path.write_bytes(whole[:kept])
            with pytest.raises(UserError, match=name) as caught:
                read_all(folder)
            assert "\n" not in str(caught.value)
            if name != "manifest.json":
                assert f"has {kept} bytes, {len(whole)} were written" in str(caught.value)
        if name != "manifest.json":
            middle = len(whole) // 2
            path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
            with pytest.raises(UserError, match=f"{name} has the right size but other content"):
                read_all(folder)
        path.unlink()
        missing = "no checkpoint" if name == "manifest.json" else f"{name} is missing"
        with pytest.raises(UserError, match=missing):
            read_all(folder)
        path.write_bytes(whole)
    read_all(folder)


@pytest.mark.parametrize("entry", [{}, {"bytes": 1}, {"bytes": "many", "sha256": ""}, None])
def test_a_manifest_that_lacks_something_is_damage(entry: object, tmp_path: Path) -> None:
    folder = everything(tmp_path / "a")
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"]["model.safetensors"] = entry
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(UserError, match="damaged: manifest"):
        load_checkpoint(folder)


def test_a_configuration_that_would_read_this_machines_secrets_is_refused(
    tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setenv("SECRET", "a token")
    folder = everything(tmp_path / "a")
    (folder / "config.yaml").write_text("model:\n  name: ${oc.env:SECRET}\n")
    manifest = json.loads((folder / "manifest.json").read_text())
    content = (folder / "config.yaml").read_bytes()
    manifest["files"]["config.yaml"] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(UserError, match="interpolation") as caught:
        load_checkpoint(folder)
    assert "a token" not in str(caught.value)


def test_a_newer_format_is_not_guessed_at(tmp_path: Path) -> None:
    manifest = save(tmp_path / "a") / "manifest.json"
    content = json.loads(manifest.read_text()) | {"format_version": 2}
    manifest.write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"format version 2.*reads 1"):
        load_checkpoint(tmp_path / "a")


@pytest.mark.parametrize(
    ("other", "says"),
    [
        (
            lambda: Small(hidden=8),
            r"first\.weight has shape \(16, 20\) in the checkpoint and \(8, 20\) in the model",
        ),
        (lambda: Small().double(), r"first\.weight has dtype torch.float32 .* torch.float64"),
        (Other, r"holds a Small that does not fit this Other: encoder\.weight is missing"),
        (lambda: Small().first, r"this Linear: weight is missing in the checkpoint"),
    ],
)
def test_another_model_is_refused_and_not_touched(
    tmp_path: Path, other: Callable[[], nn.Module], says: str
) -> None:
    save(tmp_path / "a")
    model = other()
    before = [p.clone() for p in model.parameters()]
    with pytest.raises(UserError, match=says):
        load_checkpoint(tmp_path / "a").load_model(model)
    assert all(torch.equal(a, b) for a, b in zip(before, model.parameters(), strict=True))


def test_a_checkpoint_with_more_than_the_model_is_refused(tmp_path: Path) -> None:
    model = Small()
    model.add_module("decoder", nn.Linear(2, 2))
    save(tmp_path / "a", model)
    with pytest.raises(UserError, match=r"decoder\.\w+ is in the checkpoint but not in the model"):
        load_checkpoint(tmp_path / "a").load_model(Small())


def test_another_optimizer_is_refused(tmp_path: Path) -> None:
    model = Small()
    optimizer = torch.optim.Adam(model.parameters())
    train(model, optimizer, 1)
    checkpoint = load_checkpoint(save(tmp_path / "a", model, optimizer=optimizer))
    with pytest.raises(UserError, match="it is Adam, here is AdamW"):
        checkpoint.load_optimizer(torch.optim.AdamW(model.parameters()))
    with pytest.raises(UserError, match="other numbers of parameters"):
        checkpoint.load_optimizer(torch.optim.Adam(model.first.parameters()))
    with pytest.raises(
        UserError, match=r"exp_avg of parameter 0 has shape \(16, 20\), the parameter \(8, 20\)"
    ):
        checkpoint.load_optimizer(torch.optim.Adam(Small(hidden=8).parameters()))


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda group, _: group.update(lr="fast"), "lr is 'fast', here"),
        (lambda group, _: group.update(lr=-1.0), "lr is -1.0, here"),
        (lambda group, _: group.pop("lr"), "lr is None, here"),
        (lambda _, state: state.pop("exp_avg_sq"), r"of parameter 1 it holds \['exp_avg', 'step'\]"),
        (
            lambda _, state: state["exp_avg"].fill_(torch.nan),
            "exp_avg of parameter 1 holds no finite numbers",
        ),
        (lambda _, state: state.update(step="2"), "step of parameter 1 holds no finite numbers"),
        (lambda _, state: state.update(step=torch.ones(1)), r"step of parameter 1 has shape \(1,\)"),
    ],
)
def test_a_damaged_state_of_an_optimizer_is_refused(damage: Callable[..., object], says: str) -> None:
    model = Small()
    optimizer = torch.optim.Adam(model.parameters())
    train(model, optimizer, 2)
    saved = copy.deepcopy(optimizer_state(optimizer))
    held = saved["optimizer"]["state_dict"]
    damage(held["param_groups"][0], held["state"][1])
    other = torch.optim.Adam(Small().parameters())
    with pytest.raises(UserError, match=rf"optimizer 'optimizer' of here does not fit: {says}"):
        load_optimizer_state(saved, other, "here")
    assert not other.state
    load_optimizer_state(optimizer_state(optimizer), other, "here")
    assert other.state


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match="cannot write checkpoint"):
        save(tmp_path / "file" / "a")
    with pytest.raises(UserError, match="exists and is not a checkpoint"):
        save(tmp_path / "file")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("mine")
    with pytest.raises(UserError, match="exists and is not a checkpoint"):
        save(tmp_path / "thesis")
    assert (tmp_path / "thesis" / "chapter.txt").read_text() == "mine"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "thesis"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(UserError, match="Permission denied"):
        save(tmp_path / "a")


def test_a_newer_checkpoint_in_its_place_is_not_mixed_with_it(tmp_path: Path) -> None:
    """A run that goes on saves while another command, which has read the counters, builds its worlds."""
    folder = save(tmp_path / "latest", Small(), step=1, extra={"a": 1})
    opened = load_checkpoint(folder)
    save(folder, Small(), step=2, extra={"a": 2})
    for read in (lambda: opened.load_model(Small()), opened.extra, opened.restore_rng):
        with pytest.raises(UserError, match="has saved a newer one in its place meanwhile; start again"):
            read()
    (folder / "manifest.json").rename(tmp_path / "gone")  # amid the swap
    with pytest.raises(UserError, match="has saved a newer one"):
        opened.load_model(Small())


@pytest.mark.parametrize("line", ["foo: ???", "2020-01-01: 3"])
def test_a_configuration_that_omegaconf_refuses_is_one_line(line: str, tmp_path: Path) -> None:
    folder = save(tmp_path / "latest", Small())
    path, manifest = folder / "config.yaml", folder / "manifest.json"
    path.write_text(f"{path.read_text()}{line}\n")
    said = json.loads(manifest.read_text())
    content = path.read_bytes()
    said["files"]["config.yaml"] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    manifest.write_text(json.dumps(said))
    with pytest.raises(UserError, match=r"config\.yaml holds values of another form") as caught:
        load_checkpoint(folder)
    assert "\n" not in str(caught.value)
