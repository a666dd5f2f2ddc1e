"""Files of others: nothing is taken from this machine, from outside of the folder, or without a bound."""

from __future__ import annotations

import json
import os
import struct
import time
import zlib
from pathlib import Path

import pytest
import torch

from franka_wm.commands import main as cli
from franka_wm.data.lerobot.source import read_source
from franka_wm.errors import UserError
from franka_wm.untrusted import MOST_JSON, MOST_YAML, UntrustedFolder, check_image, check_video, values_of

SECRET = "hunter2-of-this-machine"
INFO = {"codebase_version": "v3.0", "features": {}, "fps": 10, "total_episodes": 1, "total_frames": 1}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The smallest folder that `report` takes."""
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yaml").write_text("env: {task: reach}\nmodel: {name: tdmpc2}\nseed: 0\n")
    return folder


def refused(run: Path, says: str, capsys) -> None:
    """`report` and `compare` refuse the folder in one line and write nothing."""
    other = run.parent / "other"
    other.mkdir(exist_ok=True)
    (other / "config.yaml").write_text("seed: 1\n")
    out = run.parent / "page.html"
    for arguments in (["report", str(run)], ["compare", str(run), str(other)]):
        assert cli.main([*arguments, f"out={out}"]) == 1
        said = capsys.readouterr().err
        assert says in said and said.count("\n") == 1 and not out.exists()


def test_no_interpolation_is_resolved_into_a_page(run: Path, monkeypatch) -> None:
    monkeypatch.setenv("SECRET", SECRET)
    (run / "config.yaml").write_text(
        "seed: ${oc.env:SECRET}\nnote: ${oc.env:SECRET}\nmodel: {name: '${note}'}\n"
    )
    (run / ".hydra").mkdir()
    (run / ".hydra" / "overrides.yaml").write_text("- note=${oc.env:SECRET}\n")
    other = run.parent / "other"
    other.mkdir()
    (other / "config.yaml").write_text("seed: 1\nnote: x\n")
    pages = [run.parent / "a.html", run.parent / "b.html"]
    assert cli.main(["report", str(run), f"out={pages[0]}"]) == 0
    assert cli.main(["compare", str(run), str(other), f"out={pages[1]}"]) == 0
    for page in pages:
        text = page.read_text()
        assert SECRET not in text and "${oc.env:SECRET}" in text


IN_RUN = ("config.yaml", "versions.json", "evaluation.json", "last_frame.png")
BELOW = (
    ".hydra/overrides.yaml",
    ".hydra/hydra.yaml",
    "evaluation/evaluation.json",
    "evaluation/timing.json",
    "evaluation/imagined.mp4",
    "csv/scalars/loss.csv",
    "checkpoints/latest/counters.json",
)


@pytest.mark.parametrize(
    ("name", "whole_folder"), [*((n, False) for n in IN_RUN + BELOW), *((n, True) for n in BELOW)]
)
def test_links_that_leave_the_folder_are_refused(name: str, whole_folder: bool, run: Path, capsys) -> None:
    secret = run.parent / "secret" / Path(name).name
    secret.parent.mkdir()
    secret.write_text(SECRET)
    if name.startswith("checkpoints"):
        place = secret.parent if whole_folder else run / "checkpoints" / "latest"
        place.mkdir(parents=True, exist_ok=True)
        (place / "manifest.json").write_text("{}")
    link = run / name
    if whole_folder:
        link.parent.parent.mkdir(parents=True, exist_ok=True)
        link.parent.symlink_to(secret.parent)
    else:
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(secret)
    refused(run, "is a link to", capsys)


@pytest.mark.parametrize("name", ["meta/info.json", "data/chunk-000/file-000.parquet", "videos"])
def test_links_out_of_a_dataset_are_refused(name: str, tmp_path: Path) -> None:
    """But for those of the Hub's cache, which lead to its own files of the same repository."""
    kept = tmp_path / "datasets--a--b" / "blobs" / "1"
    for root, target, says in (
        (tmp_path / "set", kept, "is a link to"),
        (tmp_path / "datasets--a--b" / "snapshots" / "0", kept, "fps is missing"),
        (tmp_path / "datasets--a--b" / "snapshots" / "1", tmp_path / "secret", "is a link to"),
    ):
        for path in (root / "meta" / "info.json", root / name):
            path.parent.mkdir(parents=True, exist_ok=True)
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text('{"codebase_version": "v3.0", "features": {}}')
        (tmp_path / "secret").write_text(kept.read_text())
        (root / "meta" / "info.json").write_text(kept.read_text())
        (root / name).unlink(missing_ok=True)
        (root / name).symlink_to(target)
        with pytest.raises(UserError, match=says):
            read_source(root)


@pytest.mark.parametrize("linked", [False, True])
def test_pipes_in_a_dataset_are_refused(linked: bool, tmp_path: Path) -> None:
    """Also where a link of the Hub's cache leads to one."""
    root = tmp_path / "datasets--a--b" / "snapshots" / "0"
    pipe = root / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    pipe.parent.mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(INFO))
    if linked:
        pipe.symlink_to(tmp_path / "datasets--a--b" / "blob")
    os.mkfifo(pipe.resolve())
    held = os.open(pipe, os.O_RDWR)  # opening it would wait for ever otherwise
    with pytest.raises(UserError, match=r"file-000\.parquet is no file; remove it"):
        read_source(root)
    os.close(held)


def test_links_within_the_folder_are_followed(run: Path) -> None:
    (run / "config.yaml").rename(run / "first.yaml")
    (run / "config.yaml").symlink_to("first.yaml")
    linked = run.parent / "linked"
    linked.symlink_to(run)
    assert UntrustedFolder(linked).yaml("config.yaml")["seed"] == 0
    assert UntrustedFolder(run).yaml("nowhere.yaml") is None


def test_an_anchor_bomb_costs_nothing(run: Path, capsys) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 12)]
    (run / "config.yaml").write_text("\n".join(lines))
    started = time.monotonic()
    refused(run, "alias", capsys)
    assert time.monotonic() - started < 5


@pytest.mark.parametrize("text", ["!!python/object/apply:os.system ['true']", "a: [", "[1, 2]", "[" * 20_000])
def test_what_is_no_configuration_is_one_line(text: str, run: Path, capsys) -> None:
    (run / "config.yaml").write_text(text)
    refused(run, "config.yaml", capsys)


@pytest.mark.parametrize(
    ("name", "size", "says"),
    [("config.yaml", MOST_YAML, "larger than 1 MiB"), ("evaluation.json", MOST_JSON, "larger than 32 MiB")],
)
def test_sizes_are_bounded_before_anything_is_read(
    name: str, size: int, says: str, run: Path, capsys
) -> None:
    with (run / name).open("wb") as file:
        file.truncate(size + 1)
    refused(run, says, capsys)


def test_nested_json_and_what_is_no_file_are_one_line(run: Path, capsys) -> None:
    (run / "evaluation.json").write_text('{"a":' + "[" * 100_000)
    refused(run, "evaluation.json cannot be read", capsys)
    (run / "evaluation.json").unlink()
    os.mkfifo(run / "evaluation.json")  # opening it would wait for ever
    refused(run, "is no file", capsys)


def png(width: int, height: int) -> bytes:
    """The header of an image of any size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b""))
        + chunk(b"IEND", b"")
    )


def test_huge_and_false_images_are_refused(run: Path, capsys) -> None:
    image = run / "last_frame.png"
    image.write_bytes(png(60_000, 60_000))
    refused(run, "last_frame.png", capsys)
    image.write_bytes(png(9_000, 9_000))  # below Pillow's own limit
    refused(run, "has 9000 × 9000 pixels", capsys)
    image.write_text(SECRET)
    refused(run, "no image", capsys)
    image.write_bytes(png(100, 100))
    check_image(image)
    (run / "video.mp4").write_text(SECRET)
    refused(run, "no video", capsys)
    with pytest.raises(UserError, match="no video"):
        check_video(run / "video.mp4")


@pytest.mark.parametrize(
    "evaluation",
    [
        {"policies": {"planner": {"final_distance": {"mean": "x", "low": [], "high": {}}}}},
        {"policies": {"planner": {"episodes": "many"}}},
        {"policies": {"planner": {}}, "open_loop": {"curves": {"model": 3}}},
        {"policies": {"planner": {}}, "latents": {"points": [1], "quantity": "x"}},
        {"policies": {"planner": {}}, "spectrum": {"singular_values": ["a"]}},
        {"policies": {"planner": {}}, "health": [1]},
    ],
)
def test_values_of_another_form_are_one_line(evaluation, run: Path, capsys) -> None:
    (run / "evaluation.json").write_text(json.dumps({"protocol": {}} | evaluation))
    assert cli.main(["report", str(run)]) == 1
    said = capsys.readouterr().err
    assert str(run) in said and said.count("\n") == 1 and not (run / "report.html").exists()


def test_what_is_not_finite_is_missing(run: Path) -> None:
    (run / "a.json").write_text('{"x": NaN, "y": -Infinity, "z": 1e999, "w": 1.5}')
    assert UntrustedFolder(run).json("a.json") == {"x": None, "y": None, "z": None, "w": 1.5}


def test_a_full_gpu_is_no_fault_of_the_file() -> None:
    with pytest.raises(torch.OutOfMemoryError), values_of("checkpoint a", "use another."):
        raise torch.OutOfMemoryError("CUDA out of memory")
    with (
        pytest.raises(UserError, match="checkpoint a holds values"),
        values_of("checkpoint a", "use another."),
    ):
        raise RuntimeError("shapes")
