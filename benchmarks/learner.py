"""TD-MPC2 updates per second: loss, backward, clipping, Adam, target networks; replay sampling beside it.

    python benchmarks/learner.py                 small sizes, and the published one

On CUDA the update is one captured graph, and sampling another, as in training.
"""

from __future__ import annotations

import argparse

import torch
from common import publish, rate, tdmpc2
from tensordict import TensorDict

from franka_wm.data.captured import CapturedSampling
from franka_wm.data.replay import make_replay
from franka_wm.device import prefer_speed, resolve_device
from franka_wm.training.learner import Learner

SIZES = {  # latent, encoder, hidden, batch
    "128/256, batch 32": (128, 256, 256, 32),
    "128/256, batch 64": (128, 256, 256, 64),
    "512/512, batch 64": (512, 256, 512, 64),
    "512/512, batch 256 (paper)": (512, 256, 512, 256),
}


def experience(worlds: int, steps: int, device: torch.device) -> TensorDict:
    """Random transitions of the arm's shapes."""

    def observation() -> dict:
        return {
            "state": torch.randn(worlds, steps, 20, device=device),
            "joint_target": torch.randn(worlds, steps, 7, device=device),
        }

    flags = torch.zeros(worlds, steps, 1, dtype=torch.bool, device=device)
    after = observation() | {"reward": -torch.rand(worlds, steps, 1, device=device), "terminated": flags}
    return TensorDict(
        observation()
        | {
            "action": torch.rand(worlds, steps, 7, device=device) * 2 - 1,
            "is_init": flags.clone(),
            "next": after,
        },
        batch_size=[worlds, steps],
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="auto")
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--compile", action="store_true", help="compile the loss, too")
    parser.add_argument("--precision", choices=["float32", "bfloat16"], default="float32")
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES), help="default: all")
    parser.add_argument("--out")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    prefer_speed(device)
    rows = []
    for name in arguments.sizes:
        latent, encoder, hidden, batch = SIZES[name]
        torch.manual_seed(0)
        one, other = (  # a captured update keeps the batch that it was captured with
            Learner(
                tdmpc2(latent, encoder, hidden).to(device),
                compile=arguments.compile,
                precision=arguments.precision,
            )
            for _ in range(2)
        )
        replay = make_replay(capacity=100_000, num_envs=64, window=3, batch_size=batch, device=device)
        replay.extend(experience(64, 500, device))
        fixed = replay.sample()
        alone = rate(lambda: one.update(fixed), seconds=arguments.seconds, warmup=8)
        sampling = CapturedSampling(replay) if other.capture else None

        def draw_and_update() -> None:
            if sampling is None:
                other.update(replay.sample())
            else:
                batch = sampling()
                other.update(batch, static=sampling.is_static(batch))

        sampled = rate(draw_and_update, seconds=arguments.seconds, warmup=8)
        rows.append(
            {
                "latent/hidden, batch": name,
                "parameters": f"{sum(p.numel() for p in one.model.parameters()) / 1e6:.2f} M",
                "update [1/s]": alone,
                "sample + update [1/s]": sampled,
            }
        )
        print(rows[-1], flush=True)
    publish("learner", rows, arguments.out, device=device)


if __name__ == "__main__":
    main()
