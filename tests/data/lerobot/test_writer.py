"""What is written is what LeRobot reads, bit for bit where that is promised."""

from __future__ import annotations

import json
import os
import random
import shutil
from fractions import Fraction

import numpy as np
import pyarrow.parquet as pq
import pytest

from dataset_episodes import as_picture, check_terminals, compare
from franka_wm.data.lerobot import merge as merging
from franka_wm.data.lerobot import writer as writing
from franka_wm.data.lerobot.merge import merge, merge_terminals
from franka_wm.data.lerobot.schema import ACTION, DONE, STATE
from franka_wm.data.lerobot.shard import ENCODERS, arrow_schema, write_shard
from franka_wm.data.lerobot.writer import DatasetWriter
from franka_wm.errors import UserError

FRONT = "observation.images.front"
LENGTHS = (7, 3, 12, 1, 5)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    error = ((a.astype(float) - b.astype(float)) ** 2).mean()
    return 99.0 if error == 0 else float(10 * np.log10(255**2 / error))


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


def test_what_is_written_reaches_the_disk_before_its_shards_go(
    tmp_path, monkeypatch, make_schema, make_episode, write
) -> None:
    """A machine that loses power then has either."""
    synced = []
    monkeypatch.setattr(
        writing, "sync", lambda path: synced.append((path, len(list(tmp_path.glob("*/shards/*")))))
    )
    schema = make_schema()
    root = write(tmp_path / "set", schema, [make_episode(schema, 0, 3)])
    inside = [(path, shards) for path, shards in synced if path != root.parent]
    names = {
        path.relative_to(next(p for p in (path, *path.parents) if p.name == "merged")) for path, _ in inside
    }
    assert names == {path.relative_to(root) for path in (root, *root.rglob("*"))}
    assert all(shards for _, shards in inside) and synced[-1][0] == root.parent


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


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="the encoder asks for it as root alone"
)
def test_an_encoder_does_not_run_before_all_others(tmp_path, monkeypatch, make_schema, make_episode) -> None:
    """SVT-AV1 would: it makes its threads, and the one that calls it, realtime."""
    from franka_wm.data.lerobot import shard

    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        pytest.skip("this root may not make threads realtime")
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    seen: list[set[int]] = []

    def fraction(*of: int) -> Fraction:
        """Of each frame, so after the codec was opened."""
        seen.append(shard._realtime_threads())
        return Fraction(*of)

    monkeypatch.setattr(shard, "Fraction", fraction)
    schema = make_schema("video", size=64)
    write_shard(tmp_path / "shard", schema, [make_episode(schema, 0, 5)])
    assert len(seen) > 5 and not any(seen)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_a_merge_that_goes_wrong_is_noticed(tmp_path, monkeypatch, make_schema, make_episode, write) -> None:
    schema = make_schema()
    roots = [write(tmp_path / str(i), schema, [make_episode(schema, i)]) for i in range(2)]
    whole = merging._move_rows
    monkeypatch.setattr(merging, "_move_rows", lambda *given: whole(*given[:3], 0, 0))  # keeps their numbers
    with pytest.raises(UserError, match="not numbered one after the other"):
        merge(tmp_path / "merged", roots, {})


def test_no_writing_without_room_says_so(tmp_path, make_schema) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(UserError, match="file is not a folder; choose another folder"):
        DatasetWriter(blocked / "set", make_schema(), provenance={})
    shutil.rmtree(tmp_path, ignore_errors=True)
