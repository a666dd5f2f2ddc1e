"""The same evaluation for every family: fixed held-out episodes, all policies, every number with its interval."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from franka_wm import console, processes
from franka_wm.envs import Environment, MultiTaskEnv
from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import (
    THRESHOLDS,
    decision_times,
    play_episodes,
    success_distance,
    summarize,
)
from franka_wm.evaluation.intervals import percent
from franka_wm.evaluation.results import END, FILE, point, to_json
from franka_wm.files import atomic_write
from franka_wm.options import is_whole
from franka_wm.seeding import derive_seed, drawing_for, seeded
from franka_wm.training.settings import EvaluationSettings, RunSettings
from franka_wm.version import __version__
from franka_wm.versions import hardware

if TYPE_CHECKING:
    from franka_wm.training.load import Agent

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
    """What :func:`evaluate_policies` found.

    Attributes:
        policies: Name → summary, the content of ``evaluation.json``; the same twice on a CPU.
        episodes: Name → one row per episode, to compare policies pair by pair.
        seeds: Seeds of the episodes.
        seconds: Name → median time of a decision for all worlds at once [s]; depends on the machine.
        worlds: How many that is.
        protocol: How it was measured, of a run: what :func:`protocol` says.
    """

    policies: dict[str, dict[str, Any]]
    episodes: dict[str, TensorDict]
    seeds: list[int]
    seconds: dict[str, float] = field(default_factory=dict)
    worlds: int = 0
    protocol: dict[str, Any] = field(default_factory=dict)


def evaluate_agent(
    agent: Agent,
    *,
    episodes: int = EPISODES,
    policies: Mapping[str, TensorDictModuleBase] | None = None,
    timing: bool = True,
    **options: Any,
) -> Evaluation:
    """:func:`evaluate_policies` of an agent of :func:`franka_wm.training.load.load_agent`, with its own policies."""
    chosen = agent.policies if policies is None else policies
    return evaluate_policies(agent.env, chosen, episodes=episodes, timing=timing, **options)


def evaluate_policies(
    env: Environment,
    policies: Mapping[str, TensorDictModuleBase],
    *,
    episodes: int | None = None,
    seeds: Sequence[int] | None = None,
    timing: bool = False,
    together: int | None = None,
    report: Callable[[str, dict[str, Any]], object] | None = None,
) -> Evaluation:
    """Plays every policy over the same held-out episodes: while training, at its end, and in ``franka-wm evaluate``.

    Twice on a CPU gives the same numbers (times excepted), whoever asks: worlds, planners and random policies are
    seeded anew for each policy, and models are in evaluation mode. Random numbers and modes are put back afterwards.

    Args:
        env: Evaluation worlds.
        policies: By name.
        episodes: Per policy, at least 2; published numbers should have 100 or more. Played in rounds of as
            many as the environment has worlds; of the last round, the first worlds count. One round if not given.
        seeds: One for each round; :func:`held_out_seeds` if not given.
        timing: Also measure how long decisions take.
        together: Worlds of all processes of the job, each of which calls this: they divide the episodes of each
            round, and each of them gets all rows. Not given: this process plays alone.
        report: Called with each name and summary as they come.

    Raises:
        UserError: Fewer than 2 episodes, or fewer seeds than rounds.
    """
    worlds = env.num_envs if together is None else together
    episodes = worlds if episodes is None else episodes
    if not is_whole(episodes) or episodes < 2:
        raise UserError(
            f"episodes={episodes!r}: must be a whole number of at least 2, for the intervals; 100 or more are usual"
        )
    rounds = math.ceil(episodes / worlds)
    seeds = held_out_seeds(rounds) if seeds is None else list(seeds)
    if len(seeds) < rounds:
        raise UserError(
            f"{episodes} episodes in {worlds} worlds take {rounds} rounds, each with a seed of its own; "
            f"{len(seeds)} are given"
        )
    seeds = seeds[:rounds]
    evaluation = Evaluation({}, {}, seeds, worlds=worlds)
    for name, policy in policies.items():
        played = []
        for k, seed in enumerate(seeds):
            left = min(episodes - k * worlds, worlds)
            with seeded(seed, policy):
                played += (
                    _play(env, policy, seed, left) if together is None else _divided(env, policy, seed, left)
                )
        rows = cast(TensorDict, torch.cat(played))
        evaluation.episodes[name] = rows
        evaluation.policies[name] = summarize(rows, thresholds=thresholds(env))
        if cut := evaluation.policies[name].get("cut_short"):
            console.say(warn_of_cut(name, cut, episodes))
        if timing:
            with seeded(seeds[0], policy):
                evaluation.seconds[name] = float(decision_times(env, policy, seed=seeds[0]).median())
        if report is not None:
            report(name, evaluation.policies[name])
    return evaluation


def warn_of_cut(name: str, cut: int, episodes: int) -> str:
    """A line about a policy of whose episodes the simulator cut some short."""
    return (
        f"  warning: {name}: the simulator cut {cut} of {episodes} episodes short, none of which counts as a success: "
        "not finite any more, or too little room for contacts (env.max_contacts)"
    )


def _play(env: Environment, policy: TensorDictModuleBase, seed: int, episodes: int) -> list[TensorDict]:
    return [play_episodes(env, policy, seed=seed, episodes=episodes).cpu()]


def _divided(env: Environment, policy: TensorDictModuleBase, seed: int, episodes: int) -> list[TensorDict]:
    """What each process has played of the episodes, in their order; every process calls this.

    An episode begins and draws as it would if one process played them all.
    """
    first, count = processes.own_part(episodes, len(env.envs) if isinstance(env, MultiTaskEnv) else 1)
    own = None
    if count:
        with drawing_for(first, count, episodes):
            own = play_episodes(env, policy, seed=seed, episodes=count, first_world=first).cpu()
    return [rows for rows in processes.objects(own) if rows is not None]


def all_worlds(settings: EvaluationSettings, env: Environment) -> int:
    """Evaluation worlds of all processes of a run together."""
    return env.num_envs if processes.count() == 1 else settings.episodes


def protocol(
    settings: RunSettings, env: Environment, evaluation: Evaluation, *, by: str, counters: Mapping[str, float]
) -> dict[str, Any]:
    """How it was measured, for whoever reads the numbers later: ``protocol`` of ``evaluation.json``.

    Args:
        settings: Settings of the run.
        env: Evaluation worlds.
        evaluation: What was found.
        by: Who measured: :data:`~franka_wm.evaluation.results.END` or :data:`~franka_wm.evaluation.results.COMMAND`.
        counters: Counters of the training: ``updates``, ``env_steps``, ``seconds``.
    """
    distance = success_distance(env)
    return {
        "by": by,
        "task": settings.env.label,
        "model": settings.model.name,
        **({"planner": settings.planner.label} if "planner" in evaluation.policies else {}),
        "seed": settings.seed,
        **{name: counters[name] for name in ("updates", "env_steps") if name in counters},
        **({"training_seconds": counters["seconds"]} if "seconds" in counters else {}),
        "episodes": next(iter(evaluation.policies.values()))["episodes"],
        "worlds": evaluation.worlds,
        "seeds": ", ".join(map(str, evaluation.seeds)),
        **({} if distance is None else {"success_distance": float(distance)}),
        "intervals": INTERVALS,
        "device": str(env.device),
        "hardware": hardware(env.device),
        "franka_wm": __version__,
        "torch": torch.__version__,
    }


def thresholds(env: Environment) -> list[float]:
    """Distances that count as success [m]: those of every table, and the task's own; none where it judges otherwise."""
    distance = success_distance(env)
    return [] if distance is None else sorted({*THRESHOLDS, float(distance)}, reverse=True)


def numbers_to_log(
    env: Environment,
    policies: Mapping[str, TensorDictModuleBase],
    *,
    episodes: int | None = None,
    together: int | None = None,
) -> dict[str, float]:
    """A point of the learning curves: what :func:`evaluate_policies` finds now, as :func:`point` names it.

    Args:
        env: Evaluation worlds, those of the run's end.
        policies: That have curves.
        episodes: The first so many of those that the run's end plays; all if not given or more than there are.
        together: As for :func:`evaluate_policies`.
    """
    worlds = env.num_envs if together is None else together
    episodes = worlds if episodes is None else min(episodes, worlds)
    found = evaluate_policies(env, policies, episodes=episodes, together=together).policies
    return point(found, success_distance=success_distance(env))


def describe(name: str, summary: Mapping[str, Any]) -> str:
    """One line about a policy as its numbers come."""
    success = summary.get("success") or {}
    own = f"success {percent(100 * success['mean'])} %, " if "mean" in success else ""
    if "final_distance" in summary:
        return f"  {name}: {own}final distance {100 * summary['final_distance']['mean']:.2f} cm"
    return f"  {name}: {own}return {summary['return']['mean']:.2f}"


def during_training(
    settings: EvaluationSettings, env: Environment | None, policies: Mapping[str, TensorDictModuleBase]
) -> Callable[[], dict[str, float]]:
    """A function for the trainer: plays the policies of ``evaluation.during`` and returns numbers to log.

    None where there are none, as without an environment. Of several processes all call it; they divide the episodes.
    """
    chosen = {name: policies[name] for name in settings.during if name in policies}
    if env is not None and settings.during and not chosen:
        there = ", ".join(policies) or "none"
        nothing = f"evaluation.during=[{','.join(settings.during)}]: no such policy acts here, of those there: {there}"
        console.say(f"{nothing}; nothing is evaluated while training")
    if env is None or not chosen:
        return dict
    worlds = all_worlds(settings, env)
    return lambda: numbers_to_log(env, chosen, episodes=settings.during_episodes, together=worlds)


def evaluate_run(
    settings: RunSettings,
    folder: Path,
    env: Environment,
    policies: Mapping[str, TensorDictModuleBase],
    *,
    counters: Mapping[str, float],
    say: Callable[[str], object] = console.say,
) -> Evaluation:
    """The end of a run: every policy over the same held-out episodes, and ``evaluation.json`` in the run's folder.

    Of several processes all call it: they divide the episodes, and the first one writes.

    Args:
        settings: Settings of the run.
        folder: Folder of the run.
        env: Evaluation worlds, of several processes this one's; as many episodes.
        policies: By name.
        counters: ``updates``, ``env_steps``, ``seconds`` of the training.
        say: Takes lines for the terminal.
    """
    worlds = all_worlds(settings.evaluation, env)
    say(f"evaluating over {worlds} held-out episodes …")
    begun = time.perf_counter()

    def report(name: str, summary: Mapping[str, Any]) -> None:
        nonlocal begun
        before, begun = begun, time.perf_counter()
        say(f"{describe(name, summary)}   ({begun - before:.1f} s)")

    found = evaluate_policies(env, policies, together=worlds, report=report)
    found.protocol = protocol(settings, env, found, by=END, counters=counters)
    if processes.is_first():
        with atomic_write(folder / FILE) as path:
            path.write_text(to_json({"protocol": found.protocol, "policies": found.policies}))
    return found
