"""Probes: against closed forms, scikit-learn, and latents whose content is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sklearn.linear_model import Ridge
from sklearn.metrics import r2_score
from sklearn.neighbors import KNeighborsRegressor

from franka_wm.evaluation.probes import (
    nearest_neighbours,
    probe,
    r_squared,
    ridge,
    ridge_probe,
    split_by_episode,
)


@pytest.fixture
def data() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(80, 6, generator=generator) + 2
    y = x @ torch.randn(6, 3, generator=generator) + 0.5 * torch.randn(80, 3, generator=generator) - 1
    return x, y


@pytest.mark.parametrize("alpha", [0.0, 0.3, 50.0])
def test_ridge_is_the_closed_form(data, alpha: float) -> None:
    """With the offset as a column of ones whose weight is not penalised."""
    x, y = (v.double() for v in data)
    ones = torch.cat((x, torch.ones(80, 1, dtype=torch.float64)), 1)
    penalty = alpha * torch.eye(7, dtype=torch.float64)
    penalty[6, 6] = 0
    expected = torch.linalg.inv(ones.mT @ ones + penalty) @ ones.mT @ y
    weights, offset = ridge(*data, alpha)
    torch.testing.assert_close(torch.cat((weights, offset[None])), expected)


@pytest.mark.parametrize("alpha", [0.1, 10.0])
def test_ridge_is_that_of_scikit_learn(data, alpha: float) -> None:
    x, y = (v.double().numpy() for v in data)
    theirs = Ridge(alpha=alpha).fit(x, y)
    weights, offset = ridge(*data, alpha)
    np.testing.assert_allclose(weights.numpy().T, theirs.coef_, rtol=1e-8)
    np.testing.assert_allclose(offset.numpy(), theirs.intercept_, rtol=1e-8)


@pytest.mark.parametrize("k", [1, 5, 60])
def test_neighbours_are_those_of_scikit_learn(data, k: int) -> None:
    x, y = (v.double() for v in data)
    theirs = KNeighborsRegressor(n_neighbors=k).fit(x[:60].numpy(), y[:60].numpy()).predict(x[60:].numpy())
    np.testing.assert_allclose(nearest_neighbours(x[:60], y[:60], x[60:], k).numpy(), theirs)


def test_neighbours_cannot_be_more_than_there_are(data) -> None:
    with pytest.raises(ValueError, match="k=61"):
        nearest_neighbours(data[0][:60], data[1][:60], data[0], 61)


def test_a_point_that_is_not_a_number_has_no_neighbours(data) -> None:
    x, y = data
    lost = x[60:].clone()
    lost[1, 0] = torch.nan
    found, whole = nearest_neighbours(x[:60], y[:60], lost), nearest_neighbours(x[:60], y[:60], x[60:])
    assert found[1].isnan().all()
    torch.testing.assert_close(found[[0, 2]], whole[[0, 2]])


def test_r_squared_is_that_of_scikit_learn(data) -> None:
    y = data[1].double()
    guess = y + torch.randn(80, 3, generator=torch.Generator().manual_seed(1))
    assert r_squared(y, guess) == pytest.approx(r2_score(y.numpy(), guess.numpy()))
    assert r_squared(y, y.mean(0).expand_as(y)) == pytest.approx(0.0)


def test_r_squared_of_what_does_not_vary() -> None:
    fixed = torch.full((10, 2), 0.3)
    assert r_squared(fixed, fixed + 1) is None
    y = torch.cat((torch.arange(10.0)[:, None], torch.full((10, 1), 0.3)), 1)
    assert r_squared(y, y + torch.tensor([0.0, 5.0])) == 1.0
    y[:, 1] = 1e-8 * torch.randn(10, generator=torch.Generator().manual_seed(1))  # rounding, about zero
    assert r_squared(y, y + torch.tensor([0.0, 5.0])) == 1.0


def test_episodes_are_split_without_overlap() -> None:
    for count in (3, 7, 40):
        parts = split_by_episode(count)
        assert sorted(torch.cat(parts).tolist()) == list(range(count))
        assert all(len(part) for part in parts)
    assert [len(part) for part in split_by_episode(40)] == [24, 8, 8]
    with pytest.raises(ValueError, match="at least 3"):
        split_by_episode(2)


def test_the_penalty_is_chosen_on_held_out_data() -> None:
    """Many noisy features, few samples: without a penalty the fit is worthless; clean data need none."""
    generator = torch.Generator().manual_seed(2)

    def draw(n: int, noise: float) -> tuple[torch.Tensor, torch.Tensor]:
        x = torch.randn(n, 30, generator=generator)
        return x, x[:, :1] + noise * torch.randn(n, 1, generator=generator)

    _, noisy = ridge_probe(draw(35, 2.0), draw(200, 2.0), draw(5, 0.0)[0])
    _, clean = ridge_probe(draw(35, 0.0), draw(200, 0.0), draw(5, 0.0)[0])
    assert noisy >= 10 and clean <= 1e-2


def test_what_latents_hold_and_what_they_do_not() -> None:
    generator = torch.Generator().manual_seed(3)
    hidden = torch.randn(30, 20, 4, generator=generator)
    mixing = torch.linalg.qr(torch.randn(8, 8, generator=generator)).Q
    latents = torch.cat((hidden, torch.randn(30, 20, 4, generator=generator)), -1) @ mixing
    targets = {
        "linear": hidden[..., :2],
        "bent": hidden[..., :1].square(),
        "absent": torch.randn(30, 20, 2, generator=generator),
        "fixed": torch.full((30, 20, 1), 0.5),
    }
    results = probe(latents, targets)
    assert results["linear"]["ridge"] > 0.999
    assert 0.2 < results["linear"]["neighbours"] < 0.999
    assert results["bent"]["ridge"] < 0.1 < 0.2 < results["bent"]["neighbours"]
    assert max(results["absent"].values()) < 0.05
    assert results["fixed"] == {"ridge": None, "neighbours": None}
    assert probe(latents, targets) == results


def test_a_number_of_the_episode_cannot_be_looked_up() -> None:
    """Latents that say which episode it is, and nothing else, tell nothing about other episodes."""
    generator = torch.Generator().manual_seed(4)
    name = torch.randn(25, 1, 6, generator=generator).expand(25, 10, 6)
    target = torch.randn(25, 1, 1, generator=generator).expand(25, 10, 1)
    result = probe(name + 1e-3 * torch.randn(25, 10, 6, generator=generator), {"goal": target})["goal"]
    assert result["ridge"] < 0.4 and result["neighbours"] < 0.4


def test_steps_that_do_not_count() -> None:
    generator = torch.Generator().manual_seed(5)
    latents = torch.randn(12, 10, 3, generator=generator)
    valid = torch.arange(10).expand(12, 10) < 6
    target = torch.where(valid.unsqueeze(-1), latents[..., :1], 1e3)
    assert probe(latents, {"x": target}, valid=valid)["x"]["ridge"] > 0.999
    assert probe(latents, {"x": target})["x"]["ridge"] < 0.5


def test_a_few_short_episodes_are_measured_by_as_many_neighbours_as_there_are() -> None:
    """It raised, and `franka-wm evaluate` lost the episodes that it had played before."""
    torch.manual_seed(0)
    found = probe(torch.randn(3, 2, 4), {"x": torch.randn(3, 2, 2)})
    assert found["x"]["neighbours"] is not None
