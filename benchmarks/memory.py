"""Does anything leak? Memory of the process over many steps, resets included.

    python benchmarks/memory.py                       100,000 steps of 64 worlds
    python benchmarks/memory.py --steps 10000 --pixels

A leak shows as a slope over the later rows: the first tenth is warm-up.
"""

from __future__ import annotations

import argparse
import gc
import time
from pathlib import Path

import torch
from common import publish

from franka_wm.envs import FrankaConfig, FrankaEnv


def resident() -> float:
    """Memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--pixels", action="store_true", help="with 64×64 images")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", help="JSON file")
    args = parser.parse_args()
    observations = ("pixels", "state") if args.pixels else ("state",)
    config = FrankaConfig(
        observations=observations, substeps=4, gravity_compensation=True, goal_sampling="reachable"
    )
    env = FrankaEnv(config, num_envs=args.worlds, device=args.device)
    tensordict = env.reset()
    rows, started = [], time.perf_counter()
    for part in range(10):
        for _ in range(args.steps // 10):
            action = torch.rand(args.worlds, 7, device=env.device) * 2 - 1
            _, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            tensordict.pop("next", None)
        gc.collect()
        row = {"steps": (part + 1) * (args.steps // 10), "resident [MB]": round(resident(), 1)}
        if env.device.type == "cuda":
            free, total = torch.cuda.mem_get_info()
            row["device [MB]"] = round((total - free) / 1e6, 1)
        row["seconds"] = round(time.perf_counter() - started)
        rows.append(row)
        print(row, flush=True)
    publish("memory", rows, args.out)


if __name__ == "__main__":
    main()
