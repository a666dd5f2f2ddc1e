"""A run that is refused after its folder was made: nothing is left of it, unless something was written."""

from __future__ import annotations

import logging
import os
import runpy
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra

from forks import TRAIN
from franka_wm.commands.entry import run_command
from franka_wm.errors import UserError
from franka_wm.training.run import Run

Refused = Callable[..., str]


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Refused:
    """``python train.py`` up to where worlds would be built; what it says on standard error."""

    def refused(
        *words: str, error: BaseException, status: int = 1, first: Callable[[Path], object] = Path.exists
    ) -> str:
        def build(run: Run) -> None:
            assert (run.folder / "config.yaml").is_file()
            first(run.folder)
            raise error

        monkeypatch.setattr(Run, "build_environments", build)
        # Hydra closes all handlers of this process, and absl's closes the stream that it was made with: pytest's own.
        monkeypatch.setattr(logging, "_handlerList", [])
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(TRAIN), "scale=smoke", "device=cpu", *words])
        GlobalHydra.instance().clear()
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(TRAIN), run_name="__main__")
        assert ended.value.code == status
        return capfd.readouterr().err

    return refused


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (UserError("the data are damaged"), 1, "error: the data are damaged\n"),
        (MemoryError("too much"), 1, "error: out of memory"),
        (KeyboardInterrupt(), 130, "stopped; nothing was saved yet\n"),
    ],
)
@pytest.mark.parametrize("words", [[], ["hydra.run.dir=mine/run"]])
def test_nothing_is_left(
    words: list[str], error: BaseException, status: int, said: str, refused: Refused, tmp_path: Path
) -> None:
    assert said in refused(*words, error=error, status=status)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("linked", [False, True])
def test_a_folder_that_stood_before_stays(linked: bool, refused: Refused, tmp_path: Path) -> None:
    """With an old log of another program of that name, too, and where it is only a link to one."""
    (tmp_path / "real" / "above").mkdir(parents=True)
    if linked:
        (tmp_path / "real" / "above" / "run").symlink_to(tmp_path / "real")
    else:
        (tmp_path / "real" / "above" / "run").mkdir()
    (tmp_path / "real" / "train.log").write_text("old")
    refused("hydra.run.dir=real/above/run", error=UserError("no"))
    assert (tmp_path / "real" / "above" / "run" / "config.yaml").is_file()
    assert (tmp_path / "real" / "train.log").read_text().startswith("old")


def test_folders_above_that_stood_before_stay(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    refused("hydra.run.dir=x/../other/a/b", error=UserError("no"))
    assert list((tmp_path / "other").iterdir()) == []


def test_what_training_has_begun_to_log_stays(refused: Refused, tmp_path: Path) -> None:
    def begin(folder: Path) -> None:
        Run.keep(None)  # type: ignore[arg-type]  # what train.py does before the first update

    refused("hydra.run.dir=run", error=UserError("broke"), first=begin)
    assert (tmp_path / "run" / "train.log").is_file()


@pytest.mark.parametrize("saved", [None, "", "pretrained"])
def test_what_is_stopped_says_what_there_is(saved: str | None, refused: Refused, tmp_path: Path) -> None:
    """Under Ctrl-C, in the first of two stages, too, with a module of one's own that going on needs, too."""

    def begin(folder: Path) -> None:
        Run.keep(None)  # type: ignore[arg-type]
        if saved is not None:
            (folder / saved / "checkpoints" / "latest").mkdir(parents=True)

    (tmp_path / "mine.py").touch()
    words = ("hydra.run.dir=run", "plugins=[mine]")
    said = refused(*words, error=KeyboardInterrupt(), status=130, first=begin)
    on = f"go on from what was saved: franka-wm train resume={tmp_path}/run 'plugins=[mine]'"
    lost = f"there is no checkpoint to go on from yet; what was written is in {tmp_path}/run"
    assert f"stopped; {lost if saved is None else on}\n" in said


def test_a_scheduler_that_ends_a_run_in_its_evaluation_is_told_the_same(
    refused: Refused, tmp_path: Path
) -> None:
    """SIGTERM, when training has saved and handles no signals any more."""

    def begin(folder: Path) -> None:
        Run.keep(None)  # type: ignore[arg-type]
        (folder / "checkpoints" / "latest").mkdir(parents=True)
        os.kill(os.getpid(), signal.SIGTERM)

    before = signal.getsignal(signal.SIGTERM)
    said = refused("hydra.run.dir=run", error=UserError("went on"), status=130, first=begin)
    assert f"stopped; go on from what was saved: franka-wm train resume={tmp_path}/run\n" in said
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_file_of_the_users_stays(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "notes.txt").write_text("mine")
    refused("hydra.run.dir=run", error=UserError("no"))
    assert (tmp_path / "run" / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("hydra.run.dir=", "hydra.run.dir=: names no folder"),
        ("--experimental-rerun=job.pickle", "unpickles a file"),
        ("-m --cfg job seed=0,1", "--multirun beside --cfg: give one of them"),
    ],
)
def test_what_hydra_would_take_is_refused_early(
    words: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        run_command(lambda: pytest.fail("begun"), ["scale=smoke", "device=cpu", *words.split()])
    line = capfd.readouterr().err
    assert ended.value.code == 1 and said in line and line.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_working_directory_stays(refused: Refused, tmp_path: Path) -> None:
    refused("hydra.run.dir=.", error=UserError("no"))
    assert (tmp_path / "config.yaml").is_file()


def test_what_a_run_has_written_stays(refused: Refused, tmp_path: Path) -> None:
    refused(
        "hydra.run.dir=run", error=UserError("no"), first=lambda run: (run / "encoder").write_text("10 h")
    )
    assert {"encoder", "config.yaml", "train.log"} <= {one.name for one in (tmp_path / "run").iterdir()}


def test_a_link_that_was_made_there_stays(refused: Refused, tmp_path: Path) -> None:
    refused("hydra.run.dir=run", error=UserError("no"), first=lambda run: (run / "data").symlink_to(tmp_path))
    assert (tmp_path / "run" / "data").is_symlink() and (tmp_path / "run" / "config.yaml").is_file()


def test_another_runs_folder_stays(refused: Refused, tmp_path: Path) -> None:
    refused("hydra.run.dir=first", error=UserError("no"), first=lambda run: (run / "encoder").touch())
    before = {one.name for one in (tmp_path / "first").iterdir()}
    refused("hydra.run.dir=first", error=UserError("no"))
    assert {one.name for one in (tmp_path / "first").iterdir()} == before
    refused("hydra.run.dir=second", error=UserError("no"))
    assert [one.name for one in tmp_path.iterdir()] == ["first"]
