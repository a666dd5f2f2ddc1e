"""The same evaluation for every family: fixed held-out episodes, all policies, every number with its interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import torch
from tensordict import TensorDict

from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import (
    arm_of,
    decision_times,
    play_episodes,
    summarize,
)
from franka_wm.evaluation.tables import motion_table, outcome_table
from franka_wm.report.table import markdown
from franka_wm.seeding import derive_seed, seeded

EPISODES = 100
"""Episodes per policy, if not said otherwise."""

INTERVALS = (
    "95 % intervals: percentile bootstrap of the mean for distances, returns and motion "
    "(Efron 1979, 10,000 resamples of episodes), Wilson's score interval (1927) for rates of success."
)


def held_out_seeds(count: int) -> list[int]:
    """The seeds of the protocol: the same for every run, whatever seed it was trained with."""
    return [derive_seed("protocol", k) for k in range(count)]


@dataclass
class Evaluation:
    """What :func:`evaluate_agent` found.

    Attributes:
        policies: Name → summary, the content of ``evaluation.json``; the same twice on a CPU.
        episodes: Name → one row per episode, to compare policies pair by pair.
        seeds: Of the episodes.
        seconds: Name → median time of a decision for all worlds at once [s]; depends on the machine.
        worlds: How many that is.
    """

    policies: dict[str, dict[str, Any]]
    episodes: dict[str, TensorDict]
    seeds: list[int]
    seconds: dict[str, float] = field(default_factory=dict)
    worlds: int = 0

    def markdown(self) -> str:
        """The tables, and under them how they were measured."""
        tables = [outcome_table(self.policies), motion_table(self.policies)]
        parts = [markdown(table) for table in tables if table.rows]
        count = next(iter(self.policies.values()))["episodes"]
        seeds = ", ".join(map(str, self.seeds))
        worlds = f" of {self.worlds} worlds" if self.worlds else ""
        parts.append(
            f"{count} episodes per policy, the same for all, on held-out seeds ({seeds}){worlds}.\n{INTERVALS}\n"
        )
        return "\n".join(parts)


def evaluate_agent(
    agent: Any,
    *,
    episodes: int = EPISODES,
    seeds: Sequence[int] | None = None,
    policies: Mapping[str, Any] | None = None,
    timing: bool = True,
    report: Callable[[str, dict[str, Any]], None] | None = None,
) -> Evaluation:
    """Plays every policy over the same held-out episodes.

    Twice on a CPU gives the same numbers (times excepted): worlds, planners and random policies are seeded anew
    for each policy, and torch's random numbers are put back afterwards.

    Args:
        agent: Of :func:`franka_wm.training.load.load_agent`, or anything with ``env`` and ``policies``.
        episodes: Per policy, at least 2; published numbers should have 100 or more. Played in rounds of as
            many as ``agent.env`` has worlds; of the last round, the first worlds count.
        seeds: One for each round; :func:`held_out_seeds` if not given.
        policies: By name; the agent's, baselines included, if not given.
        timing: Also measure how long decisions take.
        report: Called with each name and summary as they come.

    Raises:
        UserError: Fewer than 2 episodes, or fewer seeds than rounds.
    """
    if isinstance(episodes, bool) or not isinstance(episodes, int) or episodes < 2:
        raise UserError(f"episodes={episodes!r}: must be a whole number of at least 2; 100 or more are usual")
    env = agent.env
    rounds = math.ceil(episodes / env.num_envs)
    seeds = held_out_seeds(rounds) if seeds is None else list(seeds)
    if len(seeds) < rounds:
        raise UserError(
            f"{episodes} episodes in {env.num_envs} worlds take {rounds} rounds, each with a seed of its own; "
            f"{len(seeds)} are given"
        )
    seeds = seeds[:rounds]
    evaluation = Evaluation({}, {}, seeds, worlds=env.num_envs)
    for name, policy in (agent.policies if policies is None else policies).items():
        played = []
        for seed in seeds:
            with seeded(seed, policy):
                played.append(play_episodes(env, policy, seed=seed).cpu())
        rows = cast(TensorDict, torch.cat(played)[:episodes])
        evaluation.episodes[name] = rows
        evaluation.policies[name] = summarize(rows)
        if timing:
            with seeded(seeds[0], policy):
                evaluation.seconds[name] = float(decision_times(env, policy, seed=seeds[0]).median())
        if report is not None:
            report(name, evaluation.policies[name])
    return evaluation


def describe(name: str, summary: Mapping[str, Any], env: Any) -> str:
    """One line about a policy as its numbers come."""
    if arm_of(env) is None:
        return f"  {name}: return {summary['return']['mean']:.2f}"
    return f"  {name}: final distance {100 * summary['final_distance']['mean']:.2f} cm"
