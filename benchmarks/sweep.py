"""How many runs an hour does a sweep finish: one after the other on a GPU, several at once there, and on every GPU?

    python benchmarks/sweep.py                               of env=reach
    python benchmarks/sweep.py env=lift --at-once 6          six at once on a GPU, and six on each
    python benchmarks/sweep.py --device cpu --scale smoke --at-once 2

Arguments beside the options are those of train.py. Times are of the whole command, starts and evaluations included.
One after the other they share a process, which imports once; several at once have one each (the extra joblib). *MPS*:
through NVIDIA's service by which processes compute at once on a GPU, started here; without it they take turns. It is
left out where there is none. Two short runs before fill the caches.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from common import compose, publish

ROOT = Path(__file__).resolve().parents[1]
SERVICE = "nvidia-cuda-mps-control"
QUIET = [
    "evaluation.during=[]",
    "evaluation.video_episodes=0",
    "logger=none",
    "trainer.checkpoint_replay=false",
]


@contextmanager
def service(wanted: bool) -> Iterator[dict[str, str]]:
    """What processes need in their environment to share GPUs by MPS, in a place of its own; nothing if not wanted."""
    if not wanted:
        yield {}
        return
    with tempfile.TemporaryDirectory() as folder:
        places = {"CUDA_MPS_PIPE_DIRECTORY": folder, "CUDA_MPS_LOG_DIRECTORY": folder}
        subprocess.run([SERVICE, "-d"], env=os.environ | places, check=True)
        try:
            yield places
        finally:
            subprocess.run([SERVICE], input="quit\n", text=True, env=os.environ | places, check=True)


def sweep(arguments: Sequence[str], runs: int, at_once: int, environment: dict[str, str]) -> float:
    """Seconds in which a sweep over so many seeds is done, so many at once."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(ROOT / "train.py"), "--multirun", *arguments, *QUIET]
        command += [f"seed=range(0,{runs})", f"hydra.sweep.dir={folder}"]
        if at_once > 1:
            command += ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={at_once}"]
        started = time.perf_counter()
        done = subprocess.run(command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True)
        took = time.perf_counter() - started
        finished = len(list(Path(folder).glob("*/finished.json")))
    if done.returncode or finished < runs:
        raise SystemExit(f"{' '.join(command)}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")
    return took


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("arguments", nargs="*", default=["env=reach"], metavar="GROUP.KEY=VALUE")
    parser.add_argument("--at-once", type=int, default=3, help="on each GPU")
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--scale", default="gpu")
    parser.add_argument("--out", help="JSON file")
    args = parser.parse_args()
    on_gpu, each = args.device == "cuda", args.at_once
    if on_gpu and not torch.cuda.device_count():
        parser.error("--device cuda: there is no GPU here; use --device cpu")
    arguments = [*args.arguments, f"scale={args.scale}", f"device={'spread' if on_gpu else 'cpu'}"]
    gpus = torch.cuda.device_count() if on_gpu else 1
    mps = on_gpu and shutil.which(SERVICE) is not None
    if on_gpu and not mps:
        print(f"no {SERVICE} here: processes on a GPU take turns")
    visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(gpus)))
    alone = {"CUDA_VISIBLE_DEVICES": visible.split(",")[0]} if on_gpu else {}
    print("filling caches by two short runs …", flush=True)
    short = min(100, compose(*arguments).trainer.updates)
    sweep([*arguments, f"trainer.updates={short}", "replay.demo_updates=0"], 2, 2, alone)
    # GPUs, runs, at once, MPS
    plan = [(1, each, 1, False), (1, each, each, False)]
    plan += [(1, each, each, True)] if mps else []
    plan += [(gpus, each * gpus, each * gpus, mps)] if gpus > 1 else []
    rows: list[dict[str, Any]] = []
    for number, runs, at_once, shared in plan:
        print(f"{runs} runs, {at_once} at once on {number if on_gpu else 'no'} GPU …", flush=True)
        with service(shared) as places:
            took = sweep(arguments, runs, at_once, places | (alone if number == 1 else {}))
        hour = 3600 * runs / took
        first = rows[0]["runs/hour"] if rows else hour
        rows.append(
            {
                "GPUs": number,
                "runs": runs,
                "at once": at_once,
                "MPS": shared,
                "seconds": took,
                "runs/hour": hour,
                "times one after the other": hour / first,
            }
        )
        print(rows[-1], flush=True)
    publish("runs of a sweep", rows, args.out, device=args.device, ran=("franka_wm/", "train.py"))


if __name__ == "__main__":
    main()
