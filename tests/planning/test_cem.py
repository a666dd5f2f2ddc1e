# pyright: reportOptionalMemberAccess=false
import pytest
import torch

from franka_wm.planning import CEM
from franka_wm.planning.sampling import best, refit


class Spy:
    """Scores candidates by the sum of their actions, and keeps all it is shown."""

    def __init__(self) -> None:
        self.seen: list[torch.Tensor] = []

    def __call__(self, trajectory, actions):
        self.seen.append(actions.clone())
        return actions.sum((-2, -1))


def still(z, a):
    return z


def plan(previous=None, seed=0, **settings):
    spy = Spy()
    search = CEM(**{"action_dim": 2, "horizon": 3, "num_samples": 40, "num_elites": 8, **settings})
    generator = torch.Generator().manual_seed(seed)
    return spy, search.plan(torch.zeros(2, 4), still, spy, previous=previous, generator=generator)


def test_the_published_numbers_are_the_defaults():
    search = CEM(action_dim=7)
    assert (search.num_samples, search.iterations, search.num_elites, search.horizon) == (300, 10, 30, 5)


@pytest.mark.parametrize("momentum", [0.0, 0.4])
def test_each_round_is_drawn_from_the_elites_of_the_last(momentum):
    spy, result = plan(iterations=3, momentum=momentum, min_std=0.1)
    assert [seen.shape[1] for seen in spy.seen] == [40] * 3
    mean, std = torch.zeros(2, 3, 2), torch.ones(2, 3, 2)
    for seen in spy.seen:
        torch.testing.assert_close(seen[:, 0], mean)  # the mean itself is a candidate
        for env in range(2):
            order = seen[env].sum((-2, -1)).argsort(descending=True)[:8]
            elites = seen[env][order]
            mean[env] = momentum * mean[env] + (1 - momentum) * elites.mean(0)
            std[env] = momentum * std[env] + (1 - momentum) * elites.std(0, correction=0)
        std = std.clamp(min=0.1)
    torch.testing.assert_close(result["plan"], mean)
    torch.testing.assert_close(result["std"], std)
    last = spy.seen[-1].sum((-2, -1)).topk(8, dim=1).values.mean(1, keepdim=True)
    torch.testing.assert_close(result["value"], last)


def test_draws_have_the_standard_deviation_asked_for():
    spy, _ = plan(iterations=1, num_samples=4000, std=0.2)
    assert spy.seen[0][:, 1:].std() == pytest.approx(0.2, rel=0.03)


def test_one_round_with_one_elite_is_random_shooting():
    spy, result = plan(iterations=1, num_elites=1)
    winner = spy.seen[0].sum((-2, -1)).argmax(1)
    assert torch.equal(result["plan"], spy.seen[0][torch.arange(2), winner])


def test_a_good_plan_to_start_from_is_not_forgotten():
    """No draw hits a narrow peak, but the plan of the last decision is on it."""
    previous = torch.full((2, 3, 2), 0.6)
    peak = previous.clone()
    peak[:, -1] = 0.0  # what comes into sight starts in the middle

    def objective(trajectory, actions):
        return (-(actions - peak[:, None]).abs().amax((-2, -1)) / 1e-3).exp()

    search = CEM(action_dim=2, horizon=3, num_samples=50, num_elites=1, iterations=3)
    result = search.plan(torch.zeros(2, 4), still, objective, previous=previous)
    assert result["value"].min() > 0.99


def test_the_best_are_those_with_the_highest_finite_scores():
    nan, inf = torch.nan, torch.inf
    scores = torch.tensor([[1.0, nan, 3.0, inf, 2.0], [nan, nan, -5.0, -inf, nan], [nan] * 5])
    elites = best(scores, 2)
    assert elites.which[0].tolist() == [2, 4] and elites.valid[0].all()
    assert elites.which[1, 0] == 2 and elites.valid[1].tolist() == [True, False]
    assert elites.scores[1].tolist() == [-5.0, -5.0] and not elites.valid[2].any()
    assert elites.mean_score().flatten().tolist() == [2.5, -5.0, 0.0]


def test_what_is_not_valid_weighs_nothing_in_the_refit():
    elites = torch.tensor([1.0, 3.0, 100.0]).view(1, 3, 1, 1).expand(2, 3, 1, 1)
    valid = torch.tensor([[True, True, False], [False, False, False]])
    old = torch.full((2, 1, 1), 0.5)
    mean, std = refit(elites, valid, old, old, momentum=0.0)
    assert mean.flatten().tolist() == [2.0, 0.5] and std.flatten().tolist() == [1.0, 0.5]
    mean, std = refit(elites, valid, old, old, momentum=0.5)
    assert mean.flatten().tolist() == [1.25, 0.5] and std.flatten().tolist() == [0.75, 0.5]
