"""Planning time: encode, plan, act, with rewards and a terminal value, by every planner of continuous actions.

    python benchmarks/planners.py                          each with the numbers of its file in conf/planner
    python benchmarks/planners.py --planners mppi cem --sizes laptop --envs 1 16

The control rate is how many decisions per second each arm gets, if all are planned for in one call.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from common import publish, rate
from omegaconf import OmegaConf
from tensordict import TensorDict

from franka_wm import models
from franka_wm.envs import resolve_device
from franka_wm.planning import CEM, ICEM, MPPI, GradientPlanner, PlannerPolicy

PLANNERS = {"mppi": MPPI, "cem": CEM, "icem": ICEM, "gradient": GradientPlanner}
SIZES = {  # latent, encoder, hidden
    "laptop": ("128/256 (laptop)", (128, 256, 256)),
    "paper": ("512/512 (paper)", (512, 256, 512)),
}
REFERENCE_SECONDS = 1.39
"""One plan of MPPI, 512 × 6 × 3, for one environment of the reference library, on 2 CPU cores."""


def make_planner(name: str) -> Any:
    """The planner as `planner=NAME` sets it up."""
    file = Path(__file__).resolve().parents[1] / "conf" / "planner" / f"{name}.yaml"
    settings = dict(OmegaConf.to_container(OmegaConf.load(file)))  # type: ignore[arg-type]
    settings.pop("name")
    return PLANNERS[name](action_dim=7, **settings)


def model_steps(policy: PlannerPolicy, observation: TensorDict) -> int:
    """Latents that one decision of one environment sends through the model."""
    through, count = policy.next, 0

    def counted(z: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        nonlocal count
        count += z.shape[:-1].numel()
        return through(z, action)

    policy.next = counted
    try:
        policy(observation)
    finally:
        policy.next = through
    return count // observation.batch_size[0]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="auto")
    parser.add_argument("--planners", nargs="+", choices=PLANNERS, default=list(PLANNERS))
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES), help="of the model")
    parser.add_argument("--envs", type=int, nargs="+", help="planned for in one call")
    parser.add_argument("--seconds", type=float, default=3.0, help="of each of three measurements")
    parser.add_argument("--out", help="JSON file to write")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")
    rows = []
    for size in arguments.sizes:
        label, (latent, encoder, hidden) = SIZES[size]
        model = models.make(
            "tdmpc2",
            observation_sizes={"state": 20, "joint_target": 7},
            action_dim=7,
            episode_length=50,
            latent_dim=latent,
            encoder_dim=encoder,
            hidden_dim=hidden,
        ).to(device)
        for name in arguments.planners:
            policy = PlannerPolicy.for_model(model, make_planner(name))
            for envs in arguments.envs or ([1, 64, 1024] if device.type == "cuda" else [1, 4]):
                observation = TensorDict(
                    {
                        "state": torch.randn(envs, 20, device=device),
                        "joint_target": torch.randn(envs, 7, device=device),
                        "is_init": torch.zeros(envs, 1, dtype=torch.bool, device=device),
                    },
                    batch_size=[envs],
                )
                steps = model_steps(policy, observation)
                calls = rate(lambda: policy(observation), seconds=arguments.seconds)
                rows.append(
                    {
                        "planner": name,
                        "latent/hidden": label,
                        "environments": envs,
                        "model steps per decision": steps,
                        "time per call [ms]": 1e3 / calls,
                        "control rate [Hz]": calls,
                        "decisions [1/s]": calls * envs,
                        "reference / ours": REFERENCE_SECONDS * calls
                        if envs == 1 and name == "mppi"
                        else "–",
                    }
                )
                print(rows[-1], flush=True)
    publish("planners, with rewards and a terminal value", rows, arguments.out)


if __name__ == "__main__":
    main()
