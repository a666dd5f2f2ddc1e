# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false
# (Kernels are Warp's language: pyright does not know its arrays.)
"""How deep things press into one another while experts work, by task and physics steps, and what that costs.

    python benchmarks/penetration.py                              lift, push, stack at 4, 8 and 16 substeps
    python benchmarks/penetration.py --tasks peg --substeps 4 --contacts newton
    python benchmarks/penetration.py --out penetration.json

The deepest contact of every substep counts, not only of the last one of a control step.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import torch
import warp as wp
from common import compose, publish

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.simulation.bodies import Bodies
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training.settings import RunSettings


@wp.kernel(enable_backward=False)
def note_depth(count: wp.array[int], world: wp.array[int], distance: wp.array[float], depth: wp.array[float]):
    contact = wp.tid()
    if contact < count[0]:
        wp.atomic_max(depth, world[contact], -distance[contact])


class Watched(Bodies):
    """Keeps how deep the deepest contact of each world was, until it is cleared."""

    def after_substep(self) -> None:
        super().after_substep()
        if not hasattr(self, "depth"):
            self.depth = wp.zeros(self.sim.num_envs, dtype=float, device=self.sim.device)
        data = self.sim.solver.mjw_data  # pyright: ignore[reportAttributeAccessIssue]
        inputs = [data.nacon, data.contact.worldid, data.contact.dist, self.depth]
        wp.launch(note_depth, data.naconmax, inputs, device=self.sim.device)


def measure(config: FrankaConfig, worlds: int) -> dict:
    env = FrankaEnv(config, num_envs=worlds, device="cpu", seed=1)
    env.simulation.bodies = bodies = Watched(env.simulation)
    policy = ExpertPolicy(env.simulation.task, env.kinematics, config)
    env.step(policy(env.reset(seed=1)))  # the graph is recorded
    now, depths = env.reset(seed=1), []
    began = time.perf_counter()
    for _ in range(config.episode_length):
        bodies.depth.zero_()
        now = env.step(policy(now))["next"]
        depths.append(1e3 * wp.to_torch(bodies.depth).clone())
    seconds = time.perf_counter() - began
    depth = torch.stack(depths).flatten()
    return {
        "task": config.task,
        "substeps": config.substeps,
        "contacts": config.collision_pipeline,
        "deepest [mm]": float(depth.max()),
        "99 % of steps [mm]": float(depth.quantile(0.99)),
        "median [mm]": float(depth.median()),
        "success [%]": 100 * float(now["success"].float().mean()),
        "steps/s": worlds * config.episode_length / seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", default=["lift", "push", "stack"])
    parser.add_argument("--substeps", nargs="+", type=int, default=[4, 8, 16])
    parser.add_argument("--contacts", choices=["mujoco", "newton"], default="mujoco")
    parser.add_argument("--worlds", type=int, default=32)
    parser.add_argument("--out", help="write the numbers as JSON")
    arguments = parser.parse_args()
    rows = []
    for task in arguments.tasks:
        arm = RunSettings.of(compose(f"env={task}")).env.arm
        for substeps in arguments.substeps:
            config = replace(arm, substeps=substeps, collision_pipeline=arguments.contacts)
            rows.append(measure(config, arguments.worlds))
            print(rows[-1], flush=True)
    publish("penetration", rows, arguments.out, device="cpu")


if __name__ == "__main__":
    main()
