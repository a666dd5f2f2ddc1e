"""How much sooner do several GPUs learn a task, where worlds and batches grow with them?

    python benchmarks/sooner.py experiment=demonstrations env=push replay.demos=datasets/push
    python benchmarks/sooner.py env=lift --share 0.9 --gpus 1 4 --learning-rate linear
    python benchmarks/sooner.py env=lift --share 0 --device cpu --scale smoke --every 10 --episodes 4

Arguments beside the options are those of train.py for one GPU. While each job trains, its planner plays held-out
episodes; *training [s]* is the time without these until the first evaluation in which the share of them that ends in
success reaches --share, *updates* those until then; there the job is stopped. The last evaluation is --every updates
before the end. A job that never reaches the share has its best one and no time. As many jobs run at once as the host
has GPUs for; they share its cores.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import torch
from common import compose, grown, publish

from franka_wm.interrupt import INTERRUPTED
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from franka_wm.training.history import read_rows

ROOT = Path(__file__).resolve().parents[1]
SUCCESS = "eval/planner/success"
STOPPED = (0, INTERRUPTED, -signal.SIGTERM, 128 + signal.SIGTERM)
"""Exit statuses of a job that was told to stop: it had just ended, or it saved, alone or started by `gpus=`."""
POWERS = {"same": 0.0, "root": 0.5, "linear": 1.0}
"""How the learning rate grows with the number of GPUs: Adam's usual rule is the root."""


def learned(
    arguments: Sequence[str], folder: Path, share: float, gpus: Sequence[str]
) -> list[dict[str, float]]:
    """The rows that a job has logged until an evaluation reached the share (0 to 1), or until its end.

    Args:
        gpus: as `CUDA_VISIBLE_DEVICES` names them; none on a CPU.
    """
    command = [sys.executable, str(ROOT / "train.py"), *arguments, "logger=files", f"hydra.run.dir={folder}"]
    visible = {"CUDA_VISIBLE_DEVICES": ",".join(gpus)} if gpus else {}
    output, stopped = folder.with_suffix(".log"), False
    with output.open("w") as file:
        job = subprocess.Popen(command, stdout=file, stderr=file, cwd=ROOT, env=os.environ | visible)
        while job.poll() is None:
            time.sleep(0.5)
            if not stopped and max(evaluated(folder), default=-1.0) >= share:
                job.terminate()  # it saves what it has logged
                stopped = True
    if job.returncode not in (STOPPED if stopped else (0,)):
        raise SystemExit(f"{' '.join(command)}\n{output.read_text()[-6000:]}")
    return read_rows(load_checkpoint(latest_checkpoint(folder)))


def evaluated(folder: Path) -> list[float]:
    """The shares of successes that a job in this folder has logged, whole lines of them."""
    table = folder / "csv" / "scalars" / f"{SUCCESS}.csv"
    whole = table.read_text().rpartition("\n")[0] if table.exists() else ""
    return [float(line.split(",")[1]) for line in whole.split()]


def first(rows: Sequence[dict[str, float]], share: float) -> dict[str, float]:
    """The row of the first evaluation with this share of successes; nan where there is none, and the best share."""
    evaluated = [row for row in rows if SUCCESS in row]
    if not evaluated:
        raise SystemExit(f"no evaluation gave {SUCCESS}: this needs a planner, and a task that knows success")
    best = max(row[SUCCESS] for row in evaluated)
    never = {"time_s": float("nan"), "updates": float("nan"), "env_steps": float("nan"), SUCCESS: best}
    return next((row for row in evaluated if row[SUCCESS] >= share), never)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("arguments", nargs="+", metavar="GROUP.KEY=VALUE", help="of train.py")
    parser.add_argument("--share", type=float, default=0.95)
    parser.add_argument("--gpus", nargs="+", type=int, help="1, 2, 4, … as many as there are, if not given")
    parser.add_argument("--learning-rate", default="root", choices=POWERS)
    parser.add_argument("--every", type=int, default=1000, help="updates between evaluations")
    parser.add_argument("--episodes", type=int, default=128, help="of each evaluation")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--scale", default="gpu")
    parser.add_argument("--out", help="JSON file")
    args = parser.parse_args()
    on_gpu = args.device == "cuda"
    there = torch.cuda.device_count() if on_gpu else 2  # ranks on a CPU, where none are asked for
    if not there:
        parser.error("--device cuda: there is no GPU here; use --device cpu")
    names = (os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(there)))).split(",")
    if on_gpu and max(args.gpus or [1]) > there:
        parser.error(f"--gpus {max(args.gpus)}: there are {there} here; give at most that")
    arguments = [*args.arguments, f"scale={args.scale}", f"device={args.device}"]
    alone = compose(*arguments)
    if args.every >= alone.trainer.updates:
        parser.error(f"--every {args.every}: must be less than trainer.updates={alone.trainer.updates}")
    rate = alone.trainer.lr or alone.model.lr
    rows: list[dict[str, Any]] = []

    def run(gpus: int, more: list[str], free: list[list[str]], at_once: int, seed: int) -> dict[str, Any]:
        job = [*arguments, *more, f"seed={seed}", "trainer.checkpoint_replay=false"]
        job += [f"trainer.lr={rate * gpus ** POWERS[args.learning_rate]}", "evaluation.during=[planner]"]
        job += [f"evaluation.every={args.every}", f"evaluation.episodes={args.episodes}"]
        job += ["evaluation.during_episodes=null", "evaluation.video_episodes=0"]
        place = free.pop(0)
        with tempfile.TemporaryDirectory() as folder:
            try:
                found = first(learned(job, Path(folder) / "run", args.share, place), args.share)
            finally:
                free.append(place)
        same = [row["training [s]"] for row in rows if row["seed"] == seed]
        row = {
            "GPUs": gpus,
            "seed": seed,
            "jobs at once": at_once,
            "batch": alone.replay.batch_size * gpus,
            "success [%]": 100 * found[SUCCESS],
            "training [s]": found["time_s"],
            "updates": found["updates"],
            "environment steps": found["env_steps"],
            "times sooner": (same or [found["time_s"]])[0] / found["time_s"],
        }
        print(row, flush=True)
        return row

    for gpus in sorted(args.gpus or [n for n in (1, 2, 4, 8) if n <= there]):
        free = [names[k : k + gpus] for k in range(0, there - gpus + 1, gpus)] if on_gpu else [[]]
        at_once = min(len(free), len(args.seeds))
        print(f"GPUs {gpus}, seeds {' '.join(map(str, args.seeds))}, {at_once} at once …", flush=True)
        more = grown(gpus, *arguments)  # here: Hydra composes in one thread alone
        with ThreadPoolExecutor(len(free)) as pool:
            rows += list(pool.map(partial(run, gpus, more, free, at_once), args.seeds))
    title = f"time until {100 * args.share:g} % of episodes end in success"
    publish(title, rows, args.out, device=args.device, ran=("franka_wm/", "train.py"))


if __name__ == "__main__":
    main()
