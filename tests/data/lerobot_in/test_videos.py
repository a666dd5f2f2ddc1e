"""Videos of datasets: what reads them, and frames that are missing, too many or too large."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch

from franka_wm.data.lerobot import decode
from franka_wm.data.lerobot.card import make_image
from franka_wm.errors import UserError


def write_frames(path: Path, frames: list[np.ndarray], every: int = 1) -> None:
    """A video at ten frames per second, each an image of its own, whatever size the first one has.

    Args:
        every: Tenths of a second from one to the next.
    """
    with av.open(str(path), "w", format="mp4") as file:
        stream: Any = file.add_stream("mjpeg", rate=10)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuvj420p"
        for k, frame in enumerate(frames):
            encoder: Any = av.CodecContext.create("mjpeg", "w")
            encoder.height, encoder.width = frame.shape[:2]
            encoder.pix_fmt, encoder.time_base = "yuvj420p", Fraction(1, 10)
            image = av.VideoFrame.from_ndarray(frame, format="rgb24")
            for packet in (*encoder.encode(image), *encoder.encode(None)):
                packet.stream, packet.time_base = stream, Fraction(1, 10)
                packet.pts = packet.dts = k * every
                file.mux(packet)


def test_one_video_for_two_entries(video: Path, opened: Callable) -> None:
    side = "observation.images.side"
    batch = opened(video, features={"pixels": side, "pixels_again": side}).windows(torch.arange(10))
    assert torch.equal(batch["pixels"], batch["pixels_again"]) and batch["pixels"].any()


def test_frames_have_as_many_pixels_as_images_may(
    video: Path, opened: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """What a few bytes become as they are decoded is bounded: of a whole video, and of a frame among others."""
    monkeypatch.setattr(decode, "MOST_PIXELS", 200 * 200)
    root = tmp_path / "data"
    shutil.copytree(video, root)
    paths = list(root.rglob("*.mp4"))
    for sides, says in (
        ([200] * 16, ""),
        ([201] * 16, r"mp4 has frames of 201 × 201 pixels, the most is 40,000; record it smaller"),
        ([200, 200, 208] + [200] * 13, "mp4 has frames of 208 × 208 pixels"),
        ([200, 200, 400] + [200] * 13, r"mp4 cannot be decoded \(.*\); .* of at most 40,000 pixels"),
    ):
        for path in paths:
            write_frames(path, [np.zeros((side, side, 3), np.uint8) for side in sides])
        if not says:
            assert len(opened(root)) == 10
            continue
        with pytest.raises(UserError, match=says) as error:
            opened(root)
        assert "\n" not in str(error.value)
        with pytest.raises(UserError, match=r"frames of|another form"):  # as it is published
            make_image(root, tmp_path / "image.gif")
    assert len(list((tmp_path / "cache").glob("*/cache.json"))) == 1


def test_frames_and_rows_do_not_agree(video: Path, opened: Callable, tmp_path: Path) -> None:
    """A dropped frame shifts all that follow: refused, not trained on."""
    root = tmp_path / "data"
    shutil.copytree(video, root)
    path = next((root / "videos" / "observation.images.side").rglob("*.mp4"))
    frames: list[Any] = []
    with av.open(str(path)) as old:
        frames += [frame.to_ndarray(format="rgb24") for frame in old.decode(video=0)]
    assert len(frames) == 16
    for kept, message in ((15, "has 15 frames, its episodes have 16 rows"), (17, "has 17 frames")):
        with av.open(str(path), "w", format="mp4") as new:
            stream = new.add_stream("mpeg4", rate=10)
            stream.width = stream.height = 32  # type: ignore[attr-defined]
            for picture in (frames + frames)[:kept]:
                for packet in stream.encode(av.VideoFrame.from_ndarray(picture)):  # type: ignore[attr-defined]
                    new.mux(packet)
            new.mux(stream.encode(None))  # type: ignore[attr-defined]
        with pytest.raises(UserError, match=message) as error:
            opened(root)
        assert "\n" not in str(error.value)
    path.write_bytes(b"no video")
    with pytest.raises(UserError, match="cannot be decoded"):
        opened(root)
    assert not list((tmp_path / "cache").glob("*/"))


def test_frames_at_other_times_than_their_rows(video: Path, opened: Callable, tmp_path: Path) -> None:
    """As many as there should be, at half the rate; and two episodes that begin at one time."""
    root = tmp_path / "data"
    shutil.copytree(video, root)
    for path in root.rglob("*.mp4"):
        write_frames(path, [np.zeros((32, 32, 3), np.uint8)] * 16, every=2)
    with pytest.raises(UserError, match="8 of 16 rows have no frame at their time"):
        opened(root)
    job = decode.VideoJob("a.mp4", "f", 10, [0, 1], [0.0, 0.4], [], "")
    with pytest.raises(UserError, match="two episodes claim frame 4"):
        job._row_at(np.array([[0, 5, 0], [5, 4, 0]]))
