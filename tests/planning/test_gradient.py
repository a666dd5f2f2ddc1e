# pyright: reportOptionalMemberAccess=false
import pytest
import torch

from franka_wm.planning import GoalDistance, GradientPlanner


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def push(z, a):
    return z + 0.1 * a


def two_hills(trajectory, actions):
    """A low hill at -0.4, a high one at 0.6, and little slope between them."""
    first = actions[..., 0, 0]
    return (-((first + 0.4) / 0.15).square()).exp() + 3 * (-((first - 0.6) / 0.15).square()).exp()


def test_several_starts_find_the_higher_hill():
    near = torch.full((16, 2, 1), -0.3)

    def found(starts):
        planner = GradientPlanner(action_dim=1, horizon=2, num_samples=starts, std=1.0, iterations=40)
        previous = torch.cat((near, near), 1)[:, :2]  # on the lower hill
        return planner.plan(torch.zeros(16, 1), push, two_hills, previous=previous, generator=seeded())

    alone, many = found(1), found(24)
    torch.testing.assert_close(alone["action"], torch.full((16, 1), -0.4), atol=0.05, rtol=0)
    torch.testing.assert_close(many["action"], torch.full((16, 1), 0.6), atol=0.05, rtol=0)
    torch.testing.assert_close(many["value"], torch.full((16, 1), 3.0), atol=0.05, rtol=0)


@pytest.mark.parametrize("lr", [0.1, 1.9])
def test_the_result_is_never_worse_than_the_warm_start(lr):
    """The best plan there is to start from, and steps that lead away from it."""
    z, goal = torch.zeros(8, 2), torch.full((2,), 0.05)
    plan = torch.zeros(8, 5, 2)
    plan[:, 1] = 0.5  # shifted by one step: straight to the goal, then stay
    planner = GradientPlanner(action_dim=2, lr=lr, iterations=3)
    result = planner.plan(z, push, GoalDistance(goal), previous=plan, generator=seeded())
    assert result["value"].min() > -1e-10
    assert torch.equal(result["plan"][:, 0], torch.full((8, 2), 0.5))


def test_clamp_reaches_the_bounds_and_tanh_nearly():
    z, goal = torch.zeros(2, 2), torch.full((2,), 9.0)
    for bound, least in (("clamp", 1.0), ("tanh", 0.9)):
        planner = GradientPlanner(action_dim=2, bound=bound, iterations=30)
        assert planner.plan(z, push, GoalDistance(goal), generator=seeded())["plan"].min() >= least


def test_a_start_at_the_bound_can_leave_it_with_tanh():
    previous = torch.ones(2, 5, 2)
    planner = GradientPlanner(action_dim=2, bound="tanh", num_samples=1, iterations=60)
    goal = GoalDistance(torch.full((2,), -9.0))
    assert planner.plan(torch.zeros(2, 2), push, goal, previous=previous)["plan"][:, :4].max() < 0.0


def test_steps_do_not_depend_on_the_unit_of_the_score():
    z = torch.randn(4, 2, generator=seeded())
    plans = [
        GradientPlanner(action_dim=2).plan(
            z, push, lambda t, a, scale=scale: scale * GoalDistance(torch.zeros(2))(t, a), generator=seeded()
        )["plan"]
        for scale in (1.0, 1e4)
    ]
    torch.testing.assert_close(*plans, atol=1e-3, rtol=0)


def test_a_gradient_that_is_not_finite_moves_nothing():
    def objective(trajectory, actions):
        # Finite score, infinite slope: at exactly 0, where the search starts.
        return -actions[..., :1, 0].abs().sqrt().sum(-1) + GoalDistance(torch.ones(2))(trajectory, actions)

    planner = GradientPlanner(action_dim=2, num_samples=1)
    plan = planner.plan(torch.zeros(3, 2), push, objective)["plan"]
    assert torch.isfinite(plan).all()
    assert (plan[:, 0, 0] == 0).all() and (plan[:, :, 1] > 0.9).all()


@pytest.mark.parametrize(
    "objective",
    [
        lambda t, a: torch.zeros(a.shape[:2]),
        lambda t, a: a.detach().sum((-2, -1)),
        lambda t, a: (a > 0).sum((-2, -1)).float(),
    ],
)
def test_an_objective_without_gradient_is_named(objective):
    with pytest.raises(ValueError, match="differentiated"):
        GradientPlanner(action_dim=2).plan(torch.zeros(1, 2), push, objective)


def test_a_model_without_gradient_is_named():
    frozen = torch.no_grad()(push)
    weight = torch.ones(2, requires_grad=True)  # the scores do have a gradient, but not by the actions
    with pytest.raises(ValueError, match="sampling planner"):
        GradientPlanner(action_dim=2).plan(
            torch.zeros(1, 2), frozen, lambda t, a: (t[:, :, -1] * weight).sum(-1)
        )
