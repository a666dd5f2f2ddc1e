"""Closed-loop evaluation: whole episodes, on seeds that training never saw, of any policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from franka_wm.envs import FrankaEnv
from franka_wm.errors import UserError
from franka_wm.evaluation.intervals import bootstrap_mean, wilson

THRESHOLDS = (0.05, 0.025, 0.01)
"""Distances to the goal that count as success [m]."""

EVALUATION_SEED = 1_000_003
"""Added to a run's seed: worlds and goals of the evaluation are not those of training."""

Policy = Callable[[TensorDictBase], TensorDictBase]


@torch.no_grad()
def play_episodes(
    env: FrankaEnv, policy: Policy, *, seed: int, video: Callable[[], None] | None = None
) -> TensorDict:
    """Plays one episode in every world and records how it ended.

    Args:
        env: Its number of worlds is the number of episodes.
        policy: Run without exploration.
        seed: Of the episodes' poses and goals.
        video: Called before every step, to take a picture; after the last one the worlds have been reset.

    Returns:
        Batch size (N,): ``final_distance``, ``return``, ``length``, ``success_once`` (all float32), of the true
        last observation of each world's first episode.
    """
    n, device = env.num_envs, env.device
    distance = torch.zeros(n, device=device)
    total, length = torch.zeros(n, device=device), torch.zeros(n, device=device)
    once = torch.zeros(n, dtype=torch.bool, device=device)
    running = torch.ones(n, dtype=torch.bool, device=device)
    tensordict = env.reset(seed=seed)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(env.config.episode_length):
            if video is not None:
                video()
            tensordict, following = env.step_and_maybe_reset(policy(tensordict))
            after = tensordict.get("next")
            reached = env.simulation.next_true_state[:, 17:20].norm(dim=-1)
            distance = torch.where(running, reached, distance)
            total += running * after.get("reward").squeeze(-1)
            length += running
            once |= running & after.get("success").squeeze(-1)
            running &= ~after.get("done").squeeze(-1)
            tensordict = following
    out = {"final_distance": distance, "return": total, "length": length, "success_once": once.float()}
    return TensorDict(out, batch_size=[n])


def summarize(episodes: TensorDictBase, *, thresholds: Sequence[float] = THRESHOLDS) -> dict[str, Any]:
    """Means with 95 % intervals: bootstrap for distances and returns, Wilson for rates of success."""
    distance = episodes.get("final_distance").cpu()
    count = distance.numel()
    return {
        "final_distance": bootstrap_mean(distance).as_dict(),
        "success": {f"{t:g}": wilson(int((distance < t).sum()), count).as_dict() for t in thresholds},
        "return": bootstrap_mean(episodes.get("return").cpu()).as_dict(),
        "episodes": count,
    }


def evaluate_policies(
    env: FrankaEnv,
    policies: Mapping[str, Policy],
    *,
    seed: int,
    report: Callable[[str, dict[str, Any]], None] | None = None,
) -> dict[str, dict[str, Any]]:
    """Evaluates policies on the same episodes.

    Args:
        env: Its number of worlds is the number of episodes; at least 2, for the intervals.
        policies: By name.
        seed: The run's; the evaluation's own is derived from it.
        report: Called with each name and summary as they come.
    """
    if env.num_envs < 2:
        raise UserError(f"evaluation over {env.num_envs} episodes has no interval; use at least 2")
    results = {}
    for name, policy in policies.items():
        results[name] = summarize(play_episodes(env, policy, seed=seed + EVALUATION_SEED))
        if report is not None:
            report(name, results[name])
    return results
