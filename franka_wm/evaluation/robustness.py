"""What breaks when the world is not quite the one of training: looks, camera, dynamics, delay, noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase

from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import arm_of, play_episodes, seeded
from franka_wm.evaluation.intervals import bootstrap_mean, wilson
from franka_wm.evaluation.protocol import held_out_seeds

UNSHIFTED = "as trained"


@dataclass(frozen=True)
class Shift:
    """A world that is drawn from wider ranges than that of training.

    Attributes:
        randomization: Fields of :class:`~franka_wm.envs.config.Randomization`.
        looks: Whether it changes pictures alone: without pictures nothing of it is seen.
        env: Other fields of the environment's configuration.
    """

    randomization: Mapping[str, float]
    looks: bool = False
    env: Mapping[str, Any] = field(default_factory=dict)


SHIFTS: dict[str, Shift] = {
    "colours ± 0.3": Shift({"color": 0.3}, looks=True),
    "brightness ± 40 %": Shift({"brightness": 0.4}, looks=True),
    "camera ± 10 cm": Shift({"camera_position": 0.1, "camera_target": 0.05}, looks=True),
    "servo gains ± 40 %": Shift({"gains": 0.4}),
    "link masses ± 40 %": Shift({"mass": 0.4}),
    "joint friction to 5 N·m": Shift(
        # Dry friction is a constraint; the few iterations that do without it do not solve that.
        {"friction": 5.0},
        env={"solver_iterations": 30, "solver_ls_iterations": 50},
    ),
    "actions late by up to 3 steps": Shift({"action_latency": 3}),
    "action noise 0.3": Shift({"action_noise": 0.3}),
    "joint noise 0.02 rad": Shift({"observation_noise": 0.02}),
}
"""Name → what is drawn anew in every episode, beside what the run itself randomised."""


def robustness(
    agent: Any,
    *,
    episodes: int = 100,
    shifts: Mapping[str, Shift] = SHIFTS,
    policies: Sequence[str] | None = None,
    report: Callable[[str, Mapping[str, Any]], None] | None = None,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Plays the same held-out episodes again in shifted worlds.

    Poses and goals depend on the seed alone, so every episode is compared with itself in the unshifted world.

    Args:
        agent: Of :func:`franka_wm.training.load.load_agent`; of the arm.
        episodes: Worlds, at least 2.
        shifts: By name; those that change pictures alone are left out for models that read none.
        policies: Names; the planner (or the policy where there is none) and the oracle, which shows what the shift
            leaves possible, if not given.
        report: Called with each shift's name and results as they come.

    Returns:
        Shift → policy → ``final_distance`` [m] and ``success`` (at the task's distance), with 95 % intervals
        (bootstrap, Wilson); ``change`` of the final distance [m], paired by episode, with its bootstrap interval
        (``None`` for :data:`UNSHIFTED`); ``verdict``: ``holds``, ``worse`` where the change's interval lies above 0,
        ``breaks`` where also less than half of the unshifted successes are left.

    Raises:
        UserError: Not the arm, fewer than 2 episodes, or no such policy.
    """
    from franka_wm.training import build

    if arm_of(agent.env) is None:
        raise UserError("robustness=true: only the arm can be shifted; this run's environment is another's")
    if episodes < 2:
        raise UserError(f"episodes={episodes}: must be at least 2")
    names = _chosen(agent.policies) if policies is None else list(policies)
    for name in names:
        if name not in agent.policies:
            raise UserError(f"robustness: no policy {name!r}; here are {', '.join(agent.policies)}")
    seen = bool(getattr(agent.model, "image_sizes", {}))
    cases = {UNSHIFTED: Shift({})} | {name: s for name, s in shifts.items() if seen or not s.looks}
    own = build.plain(agent.cfg.env.randomization)
    seed = held_out_seeds(1)[0]
    results: dict[str, dict[str, dict[str, Any]]] = {}
    before: dict[str, TensorDictBase] = {}
    for case, shift in cases.items():
        env = build.make_evaluation_env(
            agent.cfg, num_envs=episodes, randomization=own | dict(shift.randomization), **shift.env
        )
        results[case] = {}
        for name in names:
            policy = agent.policies[name]
            with seeded(seed, policy):
                played = play_episodes(env, policy, seed=seed).cpu()
            before.setdefault(name, played)
            results[case][name] = _compared(played, before[name], env.config.success_distance)
        if report is not None:
            report(case, results[case])
    return results


def _chosen(policies: Mapping[str, Any]) -> list[str]:
    own = [name for name in ("planner", "policy") if name in policies][:1]
    return own + [name for name in ("oracle",) if name in policies]


def _compared(played: TensorDictBase, before: TensorDictBase, success_distance: float) -> dict[str, Any]:
    distance, unshifted = played.get("final_distance"), before.get("final_distance")
    hits, hits_before = (int((d < success_distance).sum()) for d in (distance, unshifted))
    same = played is before
    change = None if same else bootstrap_mean(distance - unshifted)
    verdict = ""
    if change is not None:
        verdict = "worse" if change.low > 0 else "holds"
        if verdict == "worse" and 2 * hits < hits_before:
            verdict = "breaks"
    return {
        "final_distance": bootstrap_mean(distance).as_dict(),
        "success": wilson(hits, torch.numel(distance)).as_dict(),
        "change": None if change is None else change.as_dict(),
        "verdict": verdict,
    }
