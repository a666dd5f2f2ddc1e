"""The processes that write a dataset, and what the end of one of them costs."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest

from dataset_episodes import compare
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


@pytest.mark.parametrize("at", ["a shard", "its end"])
def test_a_writing_process_that_dies_at_work_costs_its_shard_alone(
    at: str, tmp_path, make_schema, make_episode, load
) -> None:
    schema = make_schema()
    episodes = [make_episode(schema, i) for i in range(4)]
    out = tmp_path / "set"
    with DatasetWriter(out, schema, provenance={}, workers=1, shard_frames=7) as writer:
        writer.add(episodes[:2])
        writer.flush()
        worker: Any = writer._workers[0]
        os.kill(worker._process.pid, signal.SIGKILL)
        with pytest.raises(UserError, match=r"a writing process ended.*episodes are on disk"):
            writer.finish() if at == "its end" else (writer.add(episodes[2:]), writer.flush())
    with DatasetWriter(out, schema, provenance={}, workers=0, resume=True) as writer:
        there = writer.keys()
        assert {one.key for one in episodes[:2]} <= there and len(there) == episodes_there(out)
        writer.add(one for one in episodes if one.key not in there)
        writer.finish()
    assert sorted(load(out).hf_dataset.unique("episode_key")) == sorted(one.key for one in episodes)
