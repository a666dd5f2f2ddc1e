"""The processes that write a dataset, and what the end of one of them costs."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from dataset_episodes import compare, keys_there
from franka_wm.data.lerobot.writer import DatasetWriter, episodes_there
from franka_wm.errors import UserError


def test_processes_write_the_same(tmp_path, make_schema, make_episode, write, load) -> None:
    schema = make_schema()
    episodes = [make_episode(schema, i) for i in range(6)]
    root = write(tmp_path / "set", schema, episodes, workers=2, shard_frames=7)
    compare(load(root), schema, episodes)
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_a_writing_process_that_dies_is_one_line(tmp_path, make_schema, make_episode, write, load) -> None:
    """At the next episode; those in memory, of a shard that is not full, are written before it is said."""
    episodes = [make_episode(schema := make_schema(), i) for i in range(5)]
    out = tmp_path / "set"
    with DatasetWriter(out, schema, provenance={}, workers=2, shard_frames=100) as writer:
        writer.start(wait=True)
        writer.add(episodes[:3])
        worker: Any = writer._workers[0]
        os.kill(worker._process.pid, signal.SIGKILL)
        worker._process.wait()
        with pytest.raises(
            UserError, match=r"a writing process ended \(exit code -9.*3 episodes are on disk"
        ):
            writer.add(episodes[3:])
    assert episodes_there(out) == 3
    write(out, schema, episodes[3:], resume=True)
    compare(load(out), schema, episodes)


@pytest.mark.parametrize("at", ["a shard", "its end", "its start"])
def test_a_writing_process_that_dies_at_work_costs_its_shard_alone(
    at: str, tmp_path, make_schema, make_episode, load
) -> None:
    schema = make_schema()
    episodes = [make_episode(schema, i) for i in range(5)]
    out = tmp_path / "set"
    with DatasetWriter(out, schema, provenance={}, workers=1, shard_frames=14) as writer:
        writer.add(episodes[:2])  # a shard
        writer.flush()
        worker: Any = writer._workers[0]
        os.kill(worker._process.pid, signal.SIGSTOP)  # what it is given now waits in its connection
        if at == "a shard":
            writer.add(episodes[2:])  # one that it is given, and an episode of the next one
        os.kill(worker._process.pid, signal.SIGKILL)
        worker._process.wait()
        kept = 3 if at == "a shard" else 2
        with pytest.raises(
            UserError, match=rf"a writing process ended.*; {kept} episodes are on disk: collect"
        ):
            {"a shard": writer.flush, "its end": writer.finish, "its start": lambda: writer.start(wait=True)}[
                at
            ]()
    with DatasetWriter(out, schema, provenance={}, workers=0, resume=True) as writer:
        there = keys_there(out)
        assert {one.key for one in episodes[:2]} <= there and len(there) == kept == episodes_there(out)
        writer.add(one for one in episodes if one.key not in there)
        writer.finish()
    assert sorted(load(out).hf_dataset.unique("episode_key")) == sorted(one.key for one in episodes)


def test_what_cannot_be_written_here_either_is_told_with_it(
    tmp_path, make_schema, make_episode, monkeypatch
) -> None:
    """An export is not gone on with, so nothing says how."""
    episodes = [make_episode(schema := make_schema(), i) for i in range(2)]
    options: Any = {"provenance": {}, "workers": 1, "shard_frames": 100, "resumable": False}
    with DatasetWriter(tmp_path / "set", schema, **options) as writer:
        writer.start(wait=True)
        writer.add(episodes[:1])
        worker: Any = writer._workers[0]
        os.kill(worker._process.pid, signal.SIGKILL)
        worker._process.wait()
        monkeypatch.setattr("franka_wm.data.lerobot.shard_workers._do", lambda *_: "no room on the disk")
        with pytest.raises(
            UserError, match=r"ended.*memory is lost: writing failed: no room.*0 episodes are on disk$"
        ):
            writer.add(episodes[1:])


@pytest.mark.parametrize("resumable", [True, False])
def test_what_failed_is_gone_on_with_only_where_it_can_be(
    resumable: bool, tmp_path, make_schema, make_episode, monkeypatch
) -> None:
    monkeypatch.setattr("franka_wm.data.lerobot.shard_workers._do", lambda *_: "no room on the disk")
    options: Any = {"provenance": {}, "workers": 0, "resumable": resumable}
    with DatasetWriter(tmp_path / "set", schema := make_schema(), **options) as writer:
        writer.add([make_episode(schema, 0)])
        with pytest.raises(UserError) as failed:
            writer.flush()
    more = "; what is finished is kept: collect goes on with resume=true" if resumable else ""
    assert str(failed.value) == f"writing failed: no room on the disk{more}"


def test_a_shard_is_on_the_disk_before_it_counts(tmp_path, make_schema, make_episode, monkeypatch) -> None:
    synced, real = {}, os.rename
    monkeypatch.setattr("franka_wm.data.lerobot.shard_workers.sync", lambda path: synced.setdefault(path))

    def rename(old: Path, new: Path) -> None:
        assert {*old.rglob("*"), old} == synced.keys() and old.suffix == ".partial"
        real(old, new)

    with DatasetWriter(tmp_path / "set", schema := make_schema(), provenance={}, workers=0) as writer:
        writer.add([make_episode(schema, 0)])
        monkeypatch.setattr(os, "rename", rename)
        writer.flush()
    assert synced
