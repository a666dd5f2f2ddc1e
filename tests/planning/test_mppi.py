# pyright: reportArgumentType=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false, reportOptionalOperand=false
import pytest
import torch

from franka_wm.planning import MPPI, GoalDistance, RewardPlusValue


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def step(z, a):
    """A point that goes where it is told."""
    return z + a


def planner(**overrides) -> MPPI:
    return MPPI(
        **{**dict(action_dim=2, horizon=3, num_samples=256, num_elites=32, min_std=0.01), **overrides}
    )


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def rollout(z, plan):
    states = [z]
    for t in range(plan.shape[1]):
        states.append(step(states[-1], plan[:, t]))
    return torch.stack(states, 1)


@pytest.mark.parametrize(
    "bad",
    [
        dict(horizon=0),
        dict(num_elites=300),
        dict(num_policy_samples=300),
        dict(min_std=0.0),
        dict(min_std=3.0),
        dict(temperature=0.0),
        dict(low=1.0, high=1.0),
        dict(iterations=0),
    ],
)
def test_settings_that_cannot_work_are_refused(bad):
    with pytest.raises(ValueError):
        planner(**bad)


def test_the_defaults_are_the_published_ones():
    """Those of TD-MPC2's code."""
    own = MPPI(action_dim=2)
    assert (own.horizon, own.iterations, own.num_samples) == (3, 6, 512)
    assert (own.num_elites, own.num_policy_samples) == (64, 24)
    assert (own.min_std, own.max_std, own.temperature) == (0.05, 2.0, 0.5)


def test_every_environment_reaches_its_own_goal():
    z = torch.randn(5, 2)
    goal = z + 0.9 * (torch.rand(5, 2) * 2 - 1)  # one step away
    result = planner().plan(z, step, GoalDistance(goal), generator=seeded())
    reached = rollout(z, result["plan"])[:, 1:]
    assert (reached - goal[:, None]).norm(dim=-1).max() < 0.15
    assert result["value"].shape == (5, 1) and (result["value"] > -0.1).all()


def test_far_goals_are_approached_at_full_speed_and_bounds_hold():
    z, goal = torch.zeros(3, 2), torch.tensor([[50.0, -50.0]]).expand(3, 2)
    result = planner(low=-0.5, high=0.5).plan(z, step, GoalDistance(goal), explore=True, generator=seeded())
    for key in ("action", "plan"):
        assert result[key].abs().max() <= 0.5
    assert (result["plan"][..., 0] > 0.4).all() and (result["plan"][..., 1] < -0.4).all()


def test_environments_do_not_influence_each_other():
    z, goal = torch.randn(4, 2), torch.randn(4, 2)
    moved_z, moved_goal = z.clone(), goal.clone()
    moved_z[3], moved_goal[3] = 100.0, -7.0
    a = planner().plan(z, step, GoalDistance(goal), generator=seeded())
    b = planner().plan(moved_z, step, GoalDistance(moved_goal), generator=seeded())
    assert torch.equal(a["plan"][:3], b["plan"][:3])
    assert not torch.equal(a["plan"][3], b["plan"][3])


def test_equal_seeds_give_equal_plans():
    z, objective = torch.randn(2, 2), GoalDistance(torch.zeros(2))
    plans = [planner().plan(z, step, objective, explore=True, generator=seeded(s)) for s in (1, 1, 2)]
    assert torch.equal(plans[0]["action"], plans[1]["action"])
    assert not torch.equal(plans[0]["action"], plans[2]["action"])


def test_exploration_adds_noise_to_the_action_but_not_to_the_plan():
    z, objective = torch.randn(64, 2), GoalDistance(torch.zeros(2))
    quiet = planner(min_std=0.2).plan(z, step, objective, generator=seeded())
    noisy = planner(min_std=0.2).plan(z, step, objective, explore=True, generator=seeded())
    assert torch.equal(quiet["action"], quiet["plan"][:, 0])
    assert torch.equal(quiet["plan"], noisy["plan"])
    assert (noisy["action"] - noisy["plan"][:, 0]).std() > 0.05


class _Spy:
    """Indifferent objective that keeps the first candidates it is shown."""

    def __init__(self):
        self.actions = None

    def __call__(self, trajectory, actions):
        self.actions = actions if self.actions is None else self.actions
        return torch.zeros(actions.shape[:2])


def test_exploration_has_the_deviation_of_the_action_that_is_done():
    """Here only the first action matters: the plan is sure of it, and not of those after it."""
    z = torch.zeros(256, 2)
    search = planner(num_samples=64, num_elites=8, temperature=0.01)
    result = search.plan(
        z, step, lambda trajectory, a: -a[:, :, 0].square().sum(-1), explore=True, generator=seeded()
    )
    assert result["std"][:, 1:].mean() > 10 * result["std"][:, 0].mean()
    noise = (result["action"] - result["plan"][:, 0]) / result["std"][:, 0]
    assert 0.8 < noise.std() < 1.2


def test_the_warm_start_is_shifted_and_cleared_where_an_episode_begins():
    previous = torch.tensor([[0.1, 0.1], [0.5, -0.5], [0.9, -0.9]]).expand(2, 3, 2)
    is_init, spy = torch.tensor([[False], [True]]), _Spy()
    narrow = planner(min_std=1e-4, max_std=1e-4, iterations=1)
    narrow.plan(torch.zeros(2, 2), step, spy, previous=previous, is_init=is_init, generator=seeded())
    start = spy.actions.mean(1)
    expected = torch.tensor([[[0.5, -0.5], [0.9, -0.9], [0.0, 0.0]], [[0.0, 0.0]] * 3])
    torch.testing.assert_close(start, expected, atol=1e-3, rtol=0)
    spy = _Spy()
    narrow.plan(torch.zeros(2, 2), step, spy, generator=seeded())
    assert spy.actions.abs().max() < 1e-3
    with pytest.raises(ValueError, match="previous"):
        narrow.plan(torch.zeros(2, 2), step, spy, previous=previous[:, :2])
    with pytest.raises(ValueError, match="is_init"):
        narrow.plan(torch.zeros(2, 2), step, spy, previous=previous, is_init=torch.ones(2, dtype=torch.bool))


def test_the_cold_start_is_the_middle_of_the_bounds():
    spy = _Spy()
    planner(low=0.0, high=4.0, min_std=1e-4, max_std=1e-4).plan(torch.zeros(1, 2), step, spy)
    assert (spy.actions - 2.0).abs().max() < 0.01


def test_candidates_of_the_prior_are_rolled_out_through_the_model():
    spy, z = _Spy(), torch.tensor([[0.8, -0.4], [0.2, 0.0]])
    planner(num_policy_samples=5).plan(z, step, spy, prior=lambda z: -0.5 * z)
    expected = torch.stack([-0.5 * z, -0.25 * z, -0.125 * z], 1)
    torch.testing.assert_close(spy.actions[:, :5], expected[:, None].expand(-1, 5, -1, -1))
    assert not torch.isclose(spy.actions[:, 5:], expected[:, None]).all(-1).any()
    assert spy.actions.shape == (2, 256, 3, 2)


def test_a_good_prior_is_used():
    """One narrow target among long plans: random candidates do not find it, the policy knows it."""
    target = torch.full((8, 4), 0.77)

    def objective(trajectory, actions):
        return ((actions - target).abs().amax((-2, -1)) < 0.1).float()

    def scarce(prior):
        search = MPPI(action_dim=4, horizon=8, num_samples=64, num_policy_samples=4, num_elites=8)
        return search.plan(torch.zeros(2, 4), step, objective, prior=prior, generator=seeded())

    assert scarce(lambda z: torch.full_like(z, 0.77))["value"].min() > 0.3
    assert scarce(None)["value"].max() < 0.01


@pytest.mark.parametrize("fraction", [0.01, 0.5, 1.0])
def test_scores_that_are_not_finite_cannot_poison_the_plan(fraction):
    z, goal = torch.zeros(3, 2), torch.full((3, 2), 0.6)

    def objective(trajectory, actions):
        scores = GoalDistance(goal)(trajectory, actions) - 10  # negative: nan read as 0 would be the best
        bad = torch.arange(scores.shape[1]) < fraction * scores.shape[1]
        return torch.where(
            bad, torch.tensor([torch.nan, torch.inf])[torch.arange(scores.shape[1]) % 2], scores
        )

    result = planner().plan(z, step, objective, generator=seeded())
    assert all(torch.isfinite(value).all() for value in result.values())
    if fraction < 1:
        assert (result["plan"][:, 0] - 0.6).abs().max() < 0.2


def test_a_prior_that_fails_cannot_poison_the_plan():
    z, goal = torch.zeros(2, 2), torch.full((2,), 0.6)
    prior = lambda z: torch.full_like(z, torch.nan)  # noqa: E731
    result = planner().plan(z, step, GoalDistance(goal), prior=prior, generator=seeded())
    assert (result["plan"][:, 0] - 0.6).abs().max() < 0.2
    everyone = planner(num_elites=256)  # now the failed candidates are among the elites, at weight zero
    result = everyone.plan(z, step, GoalDistance(goal), prior=prior, generator=seeded())
    assert all(torch.isfinite(value).all() for value in result.values())


@pytest.mark.parametrize("offset", [1e5, -1e11])
def test_what_is_added_to_all_scores_does_not_matter(offset):
    """Also where it is below what stands for a candidate without a score."""

    def plan(offset):
        def objective(trajectory, actions):
            scores = offset + 60 * GoalDistance(torch.zeros(2))(trajectory, actions)
            return torch.where(torch.arange(scores.shape[1]) % 2 == 0, torch.nan, scores)

        search, z = planner(normalize=False, num_elites=256), torch.ones(2, 2, dtype=torch.float64)
        return search.plan(0.4 * z, step, objective, generator=seeded())["plan"]

    torch.testing.assert_close(plan(offset), plan(0.0), atol=1e-3, rtol=0)


def test_temperature_acts_on_normalised_scores_and_weighs_a_healthy_number_of_elites():
    z, goal = 0.3 * torch.randn(6, 2), torch.zeros(2)

    def effective(scale: float, temperature: float = 0.5, normalize: bool = True) -> torch.Tensor:
        def objective(trajectory, actions):
            return scale * GoalDistance(goal)(trajectory, actions) + 3 * scale

        search = MPPI(action_dim=2, temperature=temperature, normalize=normalize)
        return search.plan(z, step, objective, generator=seeded())["effective_samples"]

    usual = effective(1.0)
    assert usual.shape == (6, 1)
    assert (usual > 8).all() and (usual < 62).all()  # of 64 elites, of 512 samples
    torch.testing.assert_close(effective(1000.0), usual, rtol=0.02, atol=0.5)  # whatever unit the reward has
    torch.testing.assert_close(effective(0.01), usual, rtol=0.02, atol=0.5)
    assert (effective(1.0, temperature=3.0) < 0.5 * usual).all()
    assert effective(0.001, normalize=False).min() > 63.9  # what the normalisation is for


def test_standard_deviation_stays_within_its_bounds():
    z = torch.randn(3, 2)
    search = planner(min_std=0.3, max_std=0.4, iterations=8)
    std = search.plan(z, step, GoalDistance(torch.zeros(2)), generator=seeded())["std"]
    assert std.min() >= 0.3 and std.max() <= 0.4


def test_the_score_of_a_rollout_is_rewards_plus_the_value_of_the_last_latent():
    objective = RewardPlusValue(lambda z, a: a.sum(-1, keepdim=True), lambda z: 10 * z[..., :1], 0.5)
    actions = torch.tensor([1.0, 2.0, 4.0]).view(1, 1, 3, 1)
    trajectory = torch.tensor([100.0, 101.0, 103.0, 107.0]).view(1, 1, 4, 1)
    torch.testing.assert_close(objective(trajectory, actions), torch.tensor([[1 + 1 + 1 + 0.125 * 1070]]))


def test_the_terminal_value_depends_on_the_last_action():
    """Only the value matters and only the last step can reach it: the last action must still be chosen."""
    objective = RewardPlusValue(
        lambda z, a: torch.zeros(*a.shape[:-1], 1), lambda z: -(z - 2.7).square().sum(-1, keepdim=True), 0.9
    )
    plan = planner().plan(torch.zeros(2, 2), step, objective, generator=seeded())["plan"]
    torch.testing.assert_close(plan.sum(1), torch.full((2, 2), 2.7), atol=0.15, rtol=0)
    assert (plan[:, -1] > 0.6).all()


def test_goal_distance_sums_or_takes_the_end():
    trajectory = torch.tensor([9.0, 1.0, 2.0]).view(1, 1, 3, 1)
    actions = torch.zeros(1, 1, 2, 1)
    assert GoalDistance(torch.zeros(1))(trajectory, actions).item() == -5.0
    assert GoalDistance(torch.zeros(1, 1), summed=False)(trajectory, actions).item() == -4.0
    with pytest.raises(ValueError, match="goal_latent"):
        GoalDistance(torch.zeros(1, 1, 1))


def test_planning_records_no_gradient_and_has_no_graph_breaks():
    weight = torch.eye(2, requires_grad=True)
    search, objective = planner(), GoalDistance(torch.zeros(2))

    def plan(z, previous, is_init):
        def move(z, a):
            return z + a @ weight

        return search.plan(z, move, objective, previous=previous, is_init=is_init, explore=True)["action"]

    inputs = torch.randn(2, 2), torch.zeros(2, 3, 2), torch.zeros(2, 1, dtype=torch.bool)
    torch.manual_seed(0)
    expected = plan(*inputs)
    assert not expected.requires_grad
    torch.manual_seed(0)
    torch.testing.assert_close(torch.compile(plan, backend="eager", fullgraph=True)(*inputs), expected)
