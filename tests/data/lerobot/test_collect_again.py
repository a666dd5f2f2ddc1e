"""``franka-wm collect`` once more: into what is there already, and with words that are nearly right."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from franka_wm.commands import collect as verb
from franka_wm.commands.main import main
from franka_wm.data.lerobot.provenance import read_provenance
from franka_wm.data.lerobot.writer import episodes_there
from franka_wm.errors import UserError
from franka_wm.training.check import check

ARM = ["env=reach", "env.substeps=1", "env.episode_length=4", "device=cpu", "workers=0"]


def test_as_many_worlds_as_episodes_are_missing(tmp_path: Path, capsys, monkeypatch) -> None:
    """Whether some are in a dataset that is not finished, in one that is, or in both."""
    out, words = tmp_path / "set", ["collect", f"out={tmp_path / 'set'}", "shard_frames=1", *ARM]
    assert main([*words, "episodes=3"]) == 0
    assert "building 3 worlds;" in capsys.readouterr().out
    with monkeypatch.context() as patch:  # as a kill leaves it
        patch.setattr("franka_wm.data.lerobot.writer.DatasetWriter.finish", lambda self: self.out)
        assert main([*words, "episodes=5", "resume=true"]) == 0
    assert "building 2 worlds;" in capsys.readouterr().out
    assert episodes_there(out) == 5 and episodes_there(tmp_path / "none") == 0
    assert main([*words, "episodes=6", "resume=true", "policy=ik"]) == 0
    assert "building 1 world;" in capsys.readouterr().out
    assert main([*words, "episodes=8", "num_envs=4", "resume=true"]) == 0
    assert "building 4 worlds;" in capsys.readouterr().out
    sessions = (read_provenance(out) or {})["sessions"]
    assert [session["episodes"] for session in sessions] == [3, 2, 1, 2] and episodes_there(out) == 8


def test_ctrl_c_twice_says_what_is_left(tmp_path: Path, capsys, monkeypatch) -> None:
    """As where the second one comes while the dataset is finished, and before there was anything."""

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    words = ["collect", f"out={tmp_path / 'set'}", "episodes=3", "shard_frames=1", *ARM]
    with monkeypatch.context() as patch:
        patch.setattr("franka_wm.data.lerobot.writer.DatasetWriter.finish", stop)
        assert main(words) == 130
    said = capsys.readouterr().out.splitlines()[-1]
    assert said.startswith("stopped at once; 3 whole episodes are kept, no dataset was made of what is in ")
    assert said.endswith(f"{tmp_path / 'set.writing'}; go on with resume=true")
    assert main([*words, "resume=true"]) == 0 and episodes_there(tmp_path / "set") == 3
    with monkeypatch.context() as patch:  # after the dataset has its name
        patch.setattr(verb, "_collect", stop)
        assert main([*words, "resume=true"]) == 130
    assert (
        capsys.readouterr().out.splitlines()[-1]
        == f"stopped at once; the dataset in {tmp_path / 'set'} is whole"
    )
    monkeypatch.setattr(verb, "open_source", lambda *_, **__: stop())
    assert main([*words[:1], f"out={tmp_path / 'other'}", *words[2:]]) == 130
    assert capsys.readouterr().out.splitlines()[-1] == "stopped; nothing was written"


def test_a_kill_while_the_dataset_moves_leaves_its_episodes_counted_once(tmp_path: Path) -> None:
    out, working = tmp_path / "set", tmp_path / "set.writing"
    assert main(["collect", f"out={out}", "episodes=2", *ARM]) == 0
    shutil.copytree(out, working / "shards/shard-00000")
    assert episodes_there(out) == 4, "two more"
    (working / "writer.json").write_text('{"replacing": true}')
    assert episodes_there(out) == 2, "the same, in their place"
    shutil.rmtree(working / "shards")
    out.rename(working / "previous")
    assert episodes_there(out) == 2, "the ones before"


def test_other_physics_is_refused(tmp_path: Path, capsys) -> None:
    words = ["collect", f"out={tmp_path / 'set'}", *ARM]
    assert main([*words, "episodes=1"]) == 0
    assert main([*words, "episodes=2", "resume=true", "env.substeps=2"]) == 1
    assert "recorded with env.substeps=1, this has 2; give the same" in capsys.readouterr().err
    assert episodes_there(tmp_path / "set") == 1


def test_training_with_other_physics_is_said_and_with_another_task_is_refused(
    tmp_path: Path, capsys, settled
) -> None:
    """A task that follows another clock, or has other actions: what is said first is the task."""
    root = tmp_path / "set"
    assert main(["collect", f"out={root}", "episodes=1", "policy=ik", *ARM]) == 0
    run = ["scale=smoke", *ARM[:-1], "dataset=lerobot", "trainer=offline", f"dataset.root={root}"]
    capsys.readouterr()
    check(settled(*run))
    assert "recorded with" not in capsys.readouterr().out
    check(settled(*run, "env.substeps=2", "env.randomization.gains=0.2"))
    assert (
        f"dataset.root={root}: recorded with env.substeps=1, env.randomization.gains=0.0, this run has 2, 0.2; what "
        "its actions do is as recorded" in " ".join(capsys.readouterr().out.split())
    )
    for change, says in (
        (
            "env.fps=20",
            r"has 30 frames per second, the environment 20; .* Use an env with env\.task=reach and env",
        ),
        ("env=lift", r"its actions have 7 numbers, the environment's 8"),
    ):
        with pytest.raises(UserError, match=rf"^recorded with env\.task=reach: \S+ {says}") as refused:
            check(settled(*run, change, *(["env.fps=30"] if change == "env=lift" else [])))
        assert "\n" not in str(refused.value)


def test_training_on_images_that_look_otherwise_is_said(tmp_path: Path, capsys, settled) -> None:
    root, words = (
        tmp_path / "set",
        ["env=reach_pixels", "env.image_size=16", "env.episode_length=4", "device=cpu"],
    )
    assert main(["collect", f"out={root}", "episodes=1", "workers=0", *words]) == 0
    run = [
        "scale=smoke",
        *words,
        "model=tdmpc2_pixels",
        "dataset=lerobot",
        "trainer=offline",
        f"dataset.root={root}",
    ]
    capsys.readouterr()
    check(settled(*run, "env.enable_shadows=true"))
    assert "recorded with env.enable_shadows=false, this run has true; its images" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["policy=exprt"], "or the folder of a run; did you mean expert?"),
        (["policy=plannr", "checkpoint=RUN"], "planner, policy; did you mean planner?"),
        (["policy=expert", "env=reach"], "env=lift has one, for example; policy=ik solves reach"),
    ],
)
def test_what_was_meant_is_said(words: list[str], says: str, tmp_path: Path, capsys) -> None:
    assert main(["collect", f"out={tmp_path / 'set'}", "device=cpu", *words]) == 1
    error = capsys.readouterr().err.strip()
    assert says in error and "\n" not in error


def test_worlds_of_each_process_are_counted() -> None:
    with pytest.raises(UserError, match="1 world for 2 processes"):
        verb._require_worlds(1, 2)


def test_what_is_no_dataset_is_told_before_worlds_are_built(tmp_path: Path, capsys) -> None:
    (tmp_path / "other").mkdir()
    assert (
        main(["collect", f"out={tmp_path / 'other'}", "episodes=2", "policy=noop", "resume=true", *ARM]) == 1
    )
    said = capsys.readouterr()
    assert "other is not a LeRobot dataset; choose another folder" in said.err and "building" not in said.out
