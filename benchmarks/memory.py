"""Does anything leak or break? Memory, descriptors, threads and broken worlds over many steps, resets included.

    python benchmarks/memory.py                       100,000 steps of 64 worlds
    python benchmarks/memory.py --steps 10000 --pixels
    python benchmarks/memory.py --env lift --minutes 20
    python benchmarks/memory.py --minutes 25 --train env=lift scale=gpu     a whole training run, watched from outside

A leak shows as a slope over the later rows: the first tenth is warm-up.
"""

from __future__ import annotations

import argparse
import gc
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from common import compose, publish

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from franka_wm.training.history import read_rows
from franka_wm.training.settings import RunSettings

ROOT = Path(__file__).resolve().parents[1]


def process(number: int | str = "self") -> dict[str, float]:
    """What a process holds."""
    place = Path("/proc", str(number))
    return {
        "resident [MB]": round(int((place / "statm").read_text().split()[1]) * 4096 / 1e6, 1),
        "descriptors": len(os.listdir(place / "fd")),
        "threads": len(os.listdir(place / "task")),
    }


def watch(arguments: list[str], minutes: float, device: str) -> list[dict[str, Any]]:
    """A training run with these arguments of train.py, for so long; Ctrl-C ends it, and it saves."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            str(ROOT / "train.py"),
            *arguments,
            f"device={device}",
            "trainer.updates=100000000",
        ]
        command += [
            f"hydra.run.dir={folder}/run",
            "evaluation.episodes=64",
            "trainer.checkpoint_replay=false",
        ]
        with open(f"{folder}/said", "w") as said:
            run = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT, cwd=ROOT)
        seen, started = [], time.time()
        for part in range(1, 11):
            while time.time() - started < 6 * part * minutes:
                time.sleep(1.0)
                if run.poll() is not None:
                    raise SystemExit(Path(folder, "said").read_text()[-4000:])
            seen.append({"minutes": round(minutes * part / 10, 1), **process(run.pid)})
            print(seen[-1], flush=True)
        run.send_signal(signal.SIGINT)
        run.wait(timeout=120)
        logged = read_rows(load_checkpoint(latest_checkpoint(f"{folder}/run")))
    beside(seen, logged, minutes)
    return seen


def beside(seen: list[dict[str, Any]], logged: Sequence[Mapping[str, float]], minutes: float) -> None:
    """Adds to each row what the run had logged by then; the last was logged as the run ended, after so many minutes."""
    logged = [row for row in logged if "loss" in row]
    for row in seen:
        # What it took to begin is not in the run's time.
        ago = 60 * (minutes - row["minutes"])
        there = [one for one in logged if one["time_s"] <= logged[-1]["time_s"] - ago]
        last = there[-1] if there else {"updates": 0, "env_steps": 0}
        row |= {"updates": int(last["updates"]), "env steps": int(last["env_steps"])}
        row |= {"device [MB]": round(last["device_memory_mb"], 1)} if "device_memory_mb" in last else {}
        row["broken worlds"] = round(sum(one.get("train/nonfinite", 0.0) for one in there))
        row["finite"] = all(
            value == value and abs(value) < float("inf") for one in there for value in one.values()
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--minutes", type=float, help="in place of --steps")
    parser.add_argument("--env", help="one of conf/env; a plain reach if not given")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--pixels", action="store_true", help="with 64×64 images")
    parser.add_argument(
        "--train", nargs="+", metavar="ARG", help="watch train.py with these arguments instead"
    )
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", help="JSON file")
    args = parser.parse_args()
    if args.train:
        compose(*args.train)
        rows = watch(args.train, args.minutes or 25.0, args.device)
        return publish("memory", rows, args.out, device=args.device, ran=("franka_wm/", "train.py"))
    observations = ("pixels", "state") if args.pixels else ("state",)
    config = (
        RunSettings.of(compose(f"env={args.env}")).env.arm
        if args.env
        else FrankaConfig(
            observations=observations, substeps=4, gravity_compensation=True, goal_sampling="reachable"
        )
    )
    env = FrankaEnv(config, num_envs=args.worlds, device=args.device)
    tensordict = env.reset()
    rows, started, steps, broken = [], time.perf_counter(), 0, 0.0
    for part in range(10):
        while (
            steps < (part + 1) * args.steps // 10
            if args.minutes is None
            else time.perf_counter() - started < 6 * (part + 1) * args.minutes
        ):
            action = torch.rand(args.worlds, env.action_dim, device=env.device) * 2 - 1
            _, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            tensordict.pop("next", None)
            steps += 1
        seen = env.statistics()
        broken += seen["nonfinite"]
        gc.collect()
        row = {
            "steps": steps,
            **process(),
            "episodes": round(seen["episodes"]),
            "broken worlds": round(broken),
            "finite": bool(torch.isfinite(tensordict["state"]).all()),
        }
        if env.device.type == "cuda":
            free, total = torch.cuda.mem_get_info()
            row["device [MB]"] = round((total - free) / 1e6, 1)
        row["seconds"] = round(time.perf_counter() - started)
        rows.append(row)
        print(row, flush=True)
    publish("memory", rows, args.out, device=args.device)


if __name__ == "__main__":
    main()
