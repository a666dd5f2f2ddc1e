"""Planning time: encode, plan, act, by every planner of continuous actions.

    python benchmarks/planners.py                          each with its numbers at scale=gpu
    python benchmarks/planners.py --planners mppi cem --sizes laptop --envs 1 16
    python benchmarks/planners.py --sizes lewm --planners cem           to a goal image

The control rate is how many decisions per second each arm gets, if all are planned for in one call. On CUDA every
decision is timed twice: with each operation launched from Python, and as one captured graph, which is what runs do.
"""

from __future__ import annotations

import argparse
from functools import partial
from itertools import product
from typing import Any

import torch
from common import compose, publish, rate, tdmpc2
from omegaconf import OmegaConf
from tensordict import TensorDict

from franka_wm import models
from franka_wm.device import prefer_speed, resolve_device
from franka_wm.planning import CEM, ICEM, MPPI, GoalImage, GradientPlanner
from franka_wm.policies import PlannerPolicy

PLANNERS = {"mppi": MPPI, "cem": CEM, "icem": ICEM, "gradient": GradientPlanner}
SIZES = {  # latent, encoder, hidden
    "laptop": ("TD-MPC2 128/256 (laptop)", (128, 256, 256)),
    "paper": ("TD-MPC2 512/512 (paper)", (512, 256, 512)),
    "lewm": ("LeWorldModel (paper)", None),
}


def make_planner(name: str, layers: str = "fused") -> Any:
    """The planner as `planner=NAME scale=gpu` sets it up; `layers`: `plain`, as with `planner.kernels=false`."""
    cfg = compose(f"planner={name}", "scale=gpu")
    settings = dict(OmegaConf.to_container(cfg.planner, resolve=True))  # type: ignore[arg-type]
    for key in ("name", "precision", "compile"):
        settings.pop(key)
    if layers == "plain" and "kernels" in settings:
        settings["kernels"] = False
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


def make_model(size: str) -> Any:
    """The world model of this size, untrained; planning time does not depend on weights."""
    sizes = SIZES[size][1]
    if sizes is None:
        return models.make("lewm", image_sizes={"pixels": (64, 64, 3)}, action_dim=7)
    latent, encoder, hidden = sizes
    return tdmpc2(latent, encoder, hidden)


def make_observation(model: Any, envs: int, device: torch.device) -> TensorDict:
    """What the policy reads."""
    entries: dict[str, torch.Tensor] = {
        key: torch.randn(envs, size, device=device) for key, size in model.observation_sizes.items()
    }
    for key, shape in model.image_sizes.items():
        entries[key] = torch.randint(256, (envs, *shape), dtype=torch.uint8, device=device)
        entries[f"goal_{key}"] = torch.randint(256, (envs, *shape), dtype=torch.uint8, device=device)
    entries["is_init"] = torch.zeros(envs, 1, dtype=torch.bool, device=device)
    return TensorDict(entries, batch_size=[envs])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="auto")
    parser.add_argument("--planners", nargs="+", choices=PLANNERS, default=list(PLANNERS))
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=["laptop", "paper"], help="of the model")
    parser.add_argument("--envs", type=int, nargs="+", help="planned for in one call")
    parser.add_argument("--seconds", type=float, default=3.0, help="of each of three measurements")
    parser.add_argument("--compile", action="store_true", help="torch.compile what the planner calls")
    parser.add_argument("--precision", choices=["float32", "bfloat16"], default="float32")
    parser.add_argument(
        "--layers",
        nargs="+",
        choices=["fused", "plain"],
        default=["fused"],
        help="on CUDA; a CPU has plain ones alone",
    )
    parser.add_argument("--launched", nargs="+", choices=["eager", "captured"], help="default: both on CUDA")
    parser.add_argument("--out", help="JSON file to write")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    cuda = device.type == "cuda"
    prefer_speed(device)
    rows = []
    for size in arguments.sizes:
        model = make_model(size).to(device)
        for name in arguments.planners:
            # Rewards plus value, or the distance to the goal's image.
            objective = None if model.has_value else GoalImage(model.encode_goal, embed=model.embed)
            launches = arguments.launched or (["eager", "captured"] if cuda else ["eager"])
            for layers, launched in product(arguments.layers if cuda else ["plain"], launches):
                policy = PlannerPolicy.for_model(
                    model,
                    make_planner(name, layers),
                    objective=objective,
                    capture=launched == "captured",
                    precision=arguments.precision,
                    compile=arguments.compile,
                )
                for envs in arguments.envs or ([1, 64, 1024] if cuda else [1, 4]):
                    observation = make_observation(model, envs, device)
                    steps = model_steps(policy, observation)
                    calls = rate(partial(policy, observation), seconds=arguments.seconds)
                    rows.append(
                        {
                            "planner": name,
                            "model": SIZES[size][0],
                            "layers": layers,
                            "launched": launched,
                            "environments": envs,
                            "model steps per decision": steps,
                            "time per call [ms]": 1e3 / calls,
                            "control rate [Hz]": calls,
                            "decisions [1/s]": calls * envs,
                        }
                    )
                    print(rows[-1], flush=True)
    details = ", compiled" if arguments.compile else ""
    title = f"planners, {arguments.precision}{details}"
    publish(title, rows, arguments.out, device=device)


if __name__ == "__main__":
    main()
