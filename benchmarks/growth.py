"""How cost grows with one number at a time: worlds, batch, steps kept in the replay, horizon and candidates of a plan.

    python benchmarks/growth.py                     the published size on a GPU, the laptop's on a CPU
    python benchmarks/growth.py --what worlds batch --seconds 0.5

*worlds*: control steps of all of them, without images; *batch*: updates of TD-MPC2; *replay*: batches drawn; *horizon*
and *candidates*: decisions of MPPI. On CUDA each is one captured graph, as in runs. *energy* is that of the whole GPU
meanwhile, by NVML's counter; reading it needs `pip install nvidia-ml-py`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from common import power, publish, rate, tdmpc2
from env import CASES, diverge, uniform
from learner import experience
from planners import make_observation, make_planner

from franka_wm.data.captured import CapturedSampling
from franka_wm.data.replay import make_replay
from franka_wm.device import prefer_speed, resolve_device
from franka_wm.envs import FrankaEnv
from franka_wm.policies import PlannerPolicy
from franka_wm.training.learner import Learner

SIZES = {  # on a CPU, on a GPU
    "worlds": ([1, 4, 16, 64, 256], [1, 16, 256, 4096, 16_384, 65_536]),
    "batch": ([16, 64, 256, 1024], [32, 128, 512, 2048, 8192]),
    "replay": ([10_000, 100_000, 1_000_000], [10_000, 100_000, 1_000_000, 10_000_000]),
    "horizon": ([1, 3, 6, 12], [1, 3, 6, 12]),
    "candidates": ([64, 128, 256, 512, 1024], [64, 256, 1024, 4096]),
}
WORLDS, WINDOW = 64, 3
"""Of the replay; transitions of a window."""
WARMUP = 8
"""Calls before anything is measured: the first ones run eagerly, one is captured."""


def make_model(device: torch.device) -> Any:
    """TD-MPC2 of the published size on a GPU, of the laptop's on a CPU."""
    return tdmpc2(*((512, 256, 512) if device.type == "cuda" else (128, 256, 256))).to(device)


def worlds(size: int, device: torch.device) -> Callable[[], object]:
    """A control step of so many worlds."""
    env = FrankaEnv(CASES["state"], num_envs=size, device=device)
    env.reset()
    diverge(env.simulation, uniform)

    def step() -> None:
        env.simulation.tensors.action.copy_(uniform(env.simulation))
        env.simulation.step()

    return step


def batch(size: int, device: torch.device) -> Callable[[], object]:
    """An update from a batch of so many windows."""
    learner, windows = Learner(make_model(device)), experience(size, WINDOW, device)
    return lambda: learner.update(windows)


def replay(size: int, device: torch.device) -> Callable[[], object]:
    """A batch of 256 windows from a replay that holds so many steps."""
    kept = make_replay(capacity=size, num_envs=WORLDS, window=WINDOW, batch_size=256, device=device)
    kept.extend(experience(WORLDS, size // WORLDS, device))
    return CapturedSampling(kept) if device.type == "cuda" else kept.sample


def decision(device: torch.device, **settings: int) -> Callable[[], object]:
    """A decision of MPPI for one arm."""
    model = make_model(device).eval()
    policy = PlannerPolicy.for_model(model, replace(make_planner("mppi"), **settings))
    return partial(policy, make_observation(model, 1, device))


WORK: dict[str, Callable[[int, torch.device], Callable[[], object]]] = {
    "worlds": worlds,
    "batch": batch,
    "replay": replay,
    "horizon": lambda size, device: decision(device, horizon=size),
    "candidates": lambda size, device: decision(device, num_samples=size),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="auto")
    parser.add_argument("--what", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--seconds", type=float, default=1.0, help="of each of three measurements")
    parser.add_argument("--most", type=int, help="leave out larger sizes")
    parser.add_argument("--out")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    cuda = device.type == "cuda"
    prefer_speed(device)
    rows = []
    for what in arguments.what:
        for size in SIZES[what][cuda]:
            if arguments.most and size > arguments.most:
                continue
            torch.manual_seed(0)
            free = 0
            if cuda:
                torch.cuda.empty_cache()
                free = torch.cuda.mem_get_info(device)[0]
            work = WORK[what](size, device)
            for _ in range(WARMUP):
                work()
            with power(device) as drawn:
                calls = rate(work, seconds=arguments.seconds)
            taken = (free - torch.cuda.mem_get_info(device)[0]) / 2**20 if cuda else float("nan")
            rows.append(
                {
                    "what": what,
                    "size": size,
                    "time [ms]": 1e3 / calls,
                    "calls [1/s]": calls,
                    "energy [mJ/call]": 1e3 * drawn.watts / calls,
                    "memory [MiB]": taken,
                }
            )
            del work
            print(rows[-1], flush=True)
    publish("growth", rows, arguments.out, device=device)


if __name__ == "__main__":
    main()
