"""Two processes collect: one dataset, of the episodes that one process would record, or none."""

from __future__ import annotations

import os
import signal
import socket
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from forks import module, spare, torchrun, torchrun_in_fork
from franka_wm.commands import launching
from franka_wm.commands.main import main
from franka_wm.data.lerobot.schema import EPISODE_KEY, SEED

SMALL = ["env=reach", "env.substeps=1", "env.episode_length=6", "device=cpu", "num_envs=5", "seed=3"]


def episodes(root: Path) -> dict[tuple[int, ...], int]:
    """(seed, world, number) -> the fingerprint of all that was recorded."""
    import pandas as pd

    rows = pd.concat([pd.read_parquet(file) for file in sorted((root / "data").rglob("*.parquet"))])
    assert rows["index"].is_monotonic_increasing and len(rows) % 6 == 0
    first = rows.groupby("episode_index").first()
    return {
        tuple(seed): int(key) for seed, key in zip(first[SEED], np.hstack(first[EPISODE_KEY]), strict=True)
    }


@pytest.mark.slow
def test_the_dataset_is_that_of_one_process(tmp_path) -> None:
    """Of two, as of two hosts by torchrun; 5 worlds are 3 and 2, 8 episodes two of the first three worlds."""
    with socket.socket() as one:
        one.bind(("localhost", 0))
        port = one.getsockname()[1]
    nodes = ("--nnodes=2", "--nproc-per-node=1", "--local-addr=localhost")
    nodes = (*nodes, "--rdzv-backend=c10d", f"--rdzv-endpoint=localhost:{port}", "--rdzv-id=9")
    words = ("collect", f"out={tmp_path}/hosts", *SMALL, "episodes=8", "workers=0")
    work = torchrun(*nodes, "-m", "franka_wm", *words, hosts=2)
    spare().begin(work, tmp_path, tmp_path / "log")
    assert main(["collect", f"out={tmp_path}/one", "episodes=8", "workers=0", *SMALL]) == 0
    done = spare().end()
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert said.count("episodes 8/8") == said.count("dataset: ") == 1  # one speaks, of all
    alone, together = episodes(tmp_path / "one"), episodes(tmp_path / "hosts")
    assert sorted(seed[1:] for seed in alone) == [
        (0, 0),
        (0, 1),
        (1, 0),
        (1, 1),
        (2, 0),
        (2, 1),
        (3, 0),
        (4, 0),
    ]
    assert alone == together
    assert sorted(one.name for one in tmp_path.iterdir() if one.is_dir()) == ["hosts", "one"]


@pytest.mark.slow
def test_a_killed_process_ends_the_others_and_leaves_no_dataset(tmp_path) -> None:
    out = tmp_path / "set"
    words = ("collect", f"out={out}", *SMALL, "episodes=100000", "gpus=2", "shard_frames=30", "workers=0")
    spare().begin(torchrun_in_fork(module("franka_wm", *words)), tmp_path, tmp_path / "log")
    shards = out.with_name("set.writing") / "shards"
    until = time.monotonic() + 120
    while len(list(shards.glob("shard-?????"))) < 2 and time.monotonic() < until:
        time.sleep(0.1)
    second = int((tmp_path / "rank1.pid").read_text())
    os.kill(second, signal.SIGKILL)
    killed = time.monotonic()
    done = spare().end()
    said = done.stdout + done.stderr
    assert done.returncode == 1 and time.monotonic() < killed + 60, said
    assert f"process 1 of the run (pid {second}) was ended by SIGKILL" in said, said
    assert "collect goes on with resume=true" in done.stderr.splitlines()[-1] and "Traceback" not in said
    assert not out.exists()
    kept = len(list(shards.glob("shard-?????"))) * 5  # episodes of 6 steps
    assert main(["collect", f"out={out}", f"episodes={kept + 3}", "resume=true", "workers=0", *SMALL]) == 0
    assert len(episodes(out)) == kept + 3 and not shards.parent.exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["device=cuda"], "gpus=8: this machine has 0 usable CUDA devices"),
        (["device=cuda:1"], "device=cuda:1 with gpus=8: each process has a GPU of its own"),
        (["gpus=1000", "num_envs=1000"], "gpus=1000 with device=cpu: at most 16 processes on the 2 cores"),
        (["num_envs=5"], "5 worlds for 8 processes: give num_envs=8, or start fewer"),
        (["episodes=7"], "7 worlds for 8 processes: give num_envs=8, or start fewer"),
        (["env.image_siz=8"], "env.image_siz: no such option"),
        (["policy=expert", "gpus=0"], "gpus=0: must be a whole number of at least 1"),
    ],
)
def test_what_cannot_be_started_is_one_line(tmp_path, capsys, monkeypatch, words, says) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(launching, "usable_cores", lambda: 2)
    default = [word for word in ("device=cpu", "gpus=8") if word.split("=")[0] not in " ".join(words)]
    assert main(["collect", f"out={tmp_path}/set", *words, *default]) == 1
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1, said
    assert not list(tmp_path.iterdir())
