"""What is written is what LeRobot reads, bit for bit where that is promised."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from franka_wm.data.lerobot.merge import merge, merge_terminals
from franka_wm.data.lerobot.provenance import describe, read_provenance
from franka_wm.data.lerobot.schema import ACTION, DONE, EPISODE_KEY, STATE
from franka_wm.data.lerobot.shard import ENCODERS, arrow_schema, write_shard
from franka_wm.data.lerobot.terminal import read_terminals
from franka_wm.data.lerobot.writer import DatasetWriter
from franka_wm.errors import UserError

FRONT = "observation.images.front"
LENGTHS = (7, 3, 12, 1, 5)


def as_picture(tensor) -> np.ndarray:
    """(C, H, W) in [0, 1], as LeRobot gives it, to (H, W, C) uint8."""
    return (tensor.numpy() * 255).round().astype(np.uint8).transpose(1, 2, 0)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    error = ((a.astype(float) - b.astype(float)) ** 2).mean()
    return 99.0 if error == 0 else float(10 * np.log10(255**2 / error))


def compare(dataset, schema, episodes, *, pictures: bool = True) -> None:
    """Every row, by its index."""
    assert dataset.num_frames == sum(episode.length for episode in episodes)
    index = 0
    for number, episode in enumerate(episodes):
        for t in range(episode.length):
            item = dataset[index]
            assert (item["episode_index"], item["frame_index"], item["index"]) == (number, t, index)
            assert item["timestamp"].item() == np.float32(t / schema.fps)
            assert item["task"] == schema.task
            for name in schema.numbers:
                expected = episode.rows[name][t]
                value = item[name].numpy().reshape(expected.shape)
                assert value.dtype == expected.dtype, name
                assert np.array_equal(value, expected), name
            for name in schema.images if pictures else ():
                assert np.array_equal(as_picture(item[name]), episode.rows[name][t]), (name, index)
            index += 1


def test_every_index_comes_back_exactly(tmp_path, make_schema, make_episode, write, load) -> None:
    schema = make_schema()
    episodes = [make_episode(schema, i, length) for i, length in enumerate(LENGTHS)]
    root = write(tmp_path / "set", schema, episodes, shard_frames=9)  # more than one shard
    dataset = load(root)
    assert len(list((root / "data").glob("*/*.parquet"))) == 3
    compare(dataset, schema, episodes)
    assert dataset.meta.robot_type == "franka_fr3"
    assert dataset.meta.names[ACTION][0] == "joint_1.target_change"


@pytest.mark.parametrize("format", ["video", "video_near_lossless"])
def test_videos_have_every_frame_and_exact_numbers(tmp_path, format, make_schema, make_episode, write, load):
    schema = make_schema(format, size=64 if format == "video" else 32)
    episodes = [make_episode(schema, i, length) for i, length in enumerate(LENGTHS)]
    dataset = load(write(tmp_path / "set", schema, episodes, shard_frames=9))
    compare(dataset, schema, episodes, pictures=False)
    if format == "video":
        return
    decoded = [as_picture(dataset[i][FRONT]) for i in range(len(dataset))]
    begin = 0
    for episode in episodes:
        true = episode.rows[FRONT]
        for t in range(episode.length):
            shown = decoded[begin + t]
            own = psnr(shown, true[t])
            assert own >= 30
            neighbours = [true[t + d] for d in (-1, 1) if 0 <= t + d < episode.length]
            assert all(own > psnr(shown, other) for other in neighbours)
        begin += episode.length


@pytest.mark.parametrize("format", ["exact", "video_near_lossless"])
def test_windows_with_padding_at_both_ends(tmp_path, format, make_schema, make_episode, write, load) -> None:
    schema = make_schema(format, size=32)
    episodes = [make_episode(schema, i, 6) for i in range(3)]
    root = write(tmp_path / "set", schema, episodes, shard_frames=6)
    offsets = (-2, 0, 1, 3)
    times = [d / schema.fps for d in offsets]
    dataset = load(root, delta_timestamps={STATE: times, FRONT: times})
    order = list(range(len(dataset)))
    random.Random(0).shuffle(order)
    for index in order:
        number, t = divmod(index, 6)
        item, true = dataset[index], episodes[number].rows
        for place, offset in enumerate(offsets):
            shown = min(max(t + offset, 0), 5)
            outside = shown != t + offset
            assert item[f"{STATE}_is_pad"][place] == item[f"{FRONT}_is_pad"][place] == outside
            assert np.array_equal(item[STATE][place].numpy(), true[STATE][shown])
            assert psnr(as_picture(item[FRONT][place]), true[FRONT][shown]) >= (
                99 if format == "exact" else 30
            )


def test_a_subset_of_episodes(tmp_path, make_schema, make_episode, write, load) -> None:
    schema = make_schema()
    episodes = [make_episode(schema, i, length) for i, length in enumerate(LENGTHS)]
    dataset = load(write(tmp_path / "set", schema, episodes, shard_frames=9), episodes=[1, 4])
    rows = [dataset[i] for i in range(len(dataset))]
    expected = np.concatenate([episodes[i].rows[STATE] for i in (1, 4)])
    assert np.array_equal(np.stack([row[STATE].numpy() for row in rows]), expected)


# -- the same files as LeRobot's --------------------------------------------------------------------------------


@pytest.mark.parametrize("format", ["exact", "video_near_lossless"])
def test_a_shard_is_what_the_recorder_writes(tmp_path, format, make_schema, make_episode) -> None:
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.feature_utils import get_hf_features_from_features
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    schema = make_schema(format, size=32)
    episodes = [make_episode(schema, i, 8) for i in range(2)]
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    write_shard(ours, schema, episodes)
    encoder = RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=0, extra_options={"bf": 0})
    options = {} if format == "exact" else {"rgb_encoder": encoder, "encoder_threads": 1}
    recorder = LeRobotDataset.create(
        "test/set",
        fps=schema.fps,
        features=schema.features,
        root=theirs,
        robot_type=schema.robot_type,
        use_videos=format != "exact",
        **options,
    )
    for episode in episodes:
        for t in range(episode.length):
            frame = {name: episode.rows[name][t] for name in schema.features}
            recorder.add_frame(frame | {"task": schema.task})
        recorder.save_episode()
    recorder.finalize()

    info = [json.loads((root / "meta" / "info.json").read_text()) for root in (ours, theirs)]
    assert info[0] == info[1]
    tables = [pq.read_table(root / "data/chunk-000/file-000.parquet") for root in (ours, theirs)]
    assert tables[0].schema.equals(tables[1].schema)
    hf = get_hf_features_from_features(info[1]["features"] | _tuples(info[1]["features"]))
    notes = [
        json.loads(one.metadata[b"huggingface"])
        for one in (arrow_schema(info[0]["features"]), hf.arrow_schema)
    ]
    assert notes[0]["info"] == notes[1]["info"]
    for name in tables[0].column_names:
        if name != FRONT:  # the PNG are others, the pictures are compared elsewhere
            assert tables[0][name].equals(tables[1][name]), name
    meta = [pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet") for root in (ours, theirs)]
    assert set(meta[0].column_names) == set(meta[1].column_names)
    for name in meta[0].column_names:
        assert meta[0].schema.field(name).type == meta[1].schema.field(name).type, name
        if name.startswith("videos/"):
            assert meta[0][name].to_pylist() == pytest.approx(meta[1][name].to_pylist()), name
        elif not name.startswith("stats/"):
            assert meta[0][name].equals(meta[1][name]), name
    stats = [json.loads((root / "meta/stats.json").read_text()) for root in (ours, theirs)]
    for name, theirs_of in stats[1].items():
        for stat, value in theirs_of.items():
            spread = np.ptp([theirs_of["min"], theirs_of["max"]], axis=0)  # histograms of 5,000 bins
            error = np.abs(np.asarray(stats[0][name][stat]) - np.asarray(value))
            assert (error <= 1e-5 + 1e-5 * np.abs(value) + spread / 2000).all(), (name, stat)


def _tuples(features: dict) -> dict:
    return {name: feature | {"shape": tuple(feature["shape"])} for name, feature in features.items()}


def test_encoders_are_lerobots() -> None:
    from lerobot.configs.video import RGBEncoderConfig

    default = RGBEncoderConfig()
    assert ENCODERS["video"].options == default.get_codec_options(1, as_strings=True)
    assert (ENCODERS["video"].codec, ENCODERS["video"].pix_fmt) == (default.vcodec, default.pix_fmt)
    near = RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=0, extra_options={"bf": 0})
    assert ENCODERS["video_near_lossless"].options == near.get_codec_options(1, as_strings=True)


@pytest.mark.parametrize("format", ["exact", "video_near_lossless"])
def test_merging_gives_what_lerobot_merges(tmp_path, format, make_schema, make_episode) -> None:
    from lerobot.datasets.aggregate import aggregate_datasets

    schema = make_schema(format)
    roots = [tmp_path / f"shard-{i}" for i in range(3)]
    for i, root in enumerate(roots):
        write_shard(root, schema, [make_episode(schema, 10 * i + j, 4 + j) for j in range(2)])
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    merge(ours, roots, {})
    aggregate_datasets(
        [root.name for root in roots],
        "test/set",
        roots=roots,
        aggr_root=theirs,
        concatenate_data=False,
        concatenate_videos=False,
    )
    one, two = (json.loads((root / "meta/info.json").read_text()) for root in (ours, theirs))
    assert one == two
    for kind in ("data", "meta/episodes"):
        tables = []
        for root in (ours, theirs):
            files = sorted((root / kind).glob("*/*.parquet"))
            tables.append([row for file in files for row in pq.read_table(file).to_pylist()])
        for mine, other in zip(*tables, strict=True):
            ignored = (
                "meta/episodes/file_index"  # they join the episodes' table, we keep a file for each shard
            )
            assert {k: v for k, v in mine.items() if k != ignored} == {
                k: other[k] for k in mine if k != ignored
            }
    stats = [json.loads((root / "meta/stats.json").read_text()) for root in (ours, theirs)]
    for name, values in stats[1].items():
        for stat, value in values.items():
            np.testing.assert_allclose(stats[0][name][stat], value, rtol=1e-6, atol=1e-9)
    names = [sorted(p.relative_to(r).as_posix() for p in r.rglob("*.mp4")) for r in (ours, theirs)]
    assert names[0] == names[1]


def test_lerobot_merges_two_of_ours(tmp_path, make_schema, make_episode, write, load) -> None:
    from lerobot.datasets.aggregate import aggregate_datasets

    for format in ("exact", "video_near_lossless"):
        schema = make_schema(format)
        sets = [[make_episode(schema, 10 * k + i, 5 + i) for i in range(3)] for k in range(2)]
        roots = [write(tmp_path / f"{format}-{k}", schema, one, shard_frames=6) for k, one in enumerate(sets)]
        out = tmp_path / f"{format}-both"
        aggregate_datasets(["a", "b"], "test/set", roots=roots, aggr_root=out)
        merge_terminals(out, roots)
        everything = sets[0] + sets[1]
        compare(load(out), schema, everything, pictures=format == "exact")
        check_terminals(out, schema, everything)


def check_terminals(root: Path, schema, episodes) -> None:
    features = {name: schema.features[name] for name in schema.observed}
    found = read_terminals(
        root, keys=[e.key for e in episodes], lengths=[e.length for e in episodes], features=features
    )
    assert found.problem is None
    assert found.found.all()
    for i, episode in enumerate(episodes):
        for name in schema.observed:
            assert np.array_equal(found.values[name][i], episode.terminal[name]), name


# -- what is refused --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", ["exact", "video", "video_near_lossless"])
def test_episodes_of_one_frame(tmp_path, format, make_schema, make_episode, write, load) -> None:
    schema = make_schema(format, size=64)
    episodes = [make_episode(schema, i, 1) for i in range(3)]
    root = write(tmp_path / "set", schema, episodes, shard_frames=1)
    compare(load(root), schema, episodes, pictures=format == "exact")
    check_terminals(root, schema, episodes)


def _nan(episode):
    episode.rows[STATE][2, 3] = np.nan


def _infinite_end(episode):
    episode.terminal[STATE][0] = np.inf


def _double(episode):
    episode.rows[ACTION] = episode.rows[ACTION].astype(np.float64)


def _narrow(episode):
    episode.rows[ACTION] = episode.rows[ACTION][:, :6]


def _empty(episode):
    for name in episode.rows:
        episode.rows[name] = episode.rows[name][:0]


def _no_end(episode):
    episode.rows[DONE][-1] = False


def _two_ends(episode):
    episode.rows[DONE][2] = True


def _missing(episode):
    del episode.rows[ACTION]


def _unknown(episode):
    episode.rows["more"] = episode.rows[ACTION]


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (_nan, "observation.state holds NaN"),
        (_infinite_end, "observation.state holds NaN or infinity"),
        (_double, "action is float64"),
        (_narrow, r"action is float32 \(7, 6\)"),
        (_empty, "no steps"),
        (_no_end, "next.done must be true in the last"),
        (_two_ends, "next.done must be true in the last"),
        (_missing, "lacks 'action'"),
        (_unknown, "has 'more'"),
    ],
)
def test_what_cannot_be_written_is_refused(
    tmp_path, spoil, says, make_schema, make_episode, write, load
) -> None:
    schema = make_schema()
    good, bad = make_episode(schema, 0), make_episode(schema, 1)
    spoil(bad)
    with DatasetWriter(tmp_path / "set", schema, provenance={}, workers=0) as writer:
        writer.add([good])
        with pytest.raises(UserError, match=says) as error:
            writer.add([bad])
        assert "\n" not in str(error.value)
        compare(load(writer.finish()), schema, [good])


def test_a_dataset_of_nothing_is_refused(tmp_path, make_schema) -> None:
    writer = DatasetWriter(tmp_path / "set", make_schema(), provenance={}, workers=0)
    with pytest.raises(UserError, match="no episode"):
        writer.finish()
    assert list(tmp_path.iterdir()) == []


def test_a_video_that_lost_frames_is_noticed(tmp_path, monkeypatch, make_schema, make_episode) -> None:
    from franka_wm.data.lerobot import shard

    def lossy(path, pictures, schema):
        whole(path, [pictures[0][:-1], *pictures[1:]], schema)

    whole = shard.encode_video
    monkeypatch.setattr(shard, "encode_video", lossy)
    schema = make_schema("video_near_lossless")
    with pytest.raises(UserError, match="14 frames were written, 13 can be read"):
        write_shard(tmp_path / "shard", schema, [make_episode(schema, i, 7) for i in range(2)])


# -- going on ---------------------------------------------------------------------------------------------------


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
    with pytest.raises(UserError, match="other features"):
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


@pytest.mark.parametrize("moved", [False, True])
def test_a_kill_while_the_finished_dataset_moves(
    tmp_path, moved, make_schema, make_episode, write, load
) -> None:
    schema = make_schema()
    episodes = [make_episode(schema, i) for i in range(3)]
    out, working = write(tmp_path / "set", schema, episodes[:2]), tmp_path / "set.writing"
    with DatasetWriter(out, schema, provenance={}, workers=0, resume=True) as writer:
        writer.add(episodes[2:])
        writer.flush()
        merge(
            working / "merged",
            [out, *sorted((working / "shards").iterdir())],
            {"schema": schema.to_dict(), "sessions": []},
        )
        writer._save_state(replacing=True)
    os.rename(out, working / "previous")
    if moved:
        os.rename(working / "merged", out)
    write(out, schema, [], resume=True)
    compare(load(out), schema, episodes)


def test_two_writers_do_not_mix(tmp_path, make_schema, make_episode) -> None:
    schema = make_schema()
    with DatasetWriter(tmp_path / "set", schema, provenance={}, workers=0, shard_frames=1) as writer:
        writer.add([make_episode(schema, 0)])
        with pytest.raises(UserError, match="another process is writing"):
            DatasetWriter(tmp_path / "set", schema, provenance={}, resume=True)


def test_processes_write_the_same(tmp_path, make_schema, make_episode, write, load) -> None:
    schema = make_schema()
    episodes = [make_episode(schema, i) for i in range(6)]
    root = write(tmp_path / "set", schema, episodes, workers=2, shard_frames=7)
    compare(load(root), schema, episodes)
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_a_writing_process_that_dies_is_one_line(tmp_path, make_schema, make_episode, write, load) -> None:
    schema = make_schema()
    episodes = [make_episode(schema, i) for i in range(4)]
    out = tmp_path / "set"
    with DatasetWriter(out, schema, provenance={}, workers=1, shard_frames=7) as writer:
        writer.add(episodes[:2])
        writer.flush()
        worker = writer._workers[0]
        os.kill(worker._process.pid, signal.SIGKILL)  # pyright: ignore[reportAttributeAccessIssue]
        with pytest.raises(UserError, match="a writing process ended"):
            writer.add(episodes[2:])
            writer.flush()
    write(out, schema, episodes[2:], resume=True)
    compare(load(out), schema, episodes)


KILLED = """
import os, pickle, sys
from franka_wm.data.lerobot.writer import DatasetWriter
schema, episodes = pickle.load(open(sys.argv[1], "rb"))
options = dict(provenance={"policy": "p"}, workers=2, shard_frames=21, resume=True)
with DatasetWriter(sys.argv[2], schema, **options) as writer:
    writer.start(wait=True)
    print("ready", flush=True)
    there = writer.keys()
    writer.add(episode for episode in episodes if episode.key not in there)
    writer.finish()
"""


def _kill_and_go_on(tmp_path, schema, episodes, load, moments: list[float]) -> None:
    import pickle

    code, given = tmp_path / "run.py", tmp_path / "given.pkl"
    code.write_text(KILLED)
    given.write_bytes(pickle.dumps((schema, episodes)))
    out, finished = tmp_path / "set", 0
    by_key = {episode.key: episode for episode in episodes}
    for moment in moments:
        with subprocess.Popen(
            [sys.executable, str(code), str(given), str(out)], stdout=subprocess.PIPE, start_new_session=True
        ) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(moment)
            os.killpg(process.pid, signal.SIGKILL) if moment < 0.5 else process.kill()
        if out.exists():  # it was done, and the kill met it while it removed its shards
            continue
        shards = sorted((tmp_path / "set.writing/shards").glob("shard-*[0-9]"))
        for shard in shards[:2]:  # what is there is a dataset of whole episodes, without going on
            keys = [key for key in by_key if key in set(_keys(shard))]
            compare(load(shard), schema, [by_key[key] for key in keys])
        finished = max(finished, len(shards))
    with DatasetWriter(out, schema, provenance={}, workers=0, resume=True) as writer:
        assert writer.resumed >= finished  # at least an episode in each of the shards that were there
        there = writer.keys()
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
def test_kills_at_ten_random_moments_leave_whole_episodes(tmp_path, make_schema, make_episode, load) -> None:
    schema = make_schema(size=32)
    episodes = [make_episode(schema, i) for i in range(120)]
    moments = [random.Random(i).uniform(0.0, 2.0) for i in range(10)]
    _kill_and_go_on(tmp_path, schema, episodes, load, moments)


def test_no_writing_without_room_says_so(tmp_path, make_schema) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(UserError, match="cannot write there"):
        DatasetWriter(blocked / "set", make_schema(), provenance={})
    shutil.rmtree(tmp_path, ignore_errors=True)
