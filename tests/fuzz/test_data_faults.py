"""Kills of what writes and reads datasets: the decoded cache, publishing, merging into a finished dataset.

`FAULTS=all` kills at every operation instead of at some; `-s` shows how many kills there were.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rooms.kills import collect, command, in_one_line, load_commands, load_worlds, places, train, verb, whole

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def loaded() -> None:
    """Once, before the forks."""
    load_commands()
    load_worlds()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "set"
    whole(command(collect(out), out))
    return out


def test_a_killed_cache_is_built_again(dataset: Path, tmp_path: Path) -> None:
    def learn(cache: Path, run: str) -> Callable[[], Any]:
        return train(
            "dataset=lerobot", "trainer=offline", "env=none", "scale=smoke", "device=cpu", "logger=files",
            "trainer.updates=2", f"dataset.root={dataset}", f"dataset.cache_dir={cache}",
            f"hydra.run.dir={tmp_path}/runs/{cache.name}-{run}",
        )  # fmt: skip

    def caches(cache: Path) -> list[Path]:
        return [path for path in cache.iterdir() if path.is_dir()]

    once = whole(command(learn(tmp_path / "once", "1"), tmp_path / "once"))
    for at in places("cache", once.operations, 2):
        cache = tmp_path / f"killed{at}"
        assert command(learn(cache, "1"), cache, kill_at=at).status in (-9, 0), at
        whole(command(learn(cache, "2"), cache))
        assert len(caches(cache)) == 1 and (caches(cache)[0] / "cache.json").is_file(), caches(cache)


def test_a_killed_publication_is_repeated(dataset: Path, tmp_path: Path) -> None:
    def dry(place: Path) -> Callable[[], Any]:
        def run() -> int:
            place.mkdir(exist_ok=True)
            os.chdir(place)
            tempfile.tempdir = str(place)
            return verb("publish", f"root={dataset}", "repo_id=user/arm", "dry_run=true")()

        return run

    def content(folder: Path) -> dict[str, bytes]:
        return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}

    before = content(dataset)
    once = whole(command(dry(tmp_path / "once"), tmp_path / "once"))
    card = tmp_path / "once" / "outputs" / "publish" / "user--arm" / "README.md"
    for at in places("publish", once.operations, 2):
        place = tmp_path / f"killed{at}"
        assert command(dry(place), place, kill_at=at).status == -9, at
        whole(command(dry(place), place))
        again = place / "outputs" / "publish" / "user--arm" / "README.md"
        assert again.read_text() == card.read_text()
    assert content(dataset) == before


def test_a_killed_merge_into_a_finished_dataset(dataset: Path, tmp_path: Path) -> None:
    from franka_wm.data.lerobot.source import read_source

    def more(out: Path) -> Callable[[], Any]:
        return collect(out, "resume=true", episodes=10)

    shutil.copytree(dataset, tmp_path / "once")
    once = whole(command(more(tmp_path / "once"), tmp_path / "once"))
    assert len(read_source(tmp_path / "once").lengths) == 10
    for at in places("merge", once.operations, 2):
        out = tmp_path / f"killed{at}"
        shutil.copytree(dataset, out)
        assert command(more(out), out, kill_at=at).status in (-9, 0), at
        with contextlib.suppress(FileNotFoundError):
            assert not out.exists() or len(read_source(out).lengths) in (6, 10)
        again = command(more(out), out)
        if again.status:
            in_one_line(again)
            again = whole(command(more(out), out))
        assert len(read_source(out).lengths) == 10
