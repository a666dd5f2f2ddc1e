"""A planner of one's own is held against what `Planner` promises."""

from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch
from tensordict import TensorDict

from franka_wm.errors import UserError
from franka_wm.planning import CEM, ICEM, MPPI, GradientPlanner, registry
from franka_wm.planning.base import ContinuousPlanner
from franka_wm.planning.check import check_planner

SIZES = {"action_dim": 3, "horizon": 4, "num_samples": 8, "iterations": 2}


class Middle:
    """Scores one candidate of zeros, and takes it."""

    def __init__(self, *, action_dim: int, width: int | None = None, entry: str = "plan", drop: bool = False):
        self.action_dim, self.width, self.entry, self.drop = action_dim, width or action_dim, entry, drop

    def plan(
        self, z, next, objective, *, prior=None, previous=None, is_init=None, explore=False, generator=None
    ):
        actions = 0.0 * torch.rand(len(z), 1, 2, self.action_dim)  # drawn, but not from the generator
        latents = [z.unsqueeze(1)]
        for t in range(2):
            latents.append(next(latents[-1], actions[:, :, t]))
        objective(torch.stack(latents, 2), actions)
        plan = z.new_zeros(len(z), 2, self.width)
        return TensorDict(
            {"action": plan[:, 0], self.entry: plan[:, self.drop and previous is not None :]},
            batch_size=[len(z)],
        )


class Answers(Middle):
    """Answers something else."""

    answer: Any = None

    def plan(self, z, next, objective, **others):
        return self.answer


class Flat(Middle):
    """Forgets the candidates."""

    def plan(self, z, next, objective, **others):
        objective(z.unsqueeze(1).unsqueeze(1), z.new_zeros(len(z), 2, self.action_dim))


class Short(Middle):
    """Shows a trajectory without its first latent."""

    def plan(self, z, next, objective, **others):
        objective(z.unsqueeze(1).unsqueeze(1), z.new_zeros(len(z), 1, 1, self.action_dim))


class Fails(Middle):
    def plan(self, z, next, objective, *, previous=None, **others):
        if previous is not None:
            raise KeyError("no memory")
        return super().plan(z, next, objective)


@pytest.mark.parametrize(
    "planner",
    [
        MPPI(**SIZES, num_elites=2, num_policy_samples=2),
        CEM(**SIZES, num_elites=2),
        ICEM(**SIZES, num_elites=2),
        GradientPlanner(**SIZES),
        Middle(action_dim=3),
    ],
    ids=lambda planner: type(planner).__name__,
)
def test_planners_that_do_what_they_promise_pass(planner):
    state = torch.get_rng_state()
    check_planner(planner, action_dim=3)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize(
    ("planner", "says"),
    [
        (Middle(action_dim=3, width=2), r"planner Middle: action must be \(E, A\) = \(2, 3\), not \(2, 2\)"),
        (Middle(action_dim=3, entry="plans"), r"must return a TensorDict with action and plan, not \['action', 'p"),
        (Answers(action_dim=3), "must return a TensorDict with action and plan, not NoneType"),
        (Middle(action_dim=3, drop=True), r"plan must be \(E, H, A\) = \(2, 2, 3\), not \(2, 1, 3\)"),
        (Flat(action_dim=3), r"candidates must be \(E, S, H, A\) = \(2, any, any, 3\), not \(2, 2, 3\)"),
        (Short(action_dim=3), r"trajectories of latents must be \(E, S, H\+1, D\) = \(2, 1, 2, 4\), not \(2, 1, 1, 4"),
        (Fails(action_dim=3), r"planner Fails: plan fails: KeyError: 'no memory' \(.*test_check.py, line \d+\)"),
    ],
)  # fmt: skip
def test_what_a_planner_does_otherwise_is_told_in_one_line(planner, says):
    with pytest.raises(UserError, match=says):
        check_planner(planner, action_dim=3)


@pytest.mark.parametrize("entry", ["action", "plan"])
def test_what_is_not_finite_is_no_plan(entry):
    class Odd(Middle):
        def plan(self, z, next, objective, *, previous=None, **others):
            found = super().plan(z, next, objective).clone()  # the action lies in the plan's memory
            found[entry][-1, ..., 0] = float("nan" if previous is None else "inf")
            return found

    with pytest.raises(
        UserError, match=rf"planner Odd: {entry} is not finite \(NaN or inf\); it must be in \[−1, 1\]"
    ):
        check_planner(Odd(action_dim=3), action_dim=3)


@pytest.fixture
def registered(monkeypatch):
    monkeypatch.setattr(registry, "_REGISTERED", {})


def test_a_planner_of_ones_own_is_tried_when_it_is_made(registered):
    registry.register("middle", Middle)
    assert registry.make("middle", action_dim=3).action_dim == 3
    with pytest.raises(UserError, match="planner middle: action must be"):
        registry.make("middle", action_dim=3, width=2)


def test_the_planner_that_is_used_was_not_asked_before(registered):
    class Remembers(Middle):
        seen = 0

        def plan(self, z, next, objective, **others):
            self.seen += 1
            return super().plan(z, next, objective, **others)

    registry.register("remembers", Remembers)
    assert registry.make("remembers", action_dim=3).seen == 0


def test_numbers_are_wanted():
    class Whole(Middle):
        def plan(self, z, next, objective, **others):
            found = super().plan(z, next, objective, **others)
            return found.set("action", found["action"].long())

    with pytest.raises(
        UserError, match=r"planner Whole: action must be numbers in a tensor, not torch.int64"
    ):
        check_planner(Whole(action_dim=3), action_dim=3)


def test_what_cannot_plan_is_not_registered(registered):
    class Keywords(Middle):
        def plan(self, z, next, objective):
            return None

    registry.register("function", lambda **given: Middle(**given))  # what makes one is looked at when it has
    for name, cls, search, says in (
        ("mppi", Middle, False, "'mppi', ….: the package has this name; choose another"),
        ("none", type("None_", (), {}), False, "None_.: has no plan; see docs/planning.md"),
        ("tree", Middle, True, "Middle.: has no search"),
        (
            "words",
            Keywords,
            False,
            "plan must take z, next, objective, and by keyword prior, previous, is_init",
        ),
    ):
        with pytest.raises(UserError, match=says):
            registry.register(name, cls, search=search)
    assert set(registry._REGISTERED) == {"function"}


def test_a_continuous_planner_says_what_it_lacks(registered):
    class Idle(ContinuousPlanner):
        pass

    class Undecorated(ContinuousPlanner):
        spread: float = 0.5
        names: ClassVar = ()

        def search(self, query):
            return query

    @dataclass(kw_only=True, eq=False)
    class Own(Idle):
        spread: float = 0.5

        def search(self, query):
            return query

    for cls, says in (
        (
            Undecorated,
            r"Undecorated\): write @dataclass\(kw_only=True, eq=False\) .* without it spread cannot be set",
        ),
        (Idle, r"Idle\): must define search\(query\), which plans; see docs/planning.md"),
    ):
        with pytest.raises(UserError, match=says):
            registry.register("own", cls)
    registry.register("own", Own)
    registry.register("child", type("Child", (Own,), {}))  # no fields of its own: nothing is missing


def test_an_unknown_planner_may_be_of_ones_own():
    with pytest.raises(ValueError, match=r"got 'hill'; one of your own: plugins=\[MODULE\]"):
        registry.make("hill")
