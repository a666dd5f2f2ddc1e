import pytest
import torch

from franka_wm.planning import CEM, ICEM
from franka_wm.planning.icem import coloured_noise


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def still(z, a):
    return z


class Spy:
    """Scores candidates by the sum of their actions, and keeps all it is shown."""

    def __init__(self) -> None:
        self.seen: list[torch.Tensor] = []

    def __call__(self, trajectory, actions):
        self.seen.append(actions.clone())
        return actions.sum((-2, -1))


# ---------------------------------------------------------------------- noise


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("length", [64, 65])
def test_the_noise_has_the_power_spectrum_asked_for(exponent, length):
    noise = coloured_noise((20000, length), exponent, generator=seeded(), dtype=torch.float64)
    power = torch.fft.rfft(noise).abs().square().mean(0)
    k = torch.arange(power.shape[0], dtype=torch.float64)
    expected = k.clamp(min=1) ** -exponent  # frequency 0 as the lowest other one
    torch.testing.assert_close(power / power[1], expected, rtol=0.08, atol=0.0)


@pytest.mark.parametrize("length", [1, 2, 5, 30])
@pytest.mark.parametrize("exponent", [0.0, 3.0])
def test_the_noise_has_unit_variance_at_every_step(length, exponent):
    noise = coloured_noise((20000, length), exponent, generator=seeded())
    assert noise.dtype == torch.float32 and noise.shape == (20000, length)
    torch.testing.assert_close(noise.var(0), torch.ones(length), rtol=0.06, atol=0.0)
    assert noise.mean(0).abs().max() < 0.03


def test_series_are_independent_of_each_other_and_white_noise_of_time():
    noise = coloured_noise((20000, 3, 6), 0.0, generator=seeded())
    torch.testing.assert_close(noise.flatten(1).T.cov(), torch.eye(18), atol=0.04, rtol=0.0)
    coloured = coloured_noise((20000, 2, 6), 3.0, generator=seeded())
    covariance = coloured.flatten(1).T.cov()
    assert covariance[:6, 6:].abs().max() < 0.04
    assert covariance[0, 1] > 0.5  # neighbours in time go together


def test_candidates_are_coloured_along_time_only():
    spy = Spy()
    search = ICEM(action_dim=2, horizon=6, num_samples=8000, iterations=1, std=0.1, noise_beta=3.0)
    search.plan(torch.zeros(1, 2), still, spy, generator=seeded())
    drawn = spy.seen[0][0, :8000]
    assert drawn.std() == pytest.approx(0.1, rel=0.03)
    neighbours = torch.corrcoef(drawn[:, 2:4, 0].T)[0, 1]
    components = torch.corrcoef(drawn[:, 2].T)[0, 1]
    assert neighbours > 0.5 and components.abs() < 0.05


def test_coloured_noise_finds_far_places_that_white_noise_does_not():
    """A long walk to one side: the same search with white candidates gets less far (the paper's argument)."""

    def far(beta):
        search = ICEM(action_dim=3, num_samples=40, iterations=1, noise_beta=beta)
        result = search.plan(
            torch.zeros(64, 3), lambda z, a: z + a, lambda t, a: t[:, :, -1].norm(dim=-1), generator=seeded()
        )
        return result["value"].mean()

    assert far(2.0) > 2.0 * far(0.0)


# ---------------------------------------------------------------------- population and elites


def test_the_published_numbers_are_the_defaults():
    search = ICEM(action_dim=7)
    assert search.population() == [40, 32, 25] and search.num_kept == 3 and search.horizon == 30


def test_the_population_shrinks_to_twice_the_elites_and_the_elites_join_it():
    spy = Spy()
    search = ICEM(action_dim=2, horizon=3, num_samples=40, num_elites=10, iterations=6, decay=1.5)
    assert search.population() == [40, 26, 20, 20, 20, 20]
    search.plan(torch.zeros(2, 2), still, spy, generator=seeded())
    counts = [seen.shape[1] for seen in spy.seen]
    assert counts == [43, 29, 23, 23, 23, 24]  # 3 elites (at first: fresh draws) more; at last the mean
    tops = []
    for before, after in zip(spy.seen, spy.seen[1:], strict=False):
        order = before.sum((-2, -1)).topk(3, dim=1).indices
        expected = before.gather(1, order[..., None, None].expand(-1, -1, 3, 2))
        assert torch.equal(after[:, :3], expected)
        tops.append(after.sum((-2, -1)).amax(1))
    assert (torch.stack(tops).diff(dim=0) >= 0).all()  # so the best never gets worse


def test_the_mean_is_a_candidate_of_the_last_round():
    spy = Spy()
    search = ICEM(action_dim=2, horizon=3, iterations=2, momentum=0.2)
    search.plan(torch.zeros(2, 2), still, spy, generator=seeded())
    first = spy.seen[0]
    order = first.sum((-2, -1)).topk(10, dim=1).indices
    elites = first.gather(1, order[..., None, None].expand(-1, -1, 3, 2))
    torch.testing.assert_close(spy.seen[1][:, -1], 0.8 * elites.mean(1))


def test_the_action_is_that_of_the_best_candidate():
    spy = Spy()
    result = ICEM(action_dim=2, horizon=3).plan(torch.zeros(4, 2), still, spy, generator=seeded())
    scores = torch.cat([seen.sum((-2, -1)) for seen in spy.seen], 1)
    winner = torch.cat(spy.seen, 1)[torch.arange(4), scores.argmax(1)]  # of all rounds
    assert torch.equal(result["best"], winner)
    assert torch.equal(result["action"], winner[:, 0])
    assert torch.equal(result["value"], scores.amax(1, keepdim=True))
    assert not torch.equal(result["action"], result["plan"][:, 0, 0])  # which is the mean


def test_mean_and_elites_are_carried_in_the_plan_and_shifted():
    search = ICEM(action_dim=2, horizon=3, std=1e-3, min_std=1e-3)
    previous = torch.rand(2, 4, 3, 2) - 0.5
    is_init = torch.tensor([[False], [True]])
    spy = Spy()
    search.plan(torch.zeros(2, 2), still, spy, previous=previous, is_init=is_init, generator=seeded())
    first = spy.seen[0]
    assert torch.equal(first[0, :3, :2], previous[0, 1:, 1:])  # elites one step on
    assert (first[0, :3, 2] - previous[0, 0, 2]).abs().max() < 0.01  # their last action is drawn,
    assert (first[0, :3, 2] - previous[0, 0, 2]).abs().min() > 0.0
    centre = torch.stack((previous[0, 0, 1], previous[0, 0, 2], previous[0, 0, 2]))  # around the mean,
    assert (first[0, 3:] - centre).abs().max() < 0.01  # whose last action is repeated
    assert first[1].abs().max() < 0.01 and first[1].abs().min() > 0  # a new episode: draws only


def test_what_it_returns_as_plan_is_what_it_takes_as_previous():
    search, spy = ICEM(action_dim=2, horizon=4, num_elites=8, reuse=0.5), Spy()
    first = search.plan(torch.zeros(3, 2), still, spy, generator=seeded())
    assert first["plan"].shape == (3, 5, 4, 2)
    torch.testing.assert_close(first["plan"][:, 1], first["best"])
    last = spy.seen[-1]
    order = last.sum((-2, -1)).topk(4, dim=1).indices
    expected = last.gather(1, order[..., None, None].expand(-1, -1, 4, 2))
    assert torch.equal(first["plan"][:, 1:], expected)
    spy = Spy()
    search.plan(torch.zeros(3, 2), still, spy, previous=first["plan"], generator=seeded(1))
    assert torch.equal(spy.seen[0][:, :4, :3], first["plan"][:, 1:, 1:])
    with pytest.raises(ValueError, match=r"1 \+ R"):
        search.plan(torch.zeros(3, 2), still, spy, previous=first["best"])


@pytest.mark.parametrize(
    ("reuse", "elites", "kept"), [(0.29, 100, 29), (0.57, 100, 57), (0.3, 4, 1), (1.0, 7, 7)]
)
def test_rounding_costs_no_elite(reuse, elites, kept):
    assert ICEM(action_dim=1, num_samples=200, num_elites=elites, reuse=reuse).num_kept == kept


def test_without_reuse_nothing_but_the_mean_is_carried():
    search = ICEM(action_dim=2, horizon=4, reuse=0.0)
    plan = search.plan(torch.zeros(3, 2), still, Spy())["plan"]
    assert plan.shape == (3, 1, 4, 2)
    assert search.plan(torch.zeros(3, 2), still, Spy(), previous=plan)["plan"].shape == plan.shape


def test_if_no_score_is_finite_the_mean_acts():
    search = ICEM(action_dim=2, horizon=3)
    previous = torch.full((2, 4, 3, 2), 0.4)
    result = search.plan(
        torch.zeros(2, 2), still, lambda t, a: torch.full(a.shape[:2], torch.nan), previous=previous
    )
    torch.testing.assert_close(result["action"], torch.full((2, 2), 0.4))


def test_with_few_candidates_it_beats_the_plain_method():
    """The paper's claim, on a chain of integrators over a long horizon, with the same number of rollouts."""

    def next(z, a):
        position, velocity = z.chunk(2, -1)
        velocity = 0.9 * velocity + 0.1 * a
        return torch.cat((position + 0.1 * velocity, velocity), -1)

    def objective(trajectory, actions):
        return -(trajectory[:, :, 1:, :3] - 1.0).square().sum((-2, -1))

    def score(planner, steps=10):
        z, plan, total = torch.zeros(32, 6), None, 0.0
        for k in range(steps):
            result = planner.plan(z, next, objective, previous=plan, generator=seeded(k))
            z, plan = next(z, result["action"]), result["plan"]
            total = total - (z[:, :3] - 1.0).square().sum(-1).mean()
        return total

    rollouts = sum(ICEM(action_dim=3).population())
    plain = CEM(action_dim=3, horizon=30, num_samples=rollouts // 3, num_elites=10, iterations=3, std=0.5)
    assert score(ICEM(action_dim=3)) > score(plain) + 0.1
