"""Environment steps per second: raw Newton, our captured step, and TorchRL's Collector, in one run.

    python benchmarks/env.py                              what this machine can do
    python benchmarks/env.py --worlds 4096 16384 --cases state pixels --out env.json
    python benchmarks/env.py --cases lift stack --contacts mujoco newton      who finds contacts, and what it costs

*raw Newton* is physics (and rendering) alone in one graph, without task, reset or TorchRL: the ceiling.
Worlds are diverged in all three: each is at another point of its episode. Then raw worlds hold the set points that they
have, while the others go on, with resets in every step; where there is something to touch they play an episode of the
expert's, over and over. *memory* is what Warp and torch have allocated for the environment, by their own count.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable
from dataclasses import replace

import torch
import warp as wp
from common import publish, rate
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

from franka_wm.device import resolve_device
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.simulation import Simulation
from franka_wm.envs.tasks import task_class
from franka_wm.policies.expert import ExpertPolicy

PRESET = FrankaConfig(
    observations=("state", "joint_target"),
    goal_sampling="reachable",
    gravity_compensation=True,
    limit_velocity=True,
    action_scale=0.085,
    substeps=4,
)


def manipulation(task: str, *more: str, steps: int = 60) -> FrankaConfig:
    """A task with contacts, in which every episode begins alike: so one episode of the expert fits all of them."""
    scene = task_class(task).scene
    assert scene is not None
    still = {"spread": (0.0, 0.0), "turn": 0.0}
    apart = len({one.at for one in scene.objects}) == len(scene.objects)
    objects = [
        replace(one, at=one.at if apart else (0.5, 0.15 * k), **still) for k, one in enumerate(scene.objects)
    ]
    articulated = tuple(replace(one, **still) for one in scene.articulated)
    return replace(
        PRESET,
        task=task,
        scene=replace(scene, objects=tuple(objects), articulated=articulated),
        observations=(*more, "state", "joint_target", "objects"),
        episode_length=steps,
        pose_noise=0.0,
        solver_ls_iterations=20,
    )


CASES = {
    "state": PRESET,
    "pixels": replace(PRESET, observations=("pixels", "state", "joint_target")),
    "meshes": replace(PRESET, observations=("pixels", "state", "joint_target"), robot="panda_meshes"),
    "lift": manipulation("lift"),
    "lift pixels": manipulation("lift", "pixels"),
    "stack": manipulation("stack", steps=120),
    "drawer": manipulation("drawer", steps=90),
    "peg": manipulation("peg", steps=150),
    "pixels 128": replace(PRESET, observations=("pixels", "state", "joint_target"), image_size=128),
}


Actions = Callable[[Simulation], torch.Tensor]
"""What all worlds do next, (N, A), drawn or looked up on the device."""


def uniform(sim: Simulation) -> torch.Tensor:
    # A repeated action would drive the arms into their limits, a rare and slow case.
    return torch.rand_like(sim.tensors.action) * 2 - 1


def experts(config: FrankaConfig, device: str) -> Actions:
    """An episode of the expert's, looked up by the step at which each world is."""
    env = FrankaEnv(config, num_envs=2, device=device)
    policy, now, actions = ExpertPolicy(env.simulation.task, env.kinematics, config), env.reset(), []
    for _ in range(config.episode_length):
        now = policy(now)
        actions.append(now["action"][0].clone())
        step, now = env.step_and_maybe_reset(now)
    if not step["next", "success"].all():
        raise RuntimeError(f"the expert did not succeed at {config.task}")
    table = torch.stack(actions)
    return lambda sim: table[sim.tensors.step_count.view(-1).long()]


class Playing(TensorDictModuleBase):
    """Actions as a policy."""

    in_keys = ["is_init"]
    out_keys = ["action"]

    def __init__(self, sim: Simulation, actions: Actions):
        super().__init__()
        self.sim, self.actions = sim, actions

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", self.actions(self.sim))


def diverge(sim: Simulation, actions: Actions) -> None:
    """Brings each world to another point of its episode."""
    sim.tensors.step_count.random_(0, sim.config.episode_length)
    for _ in range(sim.config.episode_length):
        sim.tensors.action.copy_(actions(sim))
        sim.step()


def raw_newton(config: FrankaConfig, worlds: int, device: str, seconds: float, actions: Actions) -> float:
    """Physics, and refit and rendering where there are images, from diverged poses."""
    sim = Simulation(config, worlds, device)
    sim.reset()
    diverge(sim, actions)

    def launches() -> None:
        sim.launch_physics()
        for camera, _, _, _ in sim.renderer.cameras:
            sim.model.bvh_refit_shapes(sim.newton_state)
            camera.render(sim.newton_state, sim.warp, sim.chain)

    graph = sim.record(launches)
    return worlds * rate(lambda: sim.recorder.replay(graph), seconds=seconds)


def captured_step(env: FrankaEnv, seconds: float, actions: Actions) -> float:
    sim = env.simulation

    def step() -> None:
        sim.tensors.action.copy_(actions(sim))
        sim.step()

    return env.num_envs * rate(step, seconds=seconds)


def collector(env: FrankaEnv, steps: int, seconds: float, actions: Actions) -> float:
    gather = Collector(
        env,
        Playing(env.simulation, actions),
        frames_per_batch=env.num_envs * steps,
        total_frames=-1,
        track_traj_ids=False,
        no_cuda_sync=True,
        trust_policy=True,
    )
    experience = iter(gather)
    next(experience)  # it begins with a reset of all worlds
    diverge(env.simulation, actions)
    env.statistics()
    result = env.num_envs * steps * rate(lambda: next(experience), seconds=seconds, warmup=2)
    gather.shutdown()
    return result


def allocated(device: str) -> int:
    """Bytes that Warp and torch have allocated on a GPU; what they keep in reserve changes with what ran before."""
    torch.cuda.synchronize(device)
    return wp.get_mempool_used_mem_current(device) + torch.cuda.memory_allocated(device)


def measure(name: str, worlds: int, device: str, seconds: float, contacts: str) -> dict:
    config = CASES[name]
    if contacts != "mujoco":
        config, name = replace(config, collision_pipeline=contacts), f"{name}, contacts of {contacts}"
    on_gpu = device.startswith("cuda")
    before = allocated(device) if on_gpu else float("nan")
    started = time.perf_counter()
    env = FrankaEnv(config, num_envs=worlds, device=device)
    env.step_and_maybe_reset(env.rand_action(env.reset()))
    startup = time.perf_counter() - started
    memory = (allocated(device) - before) / worlds / 2**10 if on_gpu else float("nan")
    actions = experts(config, device) if config.has_gripper else uniform
    diverge(env.simulation, actions)
    step = captured_step(env, seconds, actions)
    through = collector(env, 16 if on_gpu else 8, seconds, actions)
    seen = env.statistics()
    del env
    if on_gpu:  # torch keeps the memory of the Collector's batches, which Warp cannot have then
        gc.collect()
        torch.cuda.empty_cache()
    raw = raw_newton(config, worlds, device, seconds, actions)
    return {
        "case": name,
        "worlds": worlds,
        "raw Newton [steps/s]": raw,
        "captured step [steps/s]": step,
        "Collector [steps/s]": through,
        "Collector / raw": through / raw,
        "start [s]": startup,
        "memory [KiB/world]": memory,
        "broken worlds": int(seen["nonfinite"]),
        "success [%]": 100 * seen["success"] if config.has_gripper else float("nan"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="auto")
    parser.add_argument("--worlds", type=int, nargs="+")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=["state", "pixels"])
    parser.add_argument("--contacts", nargs="+", choices=["mujoco", "newton"], default=["mujoco"])
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--out")
    arguments = parser.parse_args()
    device = str(resolve_device(arguments.device))
    worlds = arguments.worlds or ([4096, 16384] if device.startswith("cuda") else [64])
    rows = []
    for name in arguments.cases:
        for n in worlds:
            for contacts in arguments.contacts:
                rows.append(measure(name, n, device, arguments.seconds, contacts))
                print(rows[-1], flush=True)
    publish("environment", rows, arguments.out, device=device)


if __name__ == "__main__":
    main()
