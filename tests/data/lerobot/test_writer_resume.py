"""A dataset that was not finished: what a kill leaves, and going on from there."""

from __future__ import annotations

import functools
import json
import os
import pickle
import random
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from dataset_episodes import check_terminals, compare, keys_there
from forks import Fork
from franka_wm.data.lerobot.merge import merge
from franka_wm.data.lerobot.provenance import describe, other_option, read_provenance
from franka_wm.data.lerobot.schema import EPISODE_KEY
from franka_wm.data.lerobot.writer import DatasetWriter
from franka_wm.errors import UserError
from franka_wm.untrusted import MOST_JSON


def test_a_folder_that_exists_is_not_touched(tmp_path, make_schema, make_episode, write) -> None:
    schema = make_schema()
    root = write(tmp_path / "set", schema, [make_episode(schema, 0)])
    with pytest.raises(UserError, match="resume=true"):
        DatasetWriter(root, schema, provenance={})
    other = tmp_path / "other"
    other.mkdir()
    for resume in (True, False):
        with pytest.raises(UserError):
            DatasetWriter(other, schema, provenance={}, resume=resume)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["other", "set"]


def test_actions_that_mean_something_else_are_not_mixed(tmp_path, make_schema, make_episode) -> None:
    schema = make_schema()

    def options(env: dict, policy: str = "p") -> dict:
        provenance = describe(policy=policy, seed=1, config={"env": env})
        return {"provenance": provenance, "workers": 0, "shard_frames": 1}

    for keep in (True, False):  # an unfinished one, and a finished one
        out = tmp_path / str(keep)
        with DatasetWriter(out, schema, **options({"action_scale": 0.085, "fps": 30})) as writer:
            writer.add([make_episode(schema, 0)])
            if not keep:
                writer.finish()
        with pytest.raises(
            UserError, match=r"recorded with env\.action_scale=0\.085, this has 0\.02; give the same"
        ):
            DatasetWriter(out, schema, **options({"action_scale": 0.02}), resume=True)
        with DatasetWriter(out, schema, **options({"action_scale": 0.085}, "another"), resume=True) as writer:
            assert writer.resumed == 1


def test_images_of_another_camera_are_not_mixed(tmp_path, make_schema, make_episode) -> None:
    """Where there are images; without any, nobody sees the difference. Another robot is another one anyhow."""
    for observations in (("pixels", "state"), ("state",)):
        schema, out = make_schema(observations=observations), tmp_path / str(len(observations))

        def options(height: float, robot: str = "embedded") -> dict:
            env = {"camera_height": height, "robot": robot}
            provenance = describe(policy="p", seed=1, config={"env": env})
            return {"provenance": provenance, "workers": 0, "shard_frames": 1}

        with DatasetWriter(out, schema, **options(0.5)) as writer:
            writer.add([make_episode(schema, 0)])
        if schema.images:
            with pytest.raises(UserError, match=r"recorded with env\.camera_height=0\.5, this has 0\.7"):
                DatasetWriter(out, schema, **options(0.7), resume=True)
        with pytest.raises(UserError, match=r"recorded with env\.robot=embedded, this has panda_meshes"):
            DatasetWriter(out, schema, **options(0.5, "panda_meshes"), resume=True)
        with DatasetWriter(out, schema, **options(0.5 if schema.images else 0.7), resume=True) as writer:
            assert writer.resumed == 1


def test_scenes_are_not_mixed(tmp_path, make_schema, make_episode) -> None:
    """However they are written; one whose mesh is on another machine cannot be compared."""
    schema, cube = make_schema(observations=("state",)), {"name": "cube", "at": [0.5, 0.0]}

    def options(*objects: dict) -> dict:
        scene = {"objects": list(objects)} if objects else None
        provenance = describe(policy="p", seed=1, config={"env": {"task": "lift", "scene": scene}})
        return {"provenance": provenance, "workers": 0, "shard_frames": 1}

    for there in (cube, {**cube, "shape": "mesh", "file": "/elsewhere/cube.obj"}):
        out = tmp_path / there.get("shape", "box")
        with DatasetWriter(out, schema, **options(there)) as writer:
            writer.add([make_episode(schema, 0)])
        if there is cube:
            for others in (
                ({**cube, "size": [0.06, 0.06, 0.06]},),
                ({**cube, "mass": 1},),  # no image shows it, but what a push does
                (cube, {"name": "other", "at": [0.5, 0.2]}),
            ):
                with pytest.raises(UserError, match=r"another env\.scene; give the same, or another out"):
                    DatasetWriter(out, schema, **options(*others), resume=True)
        with DatasetWriter(
            out,
            schema,
            **options({**cube, "spread": [0.05, 0.0]}),
            resume=True,
        ) as writer:
            assert writer.resumed == 1


def test_goes_on_with_what_is_finished(tmp_path, make_schema, make_episode, load) -> None:
    schema = make_schema()
    episodes = [make_episode(schema, i) for i in range(6)]
    out = tmp_path / "set"
    with DatasetWriter(
        out, schema, provenance=describe(policy="first", seed=1, config={}), workers=0, shard_frames=7
    ) as writer:
        writer.add(episodes[:3])
    assert not out.exists()
    (tmp_path / "set.writing/shards/shard-00003.partial").mkdir()  # the number of the next
    with pytest.raises(UserError, match="unfinished"):
        DatasetWriter(out, schema, provenance={})
    with pytest.raises(
        UserError, match=r"features\.observation\.images\.front\.shape=\[16, 16, 3\], this has \[8, "
    ):
        DatasetWriter(out, make_schema(size=8), provenance={}, resume=True)
    for kept, added in ((3, episodes[3:5]), (5, episodes[5:])):  # the unfinished one, then the finished one
        with DatasetWriter(
            out,
            schema,
            provenance=describe(policy="then", seed=2, config={}),
            workers=0,
            shard_frames=7,
            resume=True,
        ) as writer:
            assert writer.resumed == kept
            writer.add(added)
            assert writer.finish() == out
    compare(load(out), schema, episodes)
    check_terminals(out, schema, episodes)
    provenance = read_provenance(out)
    assert provenance is not None
    assert [(s["policy"], s["episodes"]) for s in provenance["sessions"]] == [
        ("first", 3),
        ("then", 2),
        ("then", 1),
    ]
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def _merged(out: Path, schema, episodes, write, *, before: int) -> Path:
    """``OUT.writing`` as a kill leaves it before the first rename: of these episodes, so many are at OUT."""
    working = out.with_name(out.name + ".writing")
    if before:
        write(out, schema, episodes[:before])
    provenance = describe(policy="test", seed=0, config={})
    with DatasetWriter(
        out, schema, provenance=provenance, workers=0, shard_frames=1, resume=before > 0
    ) as writer:
        writer.add(episodes[before:])
        writer.flush()
        roots = ([out] if before else []) + sorted((working / "shards").iterdir())
        merge(working / "merged", roots, {"schema": schema.to_dict(), "sessions": []})
        writer._save_state(replacing=True)
    return working


@pytest.mark.parametrize("moved", [False, True])
def test_a_kill_while_the_finished_dataset_moves(
    tmp_path, moved, make_schema, make_episode, write, load
) -> None:
    schema, out = make_schema(), tmp_path / "set"
    episodes = [make_episode(schema, i) for i in range(3)]
    working = _merged(out, schema, episodes, write, before=2)
    os.rename(out, working / "previous")
    if moved:
        os.rename(working / "merged", out)
    write(out, schema, [], resume=True)
    compare(load(out), schema, episodes)


@pytest.mark.parametrize("before", [0, 2])
@pytest.mark.parametrize("refused", [True, False])
def test_going_on_after_that_may_be_refused_or_killed_too(
    tmp_path, monkeypatch, before, refused, make_schema, make_episode, write, load
) -> None:
    """Of what was merged already but is not in its place, the shards stay until it is."""
    schema, out = make_schema(), tmp_path / "set"
    episodes = [make_episode(schema, i) for i in range(4)]
    working = _merged(out, schema, episodes, write, before=before)
    if before:
        os.rename(out, working / "previous")
    with monkeypatch.context() as patched, pytest.raises(UserError if refused else KeyboardInterrupt):
        if not refused:
            patched.setattr(DatasetWriter, "_check_schema", _interrupted)
        write(out, make_schema(size=8), [], resume=True)
    write(out, schema, [], resume=True)
    compare(load(out), schema, episodes)


def _interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def test_nobody_is_told_to_remove_what_was_finished(tmp_path, make_schema, make_episode, write, load) -> None:
    schema, out = make_schema(), tmp_path / "set"
    episodes = [make_episode(schema, i) for i in range(2)]
    working = _merged(out, schema, episodes, write, before=1)
    os.rename(out, working / "previous")
    for resumable in (True, False):
        with pytest.raises(UserError, match=r"previous holds the dataset of .*move it back") as told:
            write(out, schema, [], resumable=resumable)
        assert " remove " not in str(told.value) and ("resume=true" in str(told.value)) == resumable
    os.rename(working / "previous", out)
    compare(load(out), schema, episodes[:1])


def test_a_kill_while_what_was_merged_is_removed(
    tmp_path, monkeypatch, make_schema, make_episode, write, load
) -> None:
    """Which files of a folder go first is the file system's choice: here what tells that they may go."""
    schema, out = make_schema(), tmp_path / "set"
    episodes = [make_episode(schema, i) for i in range(3)]
    remove = shutil.rmtree

    def killed(path: str | Path, **options: Any) -> None:
        if (state := Path(path, "writer.json")).exists():
            state.unlink()
            raise KeyboardInterrupt
        remove(path, **options)

    for part, resume in ((episodes[:2], False), (episodes[2:], True)):
        with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
            patched.setattr(shutil, "rmtree", killed)
            write(out, schema, part, resume=resume)
    write(out, schema, [], resume=True)
    compare(load(out), schema, episodes)
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_an_export_that_was_killed_is_made_again(tmp_path, make_schema, make_episode, write, load) -> None:
    """Of what was collected, which only ``resume`` goes on with, nothing is removed."""
    schema, out = make_schema(), tmp_path / "set"
    episodes = [make_episode(schema, i) for i in range(3)]
    for resumable in (True, False):
        with DatasetWriter(out, schema, provenance={}, workers=0, resumable=resumable) as writer:
            writer.add(episodes[:2])
            writer.flush()
        if resumable:
            with pytest.raises(UserError, match="unfinished"):
                write(out, schema, episodes, resumable=False)
            shutil.rmtree(writer.working)
    for resume, what in (
        (False, "holds an unfinished dataset"),
        (True, "is what an export left, which is not gone on"),
    ):
        with pytest.raises(UserError, match=what):
            write(out, schema, episodes, resume=resume)
    compare(load(write(out, schema, episodes, resumable=False)), schema, episodes)
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_two_writers_do_not_mix(tmp_path, make_schema, make_episode) -> None:
    schema = make_schema()
    with DatasetWriter(tmp_path / "set", schema, provenance={}, workers=0, shard_frames=1) as writer:
        writer.add([make_episode(schema, 0)])
        with pytest.raises(UserError, match="another process is writing"):
            DatasetWriter(tmp_path / "set", schema, provenance={}, resume=True)


def _write(given: Path, out: Path) -> None:
    """What is killed, in a process group of its own."""
    os.setsid()
    schema, episodes = pickle.loads(given.read_bytes())
    options: dict[str, Any] = {"workers": 2, "shard_frames": 21, "resume": True}
    with DatasetWriter(out, schema, provenance={"policy": "p"}, **options) as writer:
        writer.start(wait=True)
        print("ready", flush=True)
        there = keys_there(out)
        writer.add(episode for episode in episodes if episode.key not in there)
        writer.finish()


def _kill_and_go_on(tmp_path, schema, episodes, load, moments: list[float]) -> None:
    given = tmp_path / "given.pkl"
    given.write_bytes(pickle.dumps((schema, episodes)))
    out, finished = tmp_path / "set", 0
    by_key = {episode.key: episode for episode in episodes}
    for number, moment in enumerate(moments):
        work = functools.partial(_write, given, out)
        process = Fork(work, tmp_path, tmp_path / f"log{number}")
        ends = time.monotonic() + 60
        while "ready" not in process.said()[0] and time.monotonic() < ends:
            time.sleep(0.01)
        time.sleep(moment)
        os.killpg(process.pid, signal.SIGKILL) if moment < 0.5 else os.kill(process.pid, signal.SIGKILL)
        status = process.wait(10).returncode
        assert status == -signal.SIGKILL or out.exists(), process.said()
        if out.exists():  # it was done, and the kill met it while it removed its shards
            continue
        shards = sorted((tmp_path / "set.writing/shards").glob("shard-*[0-9]"))
        for shard in shards[:2]:  # what is there is a dataset of whole episodes, without going on
            keys = [key for key in by_key if key in set(_keys(shard))]
            compare(load(shard), schema, [by_key[key] for key in keys])
        finished = max(finished, len(shards))
    with DatasetWriter(out, schema, provenance={}, workers=0, resume=True) as writer:
        assert writer.resumed >= finished  # at least an episode in each of the shards that were there
        there = keys_there(out)
        writer.add(episode for episode in episodes if episode.key not in there)
        writer.finish()
    dataset = load(out)
    keys = list(dict.fromkeys(dataset.hf_dataset.with_format("numpy")[EPISODE_KEY][:].tolist()))
    assert len(keys) == dataset.num_episodes
    assert set(keys) == {episode.key for episode in episodes}
    compare(dataset, schema, [by_key[key] for key in keys])


def _keys(root: Path) -> np.ndarray:
    files = sorted((root / "data").glob("*/*.parquet"))
    return np.unique(
        np.concatenate([pq.read_table(f, columns=[EPISODE_KEY])[EPISODE_KEY].to_numpy() for f in files])
    )


def test_a_kill_leaves_whole_episodes(tmp_path, make_schema, make_episode, load) -> None:
    schema = make_schema()
    episodes = [make_episode(schema, i) for i in range(30)]
    _kill_and_go_on(tmp_path, schema, episodes, load, [0.0, 1.2])


@pytest.mark.slow
def test_kills_at_random_moments_leave_whole_episodes(tmp_path, make_schema, make_episode, load) -> None:
    schema = make_schema(size=32)
    episodes = [make_episode(schema, i) for i in range(120)]
    moments = [random.Random(i).uniform(0.0, 2.0) for i in range(5)]
    _kill_and_go_on(tmp_path, schema, episodes, load, moments)


def large(path: Path) -> None:
    """JSON that begins well and is larger than what is read."""
    path.write_bytes(path.read_bytes().rstrip().removesuffix(b"}") + b" " * MOST_JSON + b"}")


def changed(path: Path, **values: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def linked(data: Path) -> None:
    secret = data.parents[2] / "secret"
    secret.write_text("hunter2")
    file = next(data.rglob("*.parquet"))
    file.unlink()
    file.symlink_to(secret)


def climbing(info: Path) -> None:
    features = json.loads(info.read_text())["features"]
    changed(
        info, features=features | {"../../../climbed": {"dtype": "video", "shape": [1, 1, 3], "names": None}}
    )
    video = info.parents[3] / "climbed" / "chunk-000" / "file-000.mp4"
    video.parent.mkdir(parents=True)
    video.write_text("taken from elsewhere")


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("meta/info.json", large, "larger than 32 MiB"),
        ("meta/stats.json", large, "larger than 32 MiB"),
        ("meta/info.json", lambda path: changed(path, total_episodes="two"), "'two' episodes"),
        ("meta/info.json", lambda path: changed(path, total_frames=1e300), "makes no sense"),
        ("meta/info.json", climbing, "its features are not those"),
        (
            "meta/franka_wm/provenance.json",
            lambda path: changed(path, sessions=3),
            "sessions that are no list",
        ),
        ("meta/franka_wm/provenance.json", lambda path: path.write_text("{}"), "another form"),
        ("data", linked, "is a link to"),
    ],
)
def test_a_strangers_dataset_is_not_added_to(
    name: str, change, says: str, tmp_path, make_schema, make_episode, write
) -> None:
    schema = make_schema()
    out = write(tmp_path / "in" / "set", schema, [make_episode(schema, 0)])
    change(out / name)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(UserError, match=says):
        write(out, schema, [make_episode(schema, 1)], resume=True)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_signals_to_the_whole_group_are_not_for_writing_processes(
    tmp_path, make_schema, make_episode, load
) -> None:
    """Who sends them their jobs ends what it is at; what they have begun is written."""
    schema = make_schema()
    episodes = [make_episode(schema, i) for i in range(4)]
    with DatasetWriter(tmp_path / "set", schema, provenance={}, workers=1, shard_frames=7) as writer:
        writer.add(episodes[:2])
        writer.flush()
        worker = writer._workers[0]
        for number in (signal.SIGINT, signal.SIGTERM):
            os.kill(worker._process.pid, number)  # pyright: ignore[reportAttributeAccessIssue]
        writer.add(episodes[2:])
        writer.finish()
    compare(load(tmp_path / "set"), schema, episodes)


def test_another_robot_is_one_that_is_simulated() -> None:
    def told(there: dict, here: dict) -> str | None:
        changed = other_option([{"config": {"env": there}}], here)
        return changed and changed[0]

    assert told({"robot": "embedded"}, {"robot": "panda_meshes"}) == "robot"
    assert told({"robot": "panda_meshes"}, {"robot": "panda_meshes_full"}) is None, "the same, drawn finer"
    asset = {"robot": "newton_asset", "asset_name": "a"}
    assert told(asset, {**asset, "asset_name": "b"}) == "asset_name"
    assert told({"robot": "embedded", "asset_name": "a"}, {"robot": "embedded", "asset_name": "b"}) is None
    own = {"robot": "embedded", "urdf_path": "/here/arm.urdf"}
    assert told(own, {"robot": "panda_meshes", "urdf_path": "/there/arm.urdf"}) is None, (
        "the file goes before"
    )
    assert told(own, {"robot": "embedded", "urdf_path": None}) == "urdf_path"
