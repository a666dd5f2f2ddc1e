"""What do LeRobot's own policies learn from an expert's episodes? By lerobot-train, then lerobot-eval on the arm.

    franka-wm collect out=datasets/lift-images policy=expert env=lift_pixels episodes=200 noise=0.1 success_only=true
    python benchmarks/imitation.py datasets/lift-images
    python benchmarks/imitation.py datasets/lift-images --policy diffusion --steps 30000 --also num_workers=12

The policy sees what the dataset holds: images, the arm's state, and the goal, no objects. Of lift the goal tells where
the cube stood. *success* is the share of held-out episodes that end in success, *training* all of lerobot-train, with
its start. Needs the extra [lerobot-train], and diffusion the package diffusers.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import publish

from franka_wm.data.lerobot.provenance import read_provenance
from franka_wm.device import resolve_device

ROOT = Path(__file__).resolve().parents[1]
PLUGIN = "--env.discover_packages_path=franka_wm.data.lerobot_env"

ACT = (
    # From scratch: nothing is downloaded. The norms of its ResNet are frozen, and without those weights do nothing.
    "--policy.pretrained_backbone_weights=null",
    "--policy.chunk_size=20",  # episodes of lift have 60 steps; of the default's 100 most would be padding
    "--policy.n_action_steps=10",
    "--policy.optimizer_lr=1e-4",  # the default, 1e-5, is for pretrained backbones
    "--policy.optimizer_lr_backbone=1e-4",
)
DIFFUSION = (
    "--policy.pretrained_backbone_weights=null",
    "--policy.use_group_norm=true",
    "--policy.horizon=16",  # as in the paper; of LeRobot's 64 most would be padding
    "--policy.n_action_steps=8",
    "--policy.noise_scheduler_type=DDIM",
    "--policy.num_inference_steps=10",
)
POLICIES = {"act": ACT, "diffusion": DIFFUSION}
"""LeRobot's name of a policy -> options that differ from its defaults; those of --also come after them."""


def run(*command: str) -> float:
    """Seconds that a command took, which shows its own progress; ends the benchmark where it fails."""
    began = time.perf_counter()
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "PYTHONPATH": path}
    command = (sys.executable, "-P", "-m", *command)  # -P: lerobot is not the file beside this one
    if status := subprocess.run(command, env=environment).returncode:
        raise SystemExit(f"{shlex.join(command)}: ended with status {status}")
    return time.perf_counter() - began


def learn(kind: str, dataset: Path, out: Path, options: Sequence[str]) -> float:
    """Seconds of lerobot-train on a dataset."""
    return run(
        "lerobot.scripts.lerobot_train",
        f"--dataset.repo_id=local/{dataset.name}",
        f"--dataset.root={dataset}",
        f"--policy.type={kind}",
        "--policy.push_to_hub=false",
        "--env_eval_freq=0",
        f"--output_dir={out}",
        *options,
    )


def judge(policy: Path, dataset: Path, out: Path, device: str, episodes: int) -> list[bool]:
    """Whether each held-out episode ends in success when a policy acts, by lerobot-eval."""
    run(
        "lerobot.scripts.lerobot_eval",
        f"--policy.path={policy}",
        f"--policy.device={device}",
        PLUGIN,
        "--env.type=franka_wm",
        f"--env.dataset={dataset}",
        f"--env.device={device}",
        f"--eval.batch_size={episodes}",
        f"--eval.n_episodes={episodes}",
        "--eval.use_async_envs=false",
        f"--output_dir={out}",
    )
    (task,) = json.loads((out / "eval_info.json").read_text())["per_task"]
    return task["metrics"]["successes"]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path, help="folder of a dataset that franka-wm collect wrote")
    parser.add_argument("--policy", default="act", choices=POLICIES)
    parser.add_argument("--steps", type=int, default=20_000, help="updates")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--also", nargs="*", default=[], help="more options of lerobot-train, without dashes")
    parser.add_argument("--held-out", type=int, default=128, help="episodes of the evaluation")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="of lerobot-train")
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--out", help="JSON file")
    args = parser.parse_args()
    provenance = read_provenance(args.dataset)
    if provenance is None:
        parser.error(
            f"{args.dataset} was not written by franka-wm: it does not say which arm and task it is of"
        )
    sessions = provenance["sessions"]
    episodes = json.loads((args.dataset / "meta" / "info.json").read_text())["total_episodes"]
    device = resolve_device(args.device).type
    rows: list[dict[str, Any]] = []
    for seed in args.seeds:
        print(f"{args.policy}, seed {seed}: {args.steps} updates …", flush=True)
        options = [*POLICIES[args.policy], f"--policy.device={device}", f"--seed={seed}"]
        options += [f"--steps={args.steps}", f"--save_freq={args.steps}", f"--batch_size={args.batch}"]
        options += [f"--{option}" for option in args.also]
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "run"
            training = learn(args.policy, args.dataset, out, options)
            policy = out / "checkpoints" / "last" / "pretrained_model"
            reached = judge(policy, args.dataset, Path(folder) / "held-out", device, args.held_out)
        rows.append(
            {
                "policy": args.policy,
                "task": sessions[0]["config"]["env"]["task"],
                "dataset": "; ".join(session["command"] for session in sessions),
                "episodes": episodes,
                "seed": seed,
                "updates": args.steps,
                "batch": args.batch,
                "training [s]": training,
                "success [%]": 100 * float(np.mean(reached)),
                "held-out episodes": len(reached),
            }
        )
        print(rows[-1], flush=True)
    publish("LeRobot's policies", rows, args.out, device=device, ran=("franka_wm/",))


if __name__ == "__main__":
    main()
