"""Kills at file operations, a full disk, no descriptors, no memory: nothing is lost, and the printed advice works.

`FAULTS=all` kills at every operation instead of at some; `-s` shows how many kills there were.
"""

from __future__ import annotations

import re
import resource
import shutil
from pathlib import Path

import pytest

from rooms.checkpoint import RUN
from rooms.kills import (
    collect,
    command,
    in_one_line,
    load_commands,
    load_worlds,
    places,
    short_of_memory,
    train,
    verb,
    whole,
)

pytestmark = pytest.mark.slow

UPDATES = 8
WORDS = [
    *RUN,
    f"trainer.updates={UPDATES}",
    "trainer.checkpoint_every=0.001",
    "trainer.updates_per_batch=4",
    "evaluation.during=[]",
    "evaluation.video_episodes=0",
    "planner.num_samples=8",
    "planner.num_policy_samples=2",
    "planner.num_elites=2",
    "planner.iterations=1",
    "logger=files",
]


@pytest.fixture(scope="module", autouse=True)
def loaded() -> None:
    """Once, before the forks."""
    load_commands()
    load_worlds()


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """A run that nothing disturbed, and how many operations it made."""
    run = tmp_path_factory.mktemp("trained") / "run"
    return run, whole(command(train(*WORDS, f"hydra.run.dir={run}"), run)).operations


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The same of a dataset."""
    out = tmp_path_factory.mktemp("collected") / "set"
    return out, whole(command(collect(out), out)).operations


@pytest.fixture
def run(trained: tuple[Path, int], tmp_path: Path) -> Path:
    """A copy of that run, of the test's own."""
    return Path(shutil.copytree(trained[0], tmp_path / "run"))


def test_a_killed_run_goes_on_from_its_last_checkpoint(trained: tuple[Path, int], tmp_path: Path) -> None:
    from franka_wm.errors import UserError
    from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint

    last = 0
    for at in places("train", trained[1]):
        run = tmp_path / f"killed{at}"
        words = [*WORDS, f"hydra.run.dir={run}"]
        assert command(train(*words), run, kill_at=at).status in (-9, 0), at
        try:
            saved = load_checkpoint(latest_checkpoint(run))
        except UserError:
            saved = None
        if saved is None:
            assert not last, "there was a checkpoint, and it is gone"
            whole(command(train(*words), run))
        else:
            assert saved.counters["updates"] >= last, "more was lost than since the last checkpoint"
            last = saved.counters["updates"]
            again = whole(command(train(f"resume={run}", f"hydra.run.dir={run}"), run))
            assert "results:" in again.said
        assert load_checkpoint(latest_checkpoint(run)).counters["updates"] == UPDATES
    assert last


def test_a_killed_collection_goes_on_as_it_says(collected: tuple[Path, int], tmp_path: Path) -> None:
    from franka_wm.data.lerobot.source import read_source

    for at in places("collect", collected[1]):
        out = tmp_path / f"killed{at}"
        ended = command(collect(out), out, kill_at=at)
        assert ended.status in (-9, 0), ended
        again = command(collect(out), out)
        if again.status:
            assert "resume=true" in in_one_line(again)
            whole(command(collect(out, "resume=true"), out))
        assert len(read_source(out).lengths) == 6


def test_a_killed_export_and_report_are_repeated_as_they_say(run: Path, tmp_path: Path) -> None:
    from franka_wm.data.lerobot.source import read_source

    def words(out: Path) -> list[str]:
        return ["export", f"source={run}", f"out={out}", "workers=1"]

    once = whole(command(verb(*words(tmp_path / "once")), tmp_path / "once"))
    for at in places("export", once.operations):
        out = tmp_path / f"killed{at}"
        command(verb(*words(out)), out, kill_at=at)
        again = command(verb(*words(out)), out)
        if again.status and not out.exists():  # else it was whole before the kill, which the line says
            line = in_one_line(again)
            assert "resume=true" not in line, f"an export has no such option: {line}"
            (named,) = re.findall(r"remove (\S+?)[;,.]?(?:\s|$)", line)
            assert Path(named).is_relative_to(tmp_path)
            shutil.rmtree(named)
            whole(command(verb(*words(out)), out))
        assert len(read_source(out).lengths) == len(read_source(tmp_path / "once").lengths)
    page = command(verb("report", str(run)), run)
    for at in places("report", page.operations):
        (run / "report.html").unlink(missing_ok=True)
        command(verb("report", str(run)), run, kill_at=at)
        whole(command(verb("report", str(run)), run))
        assert (run / "report.html").read_text().rstrip().endswith("</html>")


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({resource.RLIMIT_FSIZE: 200_000}, "so large|No space|too large"),
        ({resource.RLIMIT_FSIZE: 2_000}, "is not writable .File too large.; choose another place"),
        ({resource.RLIMIT_NOFILE: 12}, "open files"),
    ],
    ids=["files of 200 kB", "files of 2 kB", "12 descriptors"],
)
def test_what_the_machine_refuses_is_one_line(limits: dict[int, int], words: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    ended = command(train(*WORDS, f"hydra.run.dir={run}"), run, limits=limits)
    assert re.search(words, in_one_line(ended)), ended.said


def test_files_that_cannot_grow_make_no_dataset(tmp_path: Path) -> None:
    out = tmp_path / "set"
    ended = command(collect(out), out, limits={resource.RLIMIT_FSIZE: 2_000})
    assert "so large" in in_one_line(ended)
    assert not out.exists()


def test_too_little_memory_is_one_line(collected: tuple[Path, int], tmp_path: Path) -> None:
    words = "out of memory; allow more (ulimit -v)"
    run, out = tmp_path / "run", tmp_path / "set"
    assert words in in_one_line(short_of_memory(train(*WORDS, f"hydra.run.dir={run}"), run))
    assert words in in_one_line(short_of_memory(collect(out), out))
    assert not out.exists()
    shutil.copytree(collected[0], out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    in_one_line(short_of_memory(collect(out, "resume=true", episodes=8), out))
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_a_read_only_folder_is_one_line(run: Path, tmp_path: Path) -> None:
    shut = tmp_path / "shut"
    shut.mkdir()
    for folder in (shut, run):
        folder.chmod(0o555)
    for work, name in (
        (train(*WORDS, f"hydra.run.dir={shut}/run"), "hydra.run.dir="),
        (train(f"resume={run}", f"hydra.run.dir={run}"), "hydra.run.dir="),
        (collect(shut / "set"), "out="),
        (verb("export", f"source={run}", f"out={shut}/set"), "out="),
        (verb("report", str(run)), "report.html"),
        (verb("report", str(run), f"out={shut}/page.html"), "page.html"),
    ):
        line = in_one_line(command(work, tmp_path / "work", ordinary=True))
        assert name in line and "choose a" in line, line
    assert not list(shut.iterdir())


def test_a_disk_that_fills_up_keeps_the_last_checkpoint(run: Path) -> None:
    from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint

    size = max(path.stat().st_size for path in (run / "checkpoints" / "latest").iterdir())
    more = [f"resume={run}", f"hydra.run.dir={run}", f"trainer.updates={2 * UPDATES}"]
    in_one_line(command(train(*more), run, limits={resource.RLIMIT_FSIZE: size // 2}))
    assert load_checkpoint(latest_checkpoint(run)).counters["updates"] == UPDATES
    whole(command(train(*more), run))
