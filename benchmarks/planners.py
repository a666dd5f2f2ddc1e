"""Planning time: encode, plan, act, with a policy prior and a terminal value.

python benchmarks/planners.py                512 candidates × 6 iterations × 3 steps, for 1, 16, … environments
"""

from __future__ import annotations

import argparse

import torch
from common import publish, rate
from tensordict import TensorDict

from franka_wm import models
from franka_wm.envs import resolve_device
from franka_wm.planning import MPPI, PlannerPolicy

REFERENCE_SECONDS = 1.39
"""One plan of 512 × 6 × 3 for one environment of the reference library, on 2 CPU cores."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="auto")
    parser.add_argument("--envs", type=int, nargs="+")
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--out")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")
    sizes = {"128/256 (laptop)": (128, 256, 256), "512/512 (paper)": (512, 256, 512)}
    rows = []
    for name, (latent, encoder, hidden) in sizes.items():
        model = models.make(
            "tdmpc2",
            observation_sizes={"state": 20, "joint_target": 7},
            action_dim=7,
            episode_length=50,
            latent_dim=latent,
            encoder_dim=encoder,
            hidden_dim=hidden,
        ).to(device)  # fmt: skip
        policy = PlannerPolicy.for_model(model, MPPI(action_dim=7))
        for envs in arguments.envs or ([1, 64, 1024] if device.type == "cuda" else [1, 4]):
            observation = TensorDict(
                {
                    "state": torch.randn(envs, 20, device=device),
                    "joint_target": torch.randn(envs, 7, device=device),
                    "is_init": torch.zeros(envs, 1, dtype=torch.bool, device=device),
                },
                batch_size=[envs],
            )
            plans = rate(
                lambda observation=observation, policy=policy: policy(observation), seconds=arguments.seconds
            )
            rows.append(
                {
                    "latent/hidden": name,
                    "environments": envs,
                    "time per call [ms]": 1e3 / plans,
                    "plans [1/s]": plans * envs,
                    "reference / ours": REFERENCE_SECONDS * plans if envs == 1 else "–",
                }
            )
            print(rows[-1], flush=True)
    publish("planner: MPPI 512 × 6 × 3 with policy prior", rows, arguments.out)


if __name__ == "__main__":
    main()
