"""What holds for every planner of continuous actions."""

# pyright: reportArgumentType=false, reportCallIssue=false, reportOptionalMemberAccess=false
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import nn

from franka_wm.planning import CEM, ICEM, MPPI, GoalDistance, GradientPlanner
from franka_wm.seeding import drawing_for

ACTIONS, HORIZON = 2, 5

# Enough search to find the optimum of a small problem; half of them the classes' own defaults.
SETTINGS: dict[str, tuple[type, dict[str, Any]]] = {
    "mppi": (MPPI, {"num_samples": 256, "num_elites": 32, "min_std": 0.01, "iterations": 8}),
    "cem": (CEM, {"min_std": 0.01}),
    "icem": (ICEM, {"num_samples": 128, "iterations": 10, "decay": 1.1, "noise_beta": 1.0, "min_std": 0.01}),
    "gradient": (GradientPlanner, {"num_samples": 4, "lr": 0.05, "iterations": 50}),
    "gradient-tanh": (GradientPlanner, {"num_samples": 4, "iterations": 50, "bound": "tanh"}),
}
SAMPLING = ("mppi", "cem", "icem")


def make(name: str, **overrides: Any) -> Any:
    kind, settings = SETTINGS[name]
    return kind(**{"action_dim": ACTIONS, "horizon": HORIZON, **settings, **overrides})


every_planner = pytest.mark.parametrize("name", SETTINGS)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def push(z, a):
    """A point mass: a tenth of the action per step."""
    return z + 0.1 * a


def sequence(result):
    """The plan that the action is the first step of, (E, H, A)."""
    return result["best"] if "best" in result.keys() else result["plan"]  # noqa: SIM118


def score(objective, z, plan, next=push):
    """What the objective says of plans (E, H, A)."""
    latents = [z.unsqueeze(1)]
    for t in range(plan.shape[1]):
        latents.append(next(latents[-1], plan[:, None, t]))
    return objective(torch.stack(latents, 2), plan.unsqueeze(1)).squeeze(1)


class LQR:
    """z' = A z + B a; score = -Σ_{t<H} z_{t+1}ᵀ Q z_{t+1} + a_tᵀ R a_t. Optimal feedback by Riccati recursion."""

    def __init__(self) -> None:
        self.A = torch.tensor([[1.0, 0.1], [0.0, 1.0]])
        self.B = torch.tensor([[0.05, 0.0], [0.3, 0.4]])
        self.Q, self.R = torch.diag(torch.tensor([3.0, 1.0])), 0.2 * torch.eye(2)

    def next(self, z, a):
        return z @ self.A.T + a @ self.B.T

    def __call__(self, trajectory, actions):
        reached = trajectory[:, :, 1:]
        cost = torch.einsum("eshi,ij,eshj->es", reached, self.Q, reached)
        return -cost - torch.einsum("eshi,ij,eshj->es", actions, self.R, actions)

    def optimum(self, z):
        """The best plan (E, H, A)."""
        P, gains = torch.zeros(2, 2), []
        for _ in range(HORIZON):
            W = self.Q + P
            K = torch.linalg.solve(self.R + self.B.T @ W @ self.B, self.B.T @ W @ self.A)
            P = self.A.T @ W @ (self.A - self.B @ K)
            gains.append(K)
        plan = []
        for K in reversed(gains):
            plan.append(-z @ K.T)
            z = self.next(z, plan[-1])
        return torch.stack(plan, 1)


@every_planner
def test_finds_the_optimum_of_a_linear_quadratic_problem(name):
    problem = LQR()
    z = torch.tensor([[0.3, 0.1], [-0.2, 0.3], [0.1, -0.4], [0.4, -0.2], [0.0, 0.3]])
    optimum = problem.optimum(z)
    assert 0.2 < optimum.abs().amax() < 1.0  # the bounds do not matter, the actions do
    result = make(name).plan(z, problem.next, problem, generator=seeded())
    best = score(problem, z, optimum, problem.next)
    found = score(problem, z, sequence(result), problem.next)
    idle = score(problem, z, torch.zeros_like(optimum), problem.next)
    share, error = ((found - idle) / (best - idle)).min(), (result["action"] - optimum[:, 0]).abs()
    assert (found <= best + 1e-5).all()
    if name == "icem":  # the best of few candidates, not the mean of many
        assert share > 0.95 and error.max() < 0.25 and error.mean() < 0.07
    else:
        assert share > 0.99 and error.max() < 0.1 and error.mean() < 0.03


@every_planner
def test_the_value_is_the_score_of_what_was_found(name):
    z = torch.randn(4, 2)
    objective = GoalDistance(z + 0.2)
    result = make(name).plan(z, push, objective, generator=seeded())
    assert result["value"].shape == (4, 1)
    torch.testing.assert_close(
        result["value"].squeeze(1), score(objective, z, sequence(result)), atol=0.02, rtol=0.1
    )


@every_planner
def test_far_goals_are_approached_at_full_speed_and_bounds_hold(name):
    z, goal = torch.zeros(3, 2), torch.tensor([[5.0, -5.0]]).expand(3, 2)
    planner = make(name, low=0.2, high=0.7)  # the middle, where a search starts, is not 0
    for explore in (False, True):
        result = planner.plan(z, push, GoalDistance(goal), explore=explore, generator=seeded())
        for entry in (result["action"], result["plan"], sequence(result)):
            assert entry.min() >= 0.2 and entry.max() <= 0.7
    shown = []  # nor is anything beyond them asked of the model, whatever a policy says

    def score(trajectory, actions):
        shown.append(actions.detach())
        return GoalDistance(goal)(trajectory, actions)

    guided = make(name, low=0.2, high=0.7, num_policy_samples=3)
    guided.plan(z, push, score, prior=lambda z: torch.full_like(z, 9.0), generator=seeded())
    assert all(actions.min() >= 0.2 and actions.max() <= 0.7 for actions in shown) and shown
    assert (shown[0] > 0.69).all((-2, -1)).any()  # the policy was asked
    plan = sequence(planner.plan(z, push, GoalDistance(goal), generator=seeded()))
    assert (plan[..., 0] > 0.6).float().mean() > 0.9 and (plan[..., 1] < 0.3).float().mean() > 0.9


@every_planner
def test_environments_do_not_influence_each_other(name):
    z, goal = torch.randn(4, 2), torch.randn(4, 2)
    moved_z, moved_goal = z.clone(), goal.clone()
    moved_z[3], moved_goal[3] = 100.0, torch.nan
    a = make(name).plan(z, push, GoalDistance(goal), generator=seeded())
    b = make(name).plan(moved_z, push, GoalDistance(moved_goal), generator=seeded())
    assert torch.equal(a["plan"][:3], b["plan"][:3])
    assert torch.equal(a["action"][:3], b["action"][:3])
    assert not torch.equal(a["plan"][3], b["plan"][3])


@every_planner
def test_equal_seeds_give_equal_plans(name):
    z, objective = torch.randn(2, 2), GoalDistance(torch.zeros(2))
    a, b, other = (
        make(name).plan(z, push, objective, explore=True, generator=seeded(s))["action"] for s in (1, 1, 2)
    )
    assert torch.equal(a, b) and not torch.equal(a, other)


@every_planner
def test_exploration_adds_noise_to_the_action_but_not_to_the_plan(name):
    z = torch.randn(64, 2)
    noise = {"explore_std": 0.2} if "gradient" in name else {"min_std": 0.2}
    planner, objective = make(name, **noise), GoalDistance(z)
    quiet = planner.plan(z, push, objective, generator=seeded())
    noisy = planner.plan(z, push, objective, explore=True, generator=seeded())
    assert torch.equal(quiet["action"], sequence(quiet)[:, 0])
    assert torch.equal(quiet["plan"], noisy["plan"])
    assert 0.1 < (noisy["action"] - sequence(noisy)[:, 0]).std() < 0.3


@every_planner
def test_a_warm_start_helps_and_is_dropped_where_an_episode_begins(name):
    """Decisions of a search that is too short to solve the problem from nothing."""
    planner = make(name, iterations=2)
    z, objective = torch.randn(32, 2), GoalDistance(torch.zeros(2))
    result = planner.plan(z, push, objective, generator=seeded())
    for k in range(6):
        z = push(z, result["action"])
        before = result["plan"]
        result = planner.plan(z, push, objective, previous=before, generator=seeded(k))
    cold = planner.plan(z, push, objective, generator=seeded(5))
    assert result["value"].mean() > cold["value"].mean()

    half = (torch.arange(32) % 2 == 0).unsqueeze(1)
    rubbish = torch.where(half[..., None, None] if before.dim() == 4 else half[..., None], torch.nan, before)
    mixed = planner.plan(z, push, objective, previous=rubbish, is_init=half, generator=seeded(5))
    assert torch.equal(mixed["plan"][0::2], cold["plan"][0::2])
    assert torch.equal(mixed["plan"][1::2], result["plan"][1::2])


@every_planner
def test_wrong_shapes_are_named(name):
    planner, z, objective = make(name), torch.zeros(2, 2), GoalDistance(torch.zeros(2))
    plan = planner.plan(z, push, objective)["plan"]
    with pytest.raises(ValueError, match="previous"):
        planner.plan(z, push, objective, previous=plan[..., :-1, :])
    with pytest.raises(ValueError, match="is_init"):
        planner.plan(z, push, objective, previous=plan, is_init=torch.ones(2, dtype=torch.bool))


@every_planner
@pytest.mark.parametrize("fraction", [0.05, 0.5, 1.0])
def test_scores_that_are_not_finite_never_win(name, fraction):
    z, goal = torch.zeros(3, 2), torch.full((2,), 0.3)

    def objective(trajectory, actions):
        scores = GoalDistance(goal)(trajectory, actions) - 10  # negative: nan read as 0 would be the best
        candidate = torch.arange(scores.shape[1])
        bad = candidate < fraction * scores.shape[1]
        return torch.where(bad, torch.tensor([torch.nan, torch.inf])[candidate % 2], scores)

    planner = make(name)
    result = planner.plan(z, push, objective, generator=seeded())
    again = planner.plan(z, push, objective, previous=result["plan"], generator=seeded())
    for one in (result, again):
        assert all(torch.isfinite(value).all() for value in one.values())
    if fraction < 1:
        assert (sequence(again)[:, 0] > 0.9).all()
        reached = sequence(again).cumsum(1)[:, 2] * 0.1
        assert (reached - 0.3).abs().max() < 0.1


@every_planner
def test_a_model_that_blows_up_is_avoided(name):
    """Latents overflow where the first action component is positive: to nan, not to a bad score."""

    def next(z, a):
        return push(z, a) * torch.where(a[..., :1] > 0.0, torch.nan, 1.0)

    z, goal = torch.zeros(4, 2), torch.tensor([0.5, 0.5])
    result = make(name).plan(z, next, GoalDistance(goal), generator=seeded())
    assert all(torch.isfinite(value).all() for value in result.values())
    assert torch.isfinite(score(GoalDistance(goal), z, sequence(result), next)).all()
    if name in SAMPLING:  # where there is no gradient, the other cannot get on
        assert sequence(result)[..., 1].mean() > 0.5


@every_planner
def test_a_good_prior_is_used_and_a_failing_one_does_no_harm(name):
    """One narrow peak among long plans: the search does not find it, the policy knows it."""
    target = torch.full((8, 4), 0.77)

    def objective(trajectory, actions):
        return (-(actions - target).square().sum((-2, -1)) / 0.05).exp()

    def found(prior, guided):
        few = {} if "gradient" in name else {"num_elites": 4}
        planner = make(name, action_dim=4, horizon=8, num_policy_samples=guided, **few)
        z = torch.zeros(2, 4)
        return planner.plan(z, push, objective, prior=prior, generator=seeded())["value"]

    def knows(z):
        return torch.full_like(z, 0.75)

    assert found(knows, 3).min() > 0.3
    assert found(None, 3).max() < 0.1
    assert found(knows, 0).max() < 0.1  # it is not asked
    assert torch.isfinite(found(lambda z: torch.full_like(z, torch.nan), 3)).all()


class Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(0.1 * torch.eye(2))

    def forward(self, z, a):
        return z + a @ self.weight


@every_planner
@pytest.mark.parametrize("grad_mode", [True, False])
def test_planning_leaves_no_gradient_behind(name, grad_mode):
    net, scale = Net(), nn.Parameter(torch.ones(2))
    scale.grad = torch.full((2,), 7.0)
    with torch.set_grad_enabled(grad_mode):
        z = torch.randn(2, 2) * scale  # hangs on a graph in grad mode
        result = make(name).plan(z, net, GoalDistance(scale), generator=seeded(), explore=True)
        assert torch.is_grad_enabled() is grad_mode
    assert net.weight.grad is None and scale.grad.tolist() == [7.0, 7.0]
    assert net.weight.requires_grad
    assert not any(value.requires_grad for value in result.values())


@pytest.mark.parametrize("name", SAMPLING)
def test_planning_has_no_graph_breaks(name):
    planner, objective = make(name, num_policy_samples=2), GoalDistance(torch.zeros(2))

    def plan(z, previous, is_init):
        options = {"previous": previous, "is_init": is_init, "prior": torch.tanh, "explore": True}
        return planner.plan(z, push, objective, **options)["action"]

    z = torch.randn(3, 2)
    previous = planner.plan(z, push, objective)["plan"]
    inputs = z, previous, torch.tensor([[True], [False], [False]])
    torch.manual_seed(0)
    expected = plan(*inputs)
    torch.manual_seed(0)
    torch._dynamo.reset()  # else the sizes of another planner's test count as changing ones
    compiled = torch.compile(plan, backend="eager", fullgraph=True, dynamic=False)
    torch.testing.assert_close(compiled(*inputs), expected)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@every_planner
def test_planning_can_be_captured_as_a_cuda_graph(name):
    """So there is no host synchronisation in it; replays draw fresh noise and see new inputs."""
    planner, net = make(name), Net().cuda()
    z = torch.randn(8, 2, device="cuda")
    objective = GoalDistance(torch.zeros(2, device="cuda"))
    is_init = torch.zeros(8, 1, dtype=torch.bool, device="cuda")
    previous = planner.plan(z, net, objective)["plan"]

    def plan():
        return planner.plan(z, net, objective, previous=previous, is_init=is_init)

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            plan()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = plan()
    z.copy_(torch.full((8, 2), 3.0))
    is_init.fill_(True)
    graph.replay()
    assert (sequence(result)[:, 0] < -0.5).all()


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("cem", {"horizon": 0}),
        ("cem", {"num_elites": 301}),
        ("cem", {"num_policy_samples": 300}),
        ("cem", {"momentum": 1.0}),
        ("cem", {"min_std": 2.0}),
        ("cem", {"std": 0.0, "min_std": 0.0}),
        ("cem", {"low": 1.0}),
        ("icem", {"noise_beta": -1.0}),
        ("icem", {"noise_beta": 10.5}),  # far beyond, no noise is left
        ("icem", {"reuse": 1.1}),
        ("icem", {"decay": 0.9}),
        ("icem", {"num_elites": 129}),
        ("icem", {"num_policy_samples": -1}),
        ("icem", {"momentum": -0.1}),
        ("icem", {"min_std": -0.1}),
        ("gradient", {"lr": 0.0}),
        ("gradient", {"betas": (0.9, 1.0)}),
        ("gradient", {"std": -1.0}),
        ("gradient", {"bound": "sigmoid"}),
        ("gradient", {"num_samples": 0}),
        ("gradient", {"num_policy_samples": 4}),
        ("gradient", {"iterations": 0}),
    ],
)
def test_settings_that_cannot_work_are_refused(name, bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        make(name, **bad)


@every_planner
def test_worlds_plan_alike_however_they_are_divided(name):
    """Two decisions of worlds 3 and 4 of five, alone and among the others."""
    planner, start = make(name, num_samples=64, iterations=2), torch.randn(5, ACTIONS)

    def decided(z):
        torch.manual_seed(1)
        objective, previous, found = GoalDistance(torch.zeros(ACTIONS)), None, []
        for first in (True, False):
            is_init = torch.full((len(z), 1), first)
            result = planner.plan(z, push, objective, previous=previous, is_init=is_init, explore=False)
            previous = result["plan"]
            found.append(result["action"])
        return torch.stack(found, 1)

    together = decided(start)
    with drawing_for(3, 2, 5):
        apart = decided(start[3:])
    torch.testing.assert_close(apart, together[3:], rtol=0, atol=1e-6)
    assert not torch.allclose(decided(start[3:]), apart, rtol=0, atol=1e-6)  # other draws are seen


@pytest.mark.parametrize("name", SAMPLING)
def test_the_policys_candidates_ask_the_model_for_no_more_than_they_read(name: str) -> None:
    """The latent after the last action is the search's to ask for."""
    planner, asked = make(name, num_policy_samples=2), []

    def after(z: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        asked.append(action)
        return z

    query = SimpleNamespace(z=torch.zeros(1, 2), prior=lambda z: z, next=after)
    (found,) = planner.guided(query)
    assert found.shape[2] == planner.horizon == len(asked) + 1


@every_planner
@pytest.mark.parametrize("wrong", ["(2, 64, 5)", "(2,)", "long"])
def test_scores_of_another_shape_are_named(name: str, wrong: str) -> None:
    def objective(trajectory: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        scores = actions.sum(-1)
        return {"(2,)": scores.sum((1, 2)), "long": scores.sum(-1).long()}.get(wrong, scores)

    with pytest.raises(ValueError, match=r"an objective returns scores \(E, S\) = \(2, \d+\), floats; got "):
        make(name).plan(torch.zeros(2, ACTIONS), push, objective)
