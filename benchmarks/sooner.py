"""How much sooner do several GPUs learn a task, where worlds and batches grow with them?

    python benchmarks/sooner.py experiment=demonstrations env=push replay.demos=datasets/push
    python benchmarks/sooner.py env=lift --share 0.9 --gpus 1 4 --learning-rate linear
    python benchmarks/sooner.py env=lift --share 0 --device cpu --scale smoke --every 10 --episodes 4

Arguments beside the options are those of train.py for one GPU. While each job trains, its planner plays held-out
episodes; *training [s]* is the time without these until the first evaluation in which the share of them that ends in
success reaches --share, *updates* those until then. The last evaluation is --every updates before the end. A job that
never reaches the share has its best one and no time.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from common import compose, grown, publish

from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from franka_wm.training.history import read_rows

ROOT = Path(__file__).resolve().parents[1]
SUCCESS = "eval/planner/success"
POWERS = {"same": 0.0, "root": 0.5, "linear": 1.0}
"""How the learning rate grows with the number of GPUs: Adam's usual rule is the root."""


def learned(arguments: Sequence[str], folder: Path) -> list[dict[str, float]]:
    """The rows that a whole job has logged."""
    command = [sys.executable, str(ROOT / "train.py"), *arguments, f"hydra.run.dir={folder}"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")
    return read_rows(load_checkpoint(latest_checkpoint(folder)))


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
    there = torch.cuda.device_count() if args.device == "cuda" else 2
    if not there:
        parser.error("--device cuda: there is no GPU here; use --device cpu")
    arguments = [*args.arguments, f"scale={args.scale}", f"device={args.device}"]
    alone = compose(*arguments)
    if args.every >= alone.trainer.updates:
        parser.error(f"--every {args.every}: must be less than trainer.updates={alone.trainer.updates}")
    rate = alone.trainer.lr or alone.model.lr
    rows: list[dict[str, Any]] = []
    for gpus in sorted(args.gpus or [n for n in (1, 2, 4, 8) if n <= there]):
        for seed in args.seeds:
            job = [*arguments, *grown(gpus, *arguments), f"seed={seed}", "logger=none"]
            job += [
                f"trainer.lr={rate * gpus ** POWERS[args.learning_rate]}",
                "trainer.checkpoint_replay=false",
            ]
            job += ["evaluation.during=[planner]", f"evaluation.every={args.every}"]
            job += [f"evaluation.episodes={args.episodes}", "evaluation.during_episodes=null"]
            print(f"GPUs {gpus}, seed {seed} …", flush=True)
            with tempfile.TemporaryDirectory() as folder:
                found = first(
                    learned([*job, "evaluation.video_episodes=0"], Path(folder) / "run"), args.share
                )
            same = [row["training [s]"] for row in rows if row["seed"] == seed]
            rows.append(
                {
                    "GPUs": gpus,
                    "seed": seed,
                    "batch": alone.replay.batch_size * gpus,
                    "success [%]": 100 * found[SUCCESS],
                    "training [s]": found["time_s"],
                    "updates": found["updates"],
                    "environment steps": found["env_steps"],
                    "times sooner": (same or [found["time_s"]])[0] / found["time_s"],
                }
            )
            print(rows[-1], flush=True)
    title = f"time until {100 * args.share:g} % of episodes end in success"
    publish(title, rows, args.out, device=args.device, ran=("franka_wm/", "train.py"))


if __name__ == "__main__":
    main()
