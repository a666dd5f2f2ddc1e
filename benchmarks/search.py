"""Time of a tree search: encode, search with the model, act, for 1, 64, 1024 environments.

python benchmarks/search.py                  50 simulations of PUCT and of Gumbel over 15 discrete actions
python benchmarks/search.py --envs 1 --variants puct

Each with the tree in plain tensor code and in Warp kernels. On CUDA every search is timed twice: launched operation by
operation, and as one captured graph, which is what runs do.
"""

from __future__ import annotations

import argparse
from functools import partial
from itertools import product

import torch
from common import publish, rate
from tensordict import TensorDict

from franka_wm import models
from franka_wm.device import prefer_speed, resolve_device
from franka_wm.planning import MCTS
from franka_wm.policies import SearchPolicy

MOVES = 15
TREES = {"plain": False, "kernels": True}
"""Whether it walks in kernels."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="auto")
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 64, 1024])
    parser.add_argument("--variants", nargs="+", default=["puct", "gumbel"], choices=["puct", "gumbel"])
    parser.add_argument("--trees", nargs="+", default=list(TREES), choices=TREES)
    parser.add_argument(
        "--compile", action="store_true", help="torch.compile the model's part, as planner.compile does"
    )
    parser.add_argument("--simulations", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--out")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    prefer_speed(device)
    model = models.make("muzero", observation_sizes={"state": 20, "joint_target": 7}, num_actions=MOVES).to(
        device
    )
    model.eval()
    rows = []
    for variant, tree in product(arguments.variants, arguments.trees):
        search = MCTS(
            num_actions=MOVES, num_simulations=arguments.simulations, variant=variant, kernels=TREES[tree]
        )
        for envs in arguments.envs:
            observation = TensorDict(
                {
                    "state": torch.randn(envs, 20, device=device),
                    "joint_target": torch.randn(envs, 7, device=device),
                },
                batch_size=[envs],
            )
            for way in ("eager", "captured") if device.type == "cuda" else ("eager",):
                policy = SearchPolicy.for_model(
                    model, search, explore=True, capture=way == "captured", compile=arguments.compile
                )
                decisions = rate(partial(policy, observation), seconds=arguments.seconds)
                rows.append(
                    {
                        "variant": variant,
                        "tree": tree,
                        "launched": way,
                        "environments": envs,
                        "ms/decision": 1e3 / decisions,
                        "ms/move": 1e3 / decisions / envs,
                        "moves [1/s]": decisions * envs,
                    }
                )
                print(rows[-1], flush=True)
    details = ", compiled" if arguments.compile else ""
    title = f"tree search: {arguments.simulations} simulations, {MOVES} discrete actions{details}"
    publish(title, rows, arguments.out, device=device)


if __name__ == "__main__":
    main()
