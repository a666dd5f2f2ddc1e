"""What breaks when the world is not quite the one of training: looks, camera, dynamics, delay, noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tensordict import TensorDictBase
from torch import Tensor

from franka_wm.envs.transformed import arm_of
from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import play_episodes, success_distance
from franka_wm.evaluation.intervals import bootstrap_mean, wilson
from franka_wm.evaluation.protocol import held_out_seeds
from franka_wm.seeding import seeded

if TYPE_CHECKING:
    from franka_wm.training.load import Agent

UNSHIFTED = "as trained"

WORKS_AT = 0.05
"""Distance [m] within which episodes must end, unshifted, for a policy to count as working at all …"""

WORKS_SHARE = 0.1
"""… and in what share of them at least."""

LEAST_DISTANCE = 0.005
"""By how much the final distance must grow on average [m] for a shift to make anything *worse* …"""

LEAST_SUCCESS = 0.02
"""… or by how much the rate of success must fall."""

ENOUGH_EPISODES = 20
"""With fewer, :func:`note` warns."""


@dataclass(frozen=True)
class Shift:
    """A world that is drawn from wider ranges than that of training.

    Attributes:
        randomization: Fields of :class:`~franka_wm.envs.config.Randomization`.
        looks: Whether it changes images alone: without images nothing of it is seen.
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
"""Name → what is drawn anew in every episode, besides what the run itself randomised."""


def robustness(
    agent: Agent,
    *,
    episodes: int = 100,
    shifts: Mapping[str, Shift] = SHIFTS,
    policies: Sequence[str] | None = None,
    report: Callable[[str, Mapping[str, Any]], None] | None = None,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Plays the same held-out episodes again in shifted worlds.

    Poses and goals depend on the seed alone, so every episode is compared with itself in the unshifted world, which
    has the same solver where a shift needs another.

    Args:
        agent: Agent of :func:`franka_wm.training.load.load_agent`; of the arm.
        episodes: Worlds, at least 2.
        shifts: By name; those that change images alone are left out for models that read none.
        policies: Names; if not given, the planner (or the policy where there is none), and ``ik`` and ``expert``,
            which show what the shift leaves possible.
        report: Called with each shift's name and results as they come.

    Returns:
        Shift → policy → ``final_distance`` [m] and ``success`` at the end, as the task judges, with 95 % intervals
        (bootstrap, Wilson); ``change`` of the final distance [m], paired by episode, with its bootstrap interval
        (``None`` for :data:`UNSHIFTED`); ``verdict``, of :func:`verdict` (empty for :data:`UNSHIFTED`); where there
        are any, how many episodes the simulator ``cut_short`` in either world, which are no successes. Of tasks whose
        success is no distance: ``return`` and ``return_change`` instead of the distances.

    Raises:
        UserError: Not the arm, fewer than 2 episodes, or no such policy.
    """
    from franka_wm.training import build

    check_shiftable(agent)
    if episodes < 2:
        raise UserError(f"episodes={episodes}: must be at least 2")
    names = _chosen(agent.policies) if policies is None else list(policies)
    for name in names:
        if name not in agent.policies:
            raise UserError(f"robustness: no policy {name!r}; here are {', '.join(agent.policies)}")
    seen = bool(agent.model.image_sizes)
    cases = {UNSHIFTED: Shift({})} | {name: s for name, s in shifts.items() if seen or not s.looks}
    own = agent.settings.values["env"]["randomization"]
    seed = held_out_seeds(1)[0]

    def play(env: Any, policy: Any) -> TensorDictBase:
        with seeded(seed, policy):
            return play_episodes(env, policy, seed=seed).cpu()

    results: dict[str, dict[str, dict[str, Any]]] = {}
    before: dict[str, TensorDictBase] = {}
    for case, shift in cases.items():
        env = build.make_evaluation_env(
            agent.settings, num_envs=episodes, randomization=widened(own, shift.randomization), **shift.env
        )
        plain = None
        if shift.env:  # the solver's own effect is none of the shift's
            plain = build.make_evaluation_env(agent.settings, num_envs=episodes, **shift.env)
        results[case] = {}
        for name in names:
            policy = agent.policies[name]
            played = play(env, policy)
            before.setdefault(name, played)
            then = before[name] if plain is None else play(plain, policy)
            results[case][name] = _compared(played, then, success_distance(env))
        if report is not None:
            report(case, results[case])
    return results


def widened(own: Mapping[str, Any], shift: Mapping[str, float]) -> dict[str, Any]:
    """What a run randomised, and a shift besides: of each field the wider range, so that no shift narrows one."""
    return {**own, **{name: max(value, own.get(name) or 0) for name, value in shift.items()}}


def check_shiftable(agent: Agent) -> None:
    """Whether the agent's worlds can be shifted.

    Raises:
        UserError: Not the arm, or a solver that cannot randomise.
    """
    arm = arm_of(agent.env)
    if arm is None:
        raise UserError(
            "robustness=true: only the arm can be shifted, in one task; this run's environment is another"
        )
    if arm.config.solver == "featherstone":
        raise UserError("robustness=true: shifts need env.solver=mujoco; this run has featherstone")


def note(episodes: int) -> str:
    """What to say about verdicts from so few episodes; empty where there are enough."""
    if episodes >= ENOUGH_EPISODES:
        return ""
    return (
        f"only {episodes} episodes in each shifted world: verdicts need at least {ENOUGH_EPISODES}, "
        f"better 100; a real change may go unseen"
    )


def verdict(played: TensorDictBase, before: TensorDictBase) -> str:
    """What a shift does to a policy, in a word or two.

    Args:
        played: (E,) episodes in the shifted world, as `play_episodes` gives them, with ``final_distance`` [m].
        before: The same episodes in the world of training.

    Returns:
        ``never worked``: unshifted, less than :data:`WORKS_SHARE` of the episodes end within :data:`WORKS_AT`, so
        there is nothing that a shift could break. ``worse``: the mean final distance grows by more than
        :data:`LEAST_DISTANCE`, or the rate of success falls by more than :data:`LEAST_SUCCESS`, and the 95 %
        interval of that change, paired by episode, leaves out 0. ``breaks``: worse, and less than half of the
        unshifted successes are left. ``holds``: none of these was seen.
    """
    unshifted = before.get("final_distance")
    grown = bootstrap_mean(played.get("final_distance") - unshifted)
    return verdict_of_success(
        played.get("success").bool(),
        before.get("success").bool(),
        works=(unshifted < WORKS_AT) & ~_cut(before),
        further=grown.low > 0 and grown.mean > LEAST_DISTANCE,
    )


def _cut(played: TensorDictBase) -> Tensor:
    """(E,) bool: the simulator cut it short."""
    return played.get("cut_short").bool()


def verdict_of_success(
    now: Tensor, before: Tensor, *, works: Tensor | None = None, further: bool = False
) -> str:
    """:func:`verdict` for tasks whose success is no distance: by the rate of success alone.

    Args:
        now, before: (E,) bool, success of the same episodes in the shifted world and in that of training.
        works: (E,) bool, episodes in which the unshifted policy counts as working; ``before`` if not given.
        further: Something else is worse.
    """
    if float((before if works is None else works).double().mean()) < WORKS_SHARE:
        return "never worked"
    lost = bootstrap_mean(before.double() - now.double())
    rarer = lost.low > 0 and lost.mean > LEAST_SUCCESS
    if not (further or rarer):
        return "holds"
    return "breaks" if 2 * int(now.sum()) < int(before.sum()) else "worse"


def _chosen(policies: Mapping[str, object]) -> list[str]:
    own = [name for name in ("planner", "policy") if name in policies][:1]
    return own + [name for name in ("ik", "expert") if name in policies]


def _compared(played: TensorDictBase, before: TensorDictBase, near: float | None) -> dict[str, object]:
    what, change = ("return", "return_change") if near is None else ("final_distance", "change")
    value, unshifted = played.get(what), before.get(what)
    now, then = played.get("success").bool(), before.get("success").bool()
    told = verdict_of_success(now, then) if near is None else verdict(played, before)
    same, cut = played is before, int((_cut(played) | _cut(before)).sum())
    return {
        what: bootstrap_mean(value).as_dict(),
        "success": wilson(int(now.sum()), now.numel()).as_dict(),
        change: None if same else bootstrap_mean(value - unshifted).as_dict(),
        "verdict": "" if same else told,
        **({"cut_short": cut} if cut else {}),
    }
