"""Environment steps per second: raw Newton, our captured step, and TorchRL's Collector, in one run.

    python benchmarks/env.py                              what this machine can do
    python benchmarks/env.py --worlds 4096 16384 --cases state pixels --out env.json

*raw Newton* is physics (and rendering) alone in one graph, without task, reset or TorchRL: the ceiling.
Worlds are diverged: each is at another point of its episode, so that resets happen in every step.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import torch
from common import publish, rate
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

from franka_wm.device import resolve_device
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.simulation import Simulation

PRESET = FrankaConfig(
    observations=("state", "joint_target"),
    goal_sampling="reachable",
    gravity_compensation=True,
    limit_velocity=True,
    action_scale=0.085,
    substeps=4,
)
CASES = {
    "state": PRESET,
    "pixels": replace(PRESET, observations=("pixels", "state", "joint_target")),
    "meshes": replace(PRESET, observations=("pixels", "state", "joint_target"), robot="panda_meshes"),
    "pixels 128": replace(PRESET, observations=("pixels", "state", "joint_target"), image_size=128),
}


class RandomPolicy(TensorDictModuleBase):
    """Uniform actions, drawn on the device."""

    in_keys = ["is_init"]
    out_keys = ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        is_init = tensordict.get("is_init")
        return tensordict.set("action", torch.rand(is_init.shape[0], 7, device=is_init.device) * 2 - 1)


def raw_newton(config: FrankaConfig, worlds: int, device: str, seconds: float) -> float:
    """Physics, and refit and rendering where there are pictures, from diverged poses."""
    sim = Simulation(config, worlds, device)
    sim.reset()
    for _ in range(25):
        sim.tensors.action.uniform_(-1, 1)
        sim.step()

    def launches() -> None:
        sim.launch_physics()
        for camera, _, _, _ in sim.renderer.cameras:
            sim.model.bvh_refit_shapes(sim.newton_state)
            camera.render(sim.newton_state, sim.warp, sim.chain)

    graph = sim.record(launches)
    return worlds * rate(lambda: sim.recorder.replay(graph), seconds=seconds)


def captured_step(env: FrankaEnv, seconds: float) -> float:
    sim = env.simulation

    def step() -> None:
        sim.tensors.action.uniform_(
            -1, 1
        )  # a repeated action would drive the arms into their limits, a rare and slow case
        sim.step()

    return env.num_envs * rate(step, seconds=seconds)


def collector(env: FrankaEnv, steps: int, seconds: float) -> float:
    gather = Collector(
        env,
        RandomPolicy(),
        frames_per_batch=env.num_envs * steps,
        total_frames=-1,
        track_traj_ids=False,
        no_cuda_sync=True,
        trust_policy=True,
    )
    experience = iter(gather)
    result = env.num_envs * steps * rate(lambda: next(experience), seconds=seconds, warmup=2)
    gather.shutdown()
    return result


def measure(name: str, worlds: int, device: str, seconds: float) -> dict:
    config = CASES[name]
    on_gpu = device.startswith("cuda")
    if on_gpu:
        torch.cuda.empty_cache()
        free = torch.cuda.mem_get_info()[0]
    started = time.perf_counter()
    env = FrankaEnv(config, num_envs=worlds, device=device)
    env.step_and_maybe_reset(env.rand_action(env.reset()))
    startup = time.perf_counter() - started
    memory = (free - torch.cuda.mem_get_info()[0]) / worlds / 2**10 if on_gpu else float("nan")
    env.simulation.tensors.step_count.random_(0, config.episode_length)
    step = captured_step(env, seconds)
    through = collector(env, 16 if on_gpu else 8, seconds)
    broken = env.statistics()["nonfinite"]
    del env
    raw = raw_newton(config, worlds, device, seconds)
    return {
        "case": name,
        "worlds": worlds,
        "raw Newton [steps/s]": raw,
        "captured step [steps/s]": step,
        "Collector [steps/s]": through,
        "Collector / raw": through / raw,
        "start [s]": startup,
        "memory [KiB/world]": memory,
        "broken worlds": int(broken),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="auto")
    parser.add_argument("--worlds", type=int, nargs="+")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=["state", "pixels"])
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--out")
    arguments = parser.parse_args()
    device = str(resolve_device(arguments.device))
    worlds = arguments.worlds or ([4096, 16384] if device.startswith("cuda") else [64])
    rows = []
    for name in arguments.cases:
        for n in worlds:
            rows.append(measure(name, n, device, arguments.seconds))
            print(rows[-1], flush=True)
    publish("environment", rows, arguments.out)


if __name__ == "__main__":
    main()
