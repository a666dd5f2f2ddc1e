"""The last observation survives LeRobot's tools, or its loss is said."""

from __future__ import annotations

import io
import shutil
import struct
import zlib

import av
import numpy as np
import pytest

from franka_wm.data.lerobot.png import decode_image, encode_png
from franka_wm.data.lerobot.schema import EPISODE_KEY, OWN_FOLDER
from franka_wm.data.lerobot.terminal import TERMINAL_FOLDER, read_terminals
from franka_wm.errors import UserError


def read(root, schema, episodes, lengths=None):
    return read_terminals(
        root,
        keys=[episode.key for episode in episodes],
        lengths=[episode.length for episode in episodes] if lengths is None else lengths,
        features={name: schema.features[name] for name in schema.observed},
    )


@pytest.fixture
def dataset(tmp_path, make_schema, make_episode, write):
    schema = make_schema()
    episodes = [make_episode(schema, i, 4 + i) for i in range(5)]
    return write(tmp_path / "set", schema, episodes, shard_frames=9), schema, episodes


def test_they_are_found_in_any_order(dataset) -> None:
    root, schema, episodes = dataset
    order = [3, 0, 4, 1, 2, 3]
    found = read(root, schema, [episodes[i] for i in order])
    assert found.problem is None
    for place, i in enumerate(order):
        for name in schema.observed:
            assert np.array_equal(found.values[name][place], episodes[i].terminal[name])
            assert found.values[name].dtype == schema.numpy_dtype(name)


def test_lerobots_tools_lose_them_and_that_is_said(tmp_path, dataset, load) -> None:
    from lerobot.datasets.dataset_tools import delete_episodes

    root, schema, episodes = dataset
    fewer = delete_episodes(load(root), [1], output_dir=tmp_path / "fewer", repo_id="test/fewer")
    kept = [episodes[i] for i in (0, 2, 3, 4)]
    keys = list(dict.fromkeys(fewer.hf_dataset.with_format("numpy")[EPISODE_KEY][:].tolist()))
    assert keys == [episode.key for episode in kept]
    found = read(tmp_path / "fewer", schema, kept)
    assert not found.found.any()
    assert found.problem is not None
    assert "4 of 4 episodes have no terminal observation (there is no meta/franka_wm" in found.problem
    assert "\n" not in found.problem
    shutil.copytree(root / OWN_FOLDER, tmp_path / "fewer" / OWN_FOLDER)  # as the docs say
    assert read(tmp_path / "fewer", schema, kept).problem is None


def test_episodes_that_changed_are_not_matched(dataset) -> None:
    root, schema, episodes = dataset
    found = read(root, schema, episodes, lengths=[e.length - (i == 2) for i, e in enumerate(episodes)])
    assert list(found.found) == [True, True, False, True, True]
    assert found.problem is not None
    assert "1 episodes changed their length" in found.problem


def test_another_datasets_file_is_refused(dataset, make_schema) -> None:
    root, _, episodes = dataset
    other = make_schema(cameras=("wrist",))
    with pytest.raises(UserError, match="belongs to another dataset"):
        read(root, other, episodes)
    assert (root / TERMINAL_FOLDER).is_dir()


@pytest.mark.parametrize("shape", [(1, 1, 3), (16, 16, 3), (7, 33, 3)])
def test_png_is_exact_for_any_decoder(shape) -> None:
    picture = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    assert np.array_equal(decode_image(encode_png(picture)), picture)
    with av.open(io.BytesIO(encode_png(picture)), format="png_pipe") as container:
        frame = next(container.decode(video=0))
    assert np.array_equal(frame.to_ndarray(format="rgb24"), picture)


@pytest.mark.parametrize("side", [9_000, 20_000])
def test_a_png_of_too_many_pixels_is_no_value(side: int) -> None:
    """Its header alone says so: refused by us, or by Pillow before."""
    data = encode_png(np.zeros((1, 1, 3), np.uint8))
    header = b"IHDR" + struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    bomb = data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]
    with pytest.raises(ValueError, match="pixels"):
        decode_image(bomb)


def test_only_a_whole_png_is_a_value() -> None:
    """Pillow would start Ghostscript for a program in PostScript, and has errors of its own for what is damaged."""
    with pytest.raises(ValueError, match="cannot identify"):
        decode_image(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 16 16\n%%EndComments\nshowpage\n%%EOF\n")
    data = encode_png(np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8))
    begun = (
        data[:33] + struct.pack(">I", 2000) + data[37:2041] + b"crc?"
    )  # a part of the values, and then no chunk
    with pytest.raises(ValueError, match="broken PNG"):
        decode_image(begun + struct.pack(">I", 100) + b"\1\2\3\4" + data[2041:])
