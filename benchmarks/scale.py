"""How much faster is one job on several GPUs of a host? Each GPU has the same work: worlds, batch, replay.

    python benchmarks/scale.py                                    all cases on 1, 2, … GPUs
    python benchmarks/scale.py --cases "TD-MPC2" --gpus 1 2       some of them
    python benchmarks/scale.py --device cpu --scale smoke --gpus 1 2

*environment* is the simulator alone, one process for each GPU. The others are whole training by ``train.py gpus=N``:
gathering, resets, sampling, updates and the averaging of gradients; the first third of the updates is warm-up.
*predicted* is the cost model of `docs/scale.md`, from one GPU's time of an update and those of its messages
(`benchmarks/all_reduce.py`): the gradients', and small ones of statistics that wait for each other. The last rows are
that model's for more GPUs than there are, in hosts of eight.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from common import compose, grown, publish
from cost_model import HOST, NETWORKS, Link, all_reduce, link, speed_up

from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from franka_wm.training.history import read_rows
from franka_wm.training.tree import read_tensors

ROOT = Path(__file__).resolve().parents[1]

TRAINING = {
    "TD-MPC2": ["env=reach"],
    "TD-MPC2, images": [
        "env=reach_fixed_pixels",
        "model=tdmpc2_pixels",
        "env.frame_stack=3",
        "replay.capacity=600000",
    ],
    "LeWorldModel": ["env=reach_goal_image", "model=lewm"],
}
"""Case -> arguments of train.py."""

MESSAGES = {"TD-MPC2": 2, "TD-MPC2, images": 2, "LeWorldModel": 8}
"""Case -> how many an update sends, as counted by `tests/processes/test_parts_of_batches.py`."""

COLUMNS = (
    "case", "GPUs", "network", "updates/s", "windows/s", "env steps/s", "gradients [MB]", "gradients [ms]",
    "messages [ms]", "predicted", "times one GPU",
)  # fmt: skip
"""Of a row. *gradients [ms]* is the time of their message, *messages [ms]* that of all messages of an update."""

QUIET = [
    "evaluation.during=[]",
    "evaluation.episodes=8",
    "evaluation.video_episodes=0",
    "logger=none",
    "trainer.checkpoint_replay=false",
    "trainer.log_every=1",
]


def environment(gpus: int, device: str, worlds: int, seconds: float) -> float:
    """Steps of all worlds per second, with images, of one process for each GPU."""
    command = [sys.executable, __file__, "--worlds", str(worlds), "--seconds", str(seconds)]
    places = ["cpu" if device == "cpu" else f"cuda:{k}" for k in range(gpus)]
    workers = [
        subprocess.Popen(
            [*command, "--worker", place], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for place in places
    ]
    for one in workers:  # built and warm
        assert one.stdout is not None and one.stdout.readline() == "ready\n", "a worker has ended"
    for one in workers:
        assert one.stdin is not None
        one.stdin.write("go\n")
        one.stdin.flush()
    said = [one.communicate()[0].splitlines() for one in workers]
    assert not any(one.returncode for one in workers), "a worker has failed"
    return sum(float(lines[-1]) for lines in said)  # Warp may have printed before


def worker(device: str, worlds: int, seconds: float) -> None:
    """One process of :func:`environment`."""
    from franka_wm.envs import FrankaConfig, FrankaEnv

    env = FrankaEnv(FrankaConfig(observations=("pixels", "state")), num_envs=worlds, device=device)
    tensordict = env.reset()

    def steps(seconds: float) -> float:
        nonlocal tensordict
        started, done = time.perf_counter(), 0
        while time.perf_counter() - started < seconds:
            for _ in range(20):
                # The same one for ever would drive every joint to its limit, where worlds do little.
                action = torch.rand(worlds, env.action_dim, device=env.device) * 2 - 1
                _, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
                tensordict.pop("next", None)
            if env.device.type == "cuda":
                torch.cuda.synchronize(env.device)
            done += 20 * worlds
        return done / (time.perf_counter() - started)

    steps(2.0)
    print("ready", flush=True)
    sys.stdin.readline()
    print(steps(seconds), flush=True)


def messages(gpus: int, device: str, megabytes: float) -> tuple[float, float]:
    """Seconds that so many GPUs take to add up gradients of this size, and numbers of next to no size."""
    if gpus == 1:
        return 0.0, 0.0
    with tempfile.NamedTemporaryFile(suffix=".json") as file:
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={gpus}"]
        command += [str(ROOT / "benchmarks" / "all_reduce.py"), f"--device={device}", f"--out={file.name}"]
        sizes = ["--megabytes", str(megabytes), "0.01"]
        subprocess.run([*command, *sizes], check=True, capture_output=True, cwd=ROOT)
        large, small = json.loads(Path(file.name).read_text())["rows"]
        return large["ms"] / 1e3, small["ms"] / 1e3


def training(arguments: list[str], gpus: int, updates: int) -> tuple[float, int, float]:
    """A whole job in which each GPU has the work of the configuration.

    Returns:
        Updates per second, its batch, and the gradients of an update [MB].
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(ROOT / "train.py"), *arguments, *QUIET]
        command += [*grown(gpus, *arguments), f"trainer.updates={updates}", f"hydra.run.dir={folder}/run"]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")
        place = latest_checkpoint(f"{folder}/run")
        rows = read_rows(load_checkpoint(place))
        # Adam keeps a mean of each gradient.
        kept = read_tensors(place, "optimizer").items()
        gradients = sum(x.numel() for name, x in kept if name.endswith("exp_avg")) * 4 / 1e6
    later = [row for row in rows if "updates_per_s" in row and row["updates"] >= updates / 3]
    if len(later) < 2:
        raise SystemExit(f"--updates {updates}: over before two rows were logged; make more")
    first, last = later[0], later[-1]
    rate = (last["updates"] - first["updates"]) / (last["time_s"] - first["time_s"])
    return rate, compose(*arguments).replay.batch_size * gpus, gradients


def beyond(case: str, update: float, gradients: float, inside: Link) -> list[dict[str, Any]]:
    """The cost model for more GPUs than there are, whose hosts are as the one measured.

    Args:
        update: Of one GPU [s].
        gradients: Of an update [MB].
    """
    rows = []
    hosts = [(gpus, network) for network in NETWORKS for gpus in (16, 64, 512)]
    for gpus, network in [(HOST, "one host"), *hosts]:
        large, small = (
            all_reduce(size, gpus, inside, NETWORKS.get(network)) for size in (1e6 * gradients, 0.0)
        )
        waited = large + (MESSAGES[case] - 1) * small
        row = dict.fromkeys(COLUMNS, float("nan")) | {"case": case, "GPUs": gpus, "network": network}
        row |= {"gradients [MB]": gradients, "gradients [ms]": 1e3 * large, "messages [ms]": 1e3 * waited}
        rows.append(row | {"predicted": speed_up(gpus, update, waited)})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--cases", nargs="+", default=["environment", *TRAINING], choices=["environment", *TRAINING]
    )
    parser.add_argument("--gpus", nargs="+", type=int, help="1, 2, 4, … as many as there are, if not given")
    parser.add_argument("--updates", type=int, default=6000)
    parser.add_argument("--worlds", type=int, default=4096, help="of the environment alone, on each GPU")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--scale", default="gpu")
    parser.add_argument("--out", help="JSON file")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        return worker(args.worker, args.worlds, args.seconds)
    there = torch.cuda.device_count() if args.device == "cuda" else 2
    numbers = sorted(args.gpus or [n for n in (1, 2, 4, 8) if n <= there])
    if numbers[0] != 1:
        parser.error("--gpus: needs 1, with which the others are compared")
    rows: list[dict[str, Any]] = []
    further: list[dict[str, Any]] = []
    for case in args.cases:
        alone, update = 0.0, 0.0
        for gpus in numbers:
            row: dict[str, Any] = dict.fromkeys(COLUMNS, float("nan")) | {"case": case, "GPUs": gpus}
            if case == "environment":
                done = environment(gpus, args.device, args.worlds, args.seconds)
                row |= {"env steps/s": done, "predicted": float(gpus)}
            else:
                arguments = [*TRAINING[case], f"scale={args.scale}", f"device={args.device}"]
                updates, batch, gradients = training(arguments, gpus, args.updates)
                done, (large, small) = updates * batch, messages(gpus, args.device, gradients)
                waited = large + (MESSAGES[case] - 1) * small
                update = update or 1 / updates  # of the fewest GPUs, which should be one
                row |= {"updates/s": updates, "windows/s": done, "gradients [MB]": gradients}
                row |= {"gradients [ms]": 1e3 * large, "messages [ms]": 1e3 * waited}
                row["predicted"] = speed_up(gpus, update, waited)
                if gpus > 1 and gpus == numbers[-1]:
                    further += beyond(case, update, gradients, link(gpus, 1e6 * gradients, large, small))
            alone = alone or done / gpus
            row["times one GPU"] = done / alone
            rows.append(row)
            print(row, flush=True)
    processes = "franka_wm/", "train.py", "benchmarks/all_reduce.py"
    publish("scale", rows + further, args.out, device=args.device, ran=processes)


if __name__ == "__main__":
    main()
