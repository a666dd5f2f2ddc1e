"""Whether code that has changed since a row was measured still does the same, to the last bit.

A row's command at its smallest runs on the CPU twice, with the code that the row was measured with and with today's;
each gathers anew 16 episodes of every dataset that the row reads. Equal weights and equal episodes are written to
docs/results/confirmed/ROW.json. They say that nothing was changed on purpose or by mistake that a run of a minute
shows; what only a GPU or a long run shows, they do not.
"""

from __future__ import annotations

import hashlib
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

from benchmarks.results.records import PLACE, code_key, read, read_json
from benchmarks.results.rows import Row
from benchmarks.results.running import prepare
from benchmarks.results.state import Record, changes, composed
from franka_wm.errors import UserError
from franka_wm.evaluation.results import to_json
from franka_wm.files import atomic_write
from franka_wm.source import ROOT

SIZES = (
    "scale",
    "size",
    "device",
    "trainer.updates",
    "trainer.compile",
    "replay.capacity",
    "replay.batch_size",
)
SMALLER = {"replay.demo_updates": 10, "collector.seed_updates": 10, "planner.num_policy_samples": 4}
"""What a row asks for beyond a smoke run's 30 updates and 16 candidates, and what a short run has instead."""
EPISODES = 16
"""Of each dataset that it gathers: enough for 30 updates."""
ONE_CORE = {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
SHORT = ("scale=smoke", "device=cpu", "seed=3", "logger=none", "evaluation.video_episodes=0")


def short(row: Row) -> list[str]:
    """The arguments of the row's command with a smoke run's sizes."""
    sized = (
        *SIZES,
        "collector.num_envs",
        "collector.seed_steps",
        "evaluation.episodes",
    )
    names = [word.split("=", 1)[0] for word in row.words]
    kept = [word for word, name in zip(row.words, names, strict=True) if name not in (*sized, *SMALLER)]
    return [*kept, *SHORT, *(f"{name}={value}" for name, value in SMALLER.items() if name in names)]


def confirm(row: Row, place: Path = PLACE) -> Path:
    """Runs both codes and writes that they do the same; returns the file.

    Raises:
        UserError: The row was not measured, its code is not in this repository, a run fails, or they differ.
    """
    records = read(row, place)
    # With "+" something was not committed, such as results of the row's first seeds: its code is compared below.
    commits = sorted({str(record["commit"]).removesuffix("+") for record in records})
    if row.script is not None or len(commits) != 1:
        raise UserError(
            f"{row.name}: only a row of train.py that one commit measured can be confirmed; measure it again"
        )
    now = composed(tuple(shlex.split(records[0]["command"])[2:]))
    found = [f"refused: {now}"] if isinstance(now, str) else changes(records[0]["code"]["config"], now)
    if other := [change for change in found if "– → " not in change and not change.endswith("→ –")]:
        raise UserError(f"{row.name}: its command now has {'; '.join(other)}; measure it again")
    with tempfile.TemporaryDirectory() as folder:
        before, now = Path(folder) / "before" / "run", Path(folder) / "now" / "run"
        tree = Path(folder) / "tree"
        _git("worktree", "add", "--detach", str(tree), commits[0])
        try:
            _prepare(row, tree, before.parent)
            _run(tree, short(row), before)
            _require_measured(row, records, commits[0], (read_json(before / "finished.json") or {})["source"])
        finally:
            _git("worktree", "remove", "--force", str(tree))
        _prepare(row, ROOT, now.parent)
        _run(ROOT, short(row), now)
        if apart := [name for name in ("weights", "episodes") if outcome(before)[name] != outcome(now)[name]]:
            raise UserError(
                f"{row.name}: {' and '.join(apart)} of a short run are not those of {commits[0]}; measure it again"
            )
        finished = read_json(now / "finished.json") or {}
    path = place / "confirmed" / f"{row.name}.json"
    with atomic_write(path) as temporary:
        temporary.write_text(
            to_json(
                {
                    "row": row.name,
                    "measured": commits[0],
                    "code": _codes(records),
                    "command": shlex.join(["python", "train.py", *short(row)]),
                    "date": date.today().isoformat(),
                    "files": finished["source"],
                    "config": composed(tuple(shlex.split(records[0]["command"])[2:])),
                }
            )
        )
    return path


def _require_measured(row: Row, records: Sequence[Record], commit: str, files: Mapping[str, str]) -> None:
    """Refuses records of other code than the commit's, as far as a short run reads it."""
    for record in records:
        measured = record["code"]["files"]
        other = next((name for name, code in files.items() if measured.get(name, code) != code), None)
        if other is not None:
            raise UserError(
                f"{row.name}: measured with another {other} than that of {commit}; measure it again"
            )


def outcome(run: Path) -> dict[str, Any]:
    """Digest of the last weights of every stage, by value, since names may change; each policy's episodes.

    Raises:
        UserError: The run left no weights or no evaluation.
    """
    from safetensors.torch import load_file

    tensors = [
        f"{tuple(tensor.shape)} {hashlib.sha256(tensor.contiguous().numpy().tobytes()).hexdigest()}"
        for file in sorted(run.glob("**/checkpoints/latest/*.safetensors"))
        if "model" in file.name
        for tensor in load_file(file).values()
    ]
    found = read_json(run / "evaluation.json")
    if not tensors or not found:
        raise UserError(f"{run}: no weights or no evaluation")
    return {"weights": sorted(tensors), "episodes": found["policies"]}


def confirmed(row: Row, records: Sequence[Record], place: Path = PLACE) -> Record | None:
    """The confirmation that holds for these records and the code as it is now, if there is one."""
    from franka_wm.source import differing

    found = read_json(place / "confirmed" / f"{row.name}.json")
    commits = {str(record["commit"]) for record in records}
    if not found or {commit.removesuffix("+") for commit in commits} != {found["measured"]}:
        return None
    # An earlier version did not name the code: a commit alone says which it is, one with "+" does not.
    if found["code"] != _codes(records) if "code" in found else any(one.endswith("+") for one in commits):
        return None
    now = composed(tuple(shlex.split(records[0]["command"])[2:]))
    return found if not differing(found["files"]) and found["config"] == now else None


def _codes(records: Sequence[Record]) -> list[str]:
    """What all records' code is, by the names of its files."""
    return sorted({code_key(record["code"]) for record in records})


def _git(*words: str) -> None:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UserError(f"git {' '.join(words)}: {done.stderr.strip().splitlines()[-1]}")


def _prepare(row: Row, top: Path, place: Path) -> None:
    place.mkdir()
    fewer = replace(row, before=re.sub(r"\bepisodes=\d+", f"episodes={EPISODES}", row.before))
    if failure := prepare(fewer, top, place, **ONE_CORE):
        raise UserError(failure)


def _run(top: Path, words: Sequence[str], folder: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(top)} | ONE_CORE
    command = [sys.executable, str(top / "train.py"), *words, f"hydra.run.dir={folder}"]
    done = subprocess.run(
        command, cwd=folder.parent, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip() or "nothing printed").splitlines()[-1]
        raise UserError(f"the short run of {top} failed: {last}; {shlex.join(command)}")
