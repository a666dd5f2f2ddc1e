"""Datasets, held against the episodes they were made of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from franka_wm.data.lerobot.terminal import TERMINAL_FOLDER, read_terminals


def as_picture(tensor) -> np.ndarray:
    """(C, H, W) in [0, 1], as LeRobot gives it, to (H, W, C) uint8."""
    return (tensor.numpy() * 255).round().astype(np.uint8).transpose(1, 2, 0)


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


def keys_there(out: Path) -> set[int]:
    """Keys of the episodes on disk: of the dataset, and of the shards that a kill has left of a writing."""
    roots = [out, *Path(f"{out}.writing").glob("shards/shard-*[0-9]")]
    files = [file for root in roots for file in (root / TERMINAL_FOLDER).glob("*.parquet")]
    return {key for file in files for key in pq.read_table(file)["episode_key"].to_pylist()}


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
