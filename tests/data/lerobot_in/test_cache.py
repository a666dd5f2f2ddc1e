"""The cache: built once, whole or not at all, never out of date; and datasets that cannot be used."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import filelock
import numpy as np
import pytest
import torch

from franka_wm.data.lerobot import build_cache, cache, decode, decode_workers, source
from franka_wm.errors import UserError
from franka_wm.untrusted import MOST_JSON


def folders(cache_dir: Path) -> list[str]:
    return sorted(p.name for p in cache_dir.iterdir() if p.is_dir())


def test_reused(pictures: Path, opened: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The second time no picture is decoded and no table read."""
    first = opened(pictures).windows(torch.arange(5))

    def refuse(*_: object) -> None:
        raise AssertionError("decoded again")

    monkeypatch.setattr(decode.TableJob, "run", refuse)
    monkeypatch.setattr("PIL.Image.open", refuse)
    assert (opened(pictures).windows(torch.arange(5)) == first).all()
    assert len(folders(tmp_path / "cache")) == 1
    with pytest.raises(AssertionError, match="decoded again"):
        opened(pictures, image_size=16)


def test_built_again_when_the_dataset_changes(
    pictures: Path, foreign, opened: Callable, tmp_path: Path
) -> None:
    root = tmp_path / "data"
    shutil.copytree(pictures, root)
    assert len(opened(root)) == 10
    before = folders(tmp_path / "cache")
    shutil.rmtree(root)
    foreign.make_foreign(root, lengths=(4, 4))
    assert len(opened(root)) == 4
    after = folders(tmp_path / "cache")
    assert len(after) == 1 and after != before  # the old one can never be asked for again


def test_one_for_each_size(pictures: Path, opened: Callable, tmp_path: Path) -> None:
    opened(pictures)
    opened(pictures, image_size=16)
    opened(pictures, keys=["joints"])
    assert len(folders(tmp_path / "cache")) == 3


@pytest.mark.parametrize("kind", ["pictures", "video"])
def test_processes_give_the_same(
    kind: str,
    request: pytest.FixtureRequest,
    opened: Callable,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    root = request.getfixturevalue(kind)
    alone = opened(root).windows(torch.arange(10))
    monkeypatch.setattr(decode_workers, "ROWS_WORTH_A_PROCESS", 0)
    monkeypatch.setattr(build_cache, "ROWS_PER_JOB", 5)
    lines: list[str] = []
    monkeypatch.setattr(decode_workers, "PROGRESS_EVERY", 0.0)
    together = opened(root, workers=2, cache_dir=tmp_path / "other", say=lines.append)
    assert (together.windows(torch.arange(10)) == alone).all()
    assert any("rows/s" in line and "s left" in line for line in lines)


def test_an_error_in_a_worker_is_one_line(
    pictures: Path, opened: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(decode_workers, "ROWS_WORTH_A_PROCESS", 0)
    monkeypatch.setattr(build_cache, "ROWS_PER_JOB", 5)
    root = damaged_picture(pictures, tmp_path / "data")
    with pytest.raises(UserError, match=r"file-000\.parquet: an image of observation\.images\.\w+ cannot be"):
        opened(root, workers=2)
    assert folders(tmp_path / "cache") == []


def test_a_worker_that_dies(
    pictures: Path, opened: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(decode_workers, "ROWS_WORTH_A_PROCESS", 0)
    monkeypatch.setattr(build_cache, "ROWS_PER_JOB", 5)
    start = decode_workers._start_worker
    died = []

    def start_and_kill() -> subprocess.Popen[str]:
        process = start()
        if not died:
            process.kill()
            died.append(process)
        return process

    monkeypatch.setattr(decode_workers, "_start_worker", start_and_kill)
    with pytest.raises(UserError, match=r"ended \(exit status -9\); if it is out of memory"):
        opened(pictures, workers=2)
    assert folders(tmp_path / "cache") == []


KILLED = """
import sys, time
from franka_wm.data.lerobot import build_cache, cache, decode_workers
from franka_wm.data.lerobot.opening import open_dataset
decode_workers.ROWS_WORTH_A_PROCESS, build_cache.ROWS_PER_JOB = 0, 5
start = decode_workers._start_worker
def told():
    process = start()
    print("worker", process.pid, flush=True)
    return process
def wait(*_):
    print("now", flush=True)
    time.sleep(60)
decode_workers._start_worker = told
setattr(decode_workers if sys.argv[3] == "_drive" else build_cache, sys.argv[3], wait)
open_dataset(sys.argv[1], window=2, batch_size=2, workers=2, cache_dir=sys.argv[2])
"""


@pytest.mark.parametrize("moment", ["_drive", "_terminals"])
def test_killed_while_building(moment: str, pictures: Path, opened: Callable, tmp_path: Path) -> None:
    """Nothing that looks like a cache is left, no process either, and the next to come starts clean."""
    script = [sys.executable, "-c", textwrap.dedent(KILLED), str(pictures), str(tmp_path / "cache"), moment]
    process = subprocess.Popen(script, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    workers = []
    for line in process.stdout:
        if line.startswith("worker"):
            workers.append(int(line.split()[1]))
        if line.startswith("now"):
            break
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert len(workers) == 2
    assert all(".writing-" in name for name in folders(tmp_path / "cache"))
    until = time.monotonic() + 10
    while any(running(pid) for pid in workers) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(running(pid) for pid in workers)
    assert len(opened(pictures)) == 10
    (left,) = folders(tmp_path / "cache")
    assert ".writing-" not in left


def test_what_a_kill_has_left_is_removed(pictures: Path, opened: Callable, tmp_path: Path) -> None:
    """Also of a dataset whose name has signs that stand for others in a pattern."""
    root = tmp_path / "data[1]*"
    shutil.copytree(pictures, root)
    opened(root)
    (whole,) = (tmp_path / "cache").glob("*/")
    left = whole.rename(whole.with_name(f"{whole.name}.writing-0123"))
    opened(root)
    assert whole.is_dir() and not left.exists()


def running(pid: int) -> bool:
    """Whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_two_at_once(
    pictures: Path, opened: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """One builds, the other waits and says so."""
    builds, lines, counts = [], [], []
    build = cache.build_cache

    def slowly(*args: object) -> None:
        builds.append(1)
        time.sleep(1.0)
        build(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(cache, "build_cache", slowly)
    threads = [
        threading.Thread(target=lambda: counts.append(len(opened(pictures, say=lines.append))))
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counts == [10, 10] and len(builds) == 1
    assert any("another process" in line for line in lines)


def test_a_damaged_cache_is_built_again(pictures: Path, opened: Callable, tmp_path: Path) -> None:
    first = opened(pictures, in_memory=True).windows(torch.arange(10))
    (name,) = folders(tmp_path / "cache")
    with (tmp_path / "cache" / name / "observation.pixels.npy").open("r+b") as file:
        file.truncate(1000)
    lines: list[str] = []
    assert (opened(pictures, say=lines.append).windows(torch.arange(10)) == first).all()
    assert any("is damaged" in line for line in lines)


def test_nothing_is_unpickled(pictures: Path, opened: Callable, tmp_path: Path) -> None:
    opened(pictures)
    (name,) = folders(tmp_path / "cache")
    path = tmp_path / "cache" / name / "episodes.npy"
    np.save(path, np.array([print], dtype=object), allow_pickle=True)
    lines: list[str] = []
    opened(pictures, say=lines.append)
    assert any("is damaged" in line and "Python objects" in line for line in lines)


def endless(folder: Path) -> None:
    """Of 10¹² episodes, by its header alone."""
    with (folder / "episodes.npy").open("wb") as file:
        header = {"descr": "<i8", "fortran_order": False, "shape": (10**12, 3)}
        np.lib.format.write_array_header_1_0(file, header)


def padded(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b" " * MOST_JSON)


@pytest.mark.parametrize(
    "change",
    [
        endless,
        lambda folder: padded(folder / "cache.json"),
        lambda folder: (folder / "cache.json").write_text('{"arrays": []}'),
        lambda folder: (folder / "episodes.npy").write_bytes(b""),
    ],
    ids=["many episodes", "large", "no names", "empty"],
)
def test_a_strangers_cache_is_built_again(change, pictures: Path, opened: Callable, tmp_path: Path) -> None:
    opened(pictures)
    (name,) = folders(tmp_path / "cache")
    change(tmp_path / "cache" / name)
    lines: list[str] = []
    opened(pictures, say=lines.append)
    assert sum("is damaged" in line for line in lines) == 1


def test_a_damaged_cache_that_another_process_mends_meanwhile_is_taken(
    pictures: Path, opened: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Only who holds the lock removes one."""
    opened(pictures)
    (name,) = folders(tmp_path / "cache")
    good = (tmp_path / "cache" / name / "episodes.npy").read_bytes()
    (tmp_path / "cache" / name / "episodes.npy").write_bytes(b"")

    class Mends(filelock.FileLock):
        def acquire(self, *args, **kwargs):
            (tmp_path / "cache" / name / "episodes.npy").write_bytes(good)
            return super().acquire(*args, **kwargs)

    monkeypatch.setattr(filelock, "FileLock", Mends)
    monkeypatch.setattr(cache, "build_cache", lambda *_: pytest.fail("decoded again"))
    opened(pictures)


def test_a_cache_has_reached_the_disk_before_it_has_its_name(
    pictures: Path, opened: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(cache, "sync", lambda path: synced.append(path))
    opened(pictures)
    (name,) = folders(tmp_path / "cache")
    assert all(path.parts[-2].startswith(f"{name}.writing-") for path in synced[:-1])
    assert {path.name for path in synced[:-1]} == {
        path.name for path in (tmp_path / "cache" / name).iterdir()
    }
    assert synced[-1].name.startswith(f"{name}.writing-")


def test_what_a_fingerprint_reads_is_bounded(pictures: Path, tmp_path: Path) -> None:
    root = tmp_path / "copy"
    shutil.copytree(pictures, root)
    opening = source.read_source(root)
    padded(root / "meta" / "info.json")
    with pytest.raises(UserError, match="larger than 32 MiB"):
        opening.fingerprint()


def test_no_room(pictures: Path, opened: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cache.shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(UserError, match=r"needs 0\.0 GB.*dataset\.cache_dir"):
        opened(pictures)
    assert folders(tmp_path / "cache") == []


def test_the_cache_folder_cannot_be_made(pictures: Path, opened: Callable, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot write the cache.*dataset\.cache_dir"):
        opened(pictures, cache_dir=tmp_path / "file" / "cache")


def test_changed_while_read(
    pictures: Path, opened: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    root = tmp_path / "data"
    shutil.copytree(pictures, root)
    run = build_cache.run_jobs

    def touched(*args: object) -> None:
        run(*args)  # type: ignore[arg-type]
        os.utime(root / "meta" / "info.json")

    monkeypatch.setattr(build_cache, "run_jobs", touched)
    with pytest.raises(UserError, match="was changed while it was read"):
        opened(root)
    assert folders(tmp_path / "cache") == []


# Datasets that cannot be used


POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 16 16\n%%EndComments\nshowpage\n%%EOF\n"


def damaged_picture(root: Path, to: Path, cell: bytes = b"no picture") -> Path:
    """One PNG of the first column replaced."""
    import pyarrow.parquet as pq

    shutil.copytree(root, to)
    path = next((to / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    at = table.column_names.index("observation.images.top")
    cells = table.column(at).to_pylist()
    cells[7]["bytes"] = cell
    table = table.set_column(at, table.field(at), [cells])
    pq.write_table(table, path)
    return to


def test_damaged_rows(pictures: Path, opened: Callable, tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    with pytest.raises(UserError, match=r"an image of .* cannot be decoded"):
        opened(damaged_picture(pictures, tmp_path / "picture"))
    with pytest.raises(UserError, match="cannot be decoded: cannot identify"):  # Ghostscript is not asked
        opened(damaged_picture(pictures, tmp_path / "program", POSTSCRIPT))

    def rewritten(name: str, change: Callable[[pa.Table], pa.Table]) -> Path:
        shutil.copytree(pictures, tmp_path / name)
        path = next((tmp_path / name / "data").rglob("*.parquet"))
        pq.write_table(change(pq.read_table(path)), path)
        return tmp_path / name

    def with_column(table: pa.Table, name: str, values: list) -> pa.Table:
        at = table.column_names.index(name)
        return table.set_column(at, table.field(at), pa.array(values, table.schema.field(at).type))

    with pytest.raises(
        UserError, match=r"2 rows are missing or doubled \(table\), the first in episode 0, frame 3"
    ):
        opened(rewritten("fewer", lambda t: pa.concat_tables([t.slice(0, 3), t.slice(5)])))
    with pytest.raises(UserError, match=r"1 rows are missing or doubled"):
        opened(rewritten("doubled", lambda t: pa.concat_tables([t, t.slice(2, 1)])))
    with pytest.raises(UserError, match="episode 9, frame 0 that meta/episodes does not know"):
        opened(rewritten("unknown", lambda t: with_column(t, "episode_index", [0] * 5 + [9] * 11)))
    nan = [[0.0, 0.0]] * 7 + [[0.0, float("nan")]] + [[0.0, 0.0]] * 8
    with pytest.raises(UserError, match=r"observation\.joints .* not finite, in episode 1; delete"):
        opened(rewritten("nan", lambda t: with_column(t, "observation.joints", nan)))

    def uneven(table: pa.Table) -> pa.Table:
        """As many numbers as there should be, in other rows: all that follow would be shifted."""
        kind = pa.list_(pa.float32())
        rows = pa.array([[0.0], [1.0, 2.0, 3.0]] + [[0.0, 0.0]] * 14, kind)
        at = table.column_names.index("observation.joints")
        changed = table.set_column(at, pa.field("observation.joints", kind), rows)
        return changed.replace_schema_metadata(None)

    with pytest.raises(
        UserError, match=r"observation\.joints should have 2 numbers in every row and has not"
    ):
        opened(rewritten("uneven", uneven))
