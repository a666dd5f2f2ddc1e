"""The same work by this package and by `xwm` (JAX, PyPI), one after the other on the same machine.

    python -m venv /tmp/xwm && /tmp/xwm/bin/pip install "xwm[newton]"
    python benchmarks/against_xwm.py --python /tmp/xwm/bin/python
    python benchmarks/against_xwm.py --python /tmp/xwm/bin/python --compile      some minutes longer

xwm is compiled throughout. `--compile` compiles what `trainer.compile=true` and `planner.compile=true` compile in a
run; without it all operations are launched one by one. Updates and MPPI are measured with products by oneDNN, too
(`trainer.onednn`), and in bfloat16 (`trainer.precision`, `planner.precision`); xwm in float32 alone.

Same sizes: state of 27 numbers, 7 actions, latent and hidden 512, batch 64 windows of 3 for TD-MPC2; MPPI 512 × 6 × 3;
50 simulations of MCTS over 15 moves; a tiny ViT (patches of 8) on clips of 4 frames of 64 × 64 for the action world
model; one arm with 16 substeps and 64 × 64 pixels. What differs is said in the last column.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
from functools import partial
from importlib.resources import files
from pathlib import Path

import torch
from common import publish, rate
from tensordict import TensorDict

from franka_wm import models
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.planning import MPPI, RewardPlusValue
from franka_wm.planning.mcts import MCTS
from franka_wm.policies import PlannerPolicy, SearchPolicy
from franka_wm.products import prefer_onednn
from franka_wm.training.learner import Learner

TWO = ", 512/512, batch 64, two Q-functions"
NOTES = {
    f"TD-MPC2 updates{TWO}": "two in both",
    "TD-MPC2 updates": "ours: 5 Q-functions, theirs: 2",
    "MPPI plans": "ours: elites, policy candidates, batched over environments",
    "MCTS moves": "both PUCT; 64 at once by jax.vmap there",
    "action world": "encoder frozen in both",
    "environment": "both Newton; theirs Featherstone, ours MuJoCo in a captured graph",
}


def windows(batch: int, length: int, **observations: torch.Tensor) -> TensorDict:
    """Random windows with the given observations (batch, length + 1, …)."""
    root = {key: value[:, :-1] for key, value in observations.items()}
    after = {key: value[:, 1:] for key, value in observations.items()}
    after["reward"] = -torch.rand(batch, length, 1)
    after["terminated"] = torch.zeros(batch, length, 1, dtype=torch.bool)
    root["action"] = torch.randn(batch, length, 7).tanh()
    root["is_init"] = torch.zeros(batch, length, 1, dtype=torch.bool)
    nested = TensorDict(after, batch_size=[batch, length])
    return TensorDict(root | {"next": nested}, batch_size=[batch, length])


def learning(seconds: float, *, compile: bool, precision: str) -> dict[str, float]:
    """Updates and plans per second, in one precision."""
    torch.manual_seed(0)
    rows = {}
    batch = windows(64, 3, state=torch.randn(64, 4, 27))
    for members, said in ((2, TWO), (5, ", 512/512, batch 64")):  # MPPI plans with the last one
        agent = models.make(
            "tdmpc2", observation_sizes={"state": 27}, action_dim=7, episode_length=50, num_q=members
        )
        learner = Learner(agent, compile=compile, precision=precision)
        update = partial(learner.update, batch)
        rows[f"TD-MPC2 updates{said}"] = rate(update, seconds=seconds)

    agent.eval()
    objective = RewardPlusValue(agent.reward, agent.value, agent.discount)
    policy = PlannerPolicy.for_model(
        agent, MPPI(action_dim=7), objective=objective, compile=compile, precision=precision
    )
    seen = TensorDict(
        {"state": torch.randn(1, 27), "is_init": torch.zeros(1, 1, dtype=torch.bool)}, batch_size=[1]
    )
    rows["MPPI plans, 512 x 6 x 3"] = rate(lambda: policy(seen), seconds=seconds)

    world = models.make(
        "action_world_model",
        observation_sizes={},
        image_sizes={"pixels": (64, 64, 3)},
        action_dim=7,
        episode_length=50,
        freeze_encoder=True,
    )
    clips = windows(16, 3, pixels=torch.randint(0, 255, (16, 4, 64, 64, 3), dtype=torch.uint8))
    learner = Learner(world, compile=compile, precision=precision)
    name = "action world model updates, 64 x 64, batch 16 of 4 frames"
    rows[name] = rate(lambda: learner.update(clips), seconds=seconds)
    return rows


def searching_and_stepping(seconds: float, *, compile: bool) -> dict[str, float]:
    """What has one precision: moves of a tree search, steps of the arm."""
    rows = {}
    seen = TensorDict({"state": torch.randn(1, 27)}, batch_size=[1])
    muzero = models.make(
        "muzero",
        observation_sizes={"state": 27},
        num_actions=15,
        episode_length=50,
        latent_dim=256,
        hidden_dim=256,
    ).eval()
    search = MCTS(num_actions=15, num_simulations=50)
    policy = SearchPolicy.for_model(muzero, search, explore=False, compile=compile)
    rows["MCTS moves, 50 simulations"] = rate(lambda: policy(seen), seconds=seconds)
    many = seen.expand(64).clone()
    rows["MCTS moves, 50 simulations, 64 at once"] = 64 * rate(lambda: policy(many), seconds=seconds)

    env = FrankaEnv(FrankaConfig(observations=("pixels", "state")), num_envs=1, device="cpu")
    box = {"at": env.reset()}

    def step() -> None:
        action = torch.randn(1, 7).tanh()
        _, box["at"] = env.step_and_maybe_reset(box["at"].set("action", action))

    rows["environment steps, one arm, 64 x 64 pixels"] = rate(step, seconds=seconds)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--python", required=True, help="a Python that has xwm")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each row")
    parser.add_argument(
        "--compile", action="store_true", help="torch.compile updates, MPPI and the search's model"
    )
    parser.add_argument("--out", help="JSON file")
    args = parser.parse_args()
    if shutil.which(args.python) is None:
        parser.error(f"--python {args.python}: there is no such program; install xwm as above")
    urdf = files("franka_wm.envs.robots") / "fr3.urdf"
    each = args.seconds / 3  # rate() takes the median of three measurements
    mine = learning(each, compile=args.compile, precision="float32")
    mine |= searching_and_stepping(each, compile=args.compile)
    prefer_onednn()
    products = learning(each, compile=args.compile, precision="float32")
    prefer_onednn(False)
    half = learning(each, compile=args.compile, precision="bfloat16")
    print("ours measured; now xwm, which compiles first", flush=True)
    side = Path(__file__).parent / "_xwm_side.py"
    command = [args.python, str(side), str(args.seconds), str(urdf)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{args.python}: {done.stderr.strip().splitlines()[-1]}")
    theirs = json.loads(done.stdout.strip().splitlines()[-1])
    theirs[f"TD-MPC2 updates{TWO}"] = theirs["TD-MPC2 updates, 512/512, batch 64"]
    rows = [
        {
            "": name,
            "ours [1/s]": mine[name],
            "xwm [1/s]": theirs[name],
            "ratio": mine[name] / theirs[name],
            "ours, oneDNN [1/s]": products.get(name, float("nan")),
            "oneDNN ratio": products.get(name, float("nan")) / theirs[name],
            "ours, bfloat16 [1/s]": half.get(name, float("nan")),
            "bfloat16 ratio": half.get(name, float("nan")) / theirs[name],
            "what differs": next(note for start, note in NOTES.items() if name.startswith(start)),
        }
        for name in mine
    ]
    publish("against xwm", rows, args.out, device="cpu", ran=("benchmarks/_xwm_side.py",))


if __name__ == "__main__":
    main()
