"""A run that makes a dataset of what it gathered."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from franka_wm.data.lerobot.schema import GOAL, OBJECTS, PROVENANCE, SUCCESS
from franka_wm.training.moment import worlds_now
from franka_wm.training.resume import CUT_SHORT
from franka_wm.training.settings.groups import EnvSettings
from franka_wm.training.trainer import Trainer


def test_a_run_that_exports_keeps_what_the_task_says(train, tmp_path: Path, monkeypatch, capsys) -> None:
    """The dataset is for other models, too: objects that this one does not read, the task's own success, and which
    episodes were cut short; of an older run, which did not keep that, the others."""
    words = ("env=push", "env.substeps=1", "env.episode_length=8", "model.observations=[state,goal]")
    words = (*words, "evaluation.during=[]", "export=lerobot", "export.workers=1")
    run = train(*words, f"export.out={tmp_path}/set", folder=tmp_path / "run")
    features = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())["features"]
    assert {SUCCESS, OBJECTS, GOAL} <= features.keys()
    [session] = json.loads((tmp_path / "set" / PROVENANCE).read_text())["sessions"]
    assert session["policy"] == "policy in a training run"  # and not collector.policy, which is auto
    assert (replay := run.replay()) is not None and bool(replay["next", "truncated"].any())
    kept = Trainer.kept.fget
    assert kept is not None

    def carried(*arguments):
        (worlds := worlds_now(*arguments))["carry"].pop("overflow")
        return worlds

    with monkeypatch.context() as older:
        older.setattr(Trainer, "kept", property(lambda self: [key for key in kept(self) if key != CUT_SHORT]))
        older.setattr(EnvSettings, "marks_overflow", False)
        older.setattr("franka_wm.training.trainer.worlds_now", carried)
        train(*words, "trainer.updates=10", folder=tmp_path / "older")
    assert "lost an object are missing" in (said := capsys.readouterr().out)
    assert "nothing says which episodes" not in said
    more = train(f"resume={tmp_path}/older", "trainer.updates=20", folder=tmp_path / "on").replay()
    assert more is not None and bool(more["next", "truncated"].any())
    assert not more["next", "overflow"].any()
    assert (
        "of the steps before this resume nothing says which episodes were cut short"
        in capsys.readouterr().out
    )
    # In its own folder the dataset of the shorter run is in the way: said before anything is trained.
    shutil.copytree(tmp_path / "older", tmp_path / "same")  # the lock of the other is this process's
    train(f"resume={tmp_path}/same", "trainer.updates=20", folder=tmp_path / "same", status=1)
    assert "same/dataset exists, from another run or from this one with other" in capsys.readouterr().err
    assert (tmp_path / "same" / "finished.json").is_file()
