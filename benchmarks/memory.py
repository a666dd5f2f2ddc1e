"""Does anything leak or break? Memory, descriptors, threads and broken worlds over many steps, resets included.

    python benchmarks/memory.py                       100,000 steps of 64 worlds
    python benchmarks/memory.py --steps 10000 --pixels
    python benchmarks/memory.py --env lift --minutes 20

A leak shows as a slope over the later rows: the first tenth is warm-up.
"""

from __future__ import annotations

import argparse
import gc
import os
import time
from pathlib import Path

import torch
from common import publish

from franka_wm import conf
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.training.settings import RunSettings


def resident() -> float:
    """Memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--minutes", type=float, help="in place of --steps")
    parser.add_argument("--env", help="one of conf/env; a plain reach if not given")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--pixels", action="store_true", help="with 64×64 images")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", help="JSON file")
    args = parser.parse_args()
    observations = ("pixels", "state") if args.pixels else ("state",)
    config = (
        RunSettings.of(conf.compose(f"env={args.env}")).env.arm
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
            "resident [MB]": round(resident(), 1),
            "descriptors": len(os.listdir("/proc/self/fd")),
            "threads": len(os.listdir("/proc/self/task")),
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
    publish("memory", rows, args.out)


if __name__ == "__main__":
    main()
