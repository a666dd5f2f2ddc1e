"""Open loop: the numbers of models and values whose quality is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats

from franka_wm.evaluation.intervals import bootstrap_ratio
from franka_wm.evaluation.open_loop import (
    cost_ranks,
    grouped_spearman,
    horizon_error,
    steps_until_forgotten,
    value_calibration,
)


@pytest.fixture
def walk() -> tuple[torch.Tensor, torch.Tensor]:
    """Positions (E, T + 1, 2) of points that move by their actions (E, T, 2)."""
    generator = torch.Generator().manual_seed(0)
    actions = torch.randn(20, 15, 2, generator=generator)
    start = torch.randn(20, 1, 2, generator=generator)
    return torch.cat((start, start + actions.cumsum(1)), 1), actions


# -- error by horizon --------------------------------------------------------------------------------------


def test_a_perfect_model_has_no_error(point_model, walk) -> None:
    result = horizon_error(point_model, *walk, horizon=6)
    assert result["steps"] == [1, 2, 3, 4, 5, 6]
    assert result["curves"]["model"]["mean"] == pytest.approx([0.0] * 6, abs=1e-10)
    assert result["curves"]["model"]["high"] == pytest.approx([0.0] * 6, abs=1e-10)
    assert result["windows"] == 20 * 10 and result["episodes"] == 20


def test_a_model_that_predicts_no_change_has_1(point_model, walk) -> None:
    point_model.next = lambda z, a: z
    result = horizon_error(point_model, *walk, horizon=6)
    for part in ("mean", "low", "high"):
        assert result["curves"]["model"][part] == pytest.approx([1.0] * 6)
    assert result["curves"]["no_change"]["mean"] == [1.0] * 6
    assert result["error"] == pytest.approx(result["no_change_error"])


def test_errors_by_hand(point_model, walk) -> None:
    """A model that sees half of every action is off by half the way, at every horizon."""
    point_model.next = lambda z, a: z + 0.5 * a
    latents, actions = walk
    result = horizon_error(point_model, latents, actions, horizon=4)
    for h in range(1, 5):
        way = latents[:, h:] - latents[:, :-h]
        assert result["error"][h - 1] == pytest.approx(float((0.5 * way).square().sum(-1).mean()), rel=1e-5)
        assert result["curves"]["model"]["mean"][h - 1] == pytest.approx(0.25, rel=1e-5)


def test_what_follows_the_end_of_an_episode_does_not_count(point_model, walk) -> None:
    latents, actions = (x.clone() for x in walk)
    latents[:, 9:] = 1e6  # another episode
    valid = torch.arange(16).expand(20, 16) < 9
    result = horizon_error(point_model, latents, actions, horizon=5, valid=valid)
    assert result["curves"]["model"]["mean"] == pytest.approx([0.0] * 5, abs=1e-10)
    assert result["windows"] == 20 * (9 - 5)


def test_distances_are_measured_on_the_embedding(point_model, walk) -> None:
    point_model.next = lambda z, a: z + a * torch.tensor([1.0, 0.0])  # does not see the second component …
    assert horizon_error(point_model, *walk, horizon=1)["curves"]["model"]["mean"][0] > 0.3
    point_model.embed = lambda z: z[..., :1]  # … which the embedding leaves out
    assert horizon_error(point_model, *walk, horizon=1)["curves"]["model"]["mean"][0] < 1e-10


def test_numbered_moves(point_model) -> None:
    moves = torch.randint(3, (8, 10), generator=torch.Generator().manual_seed(1))
    table = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    point_model.next = lambda z, a: z + table[a]
    latents = torch.cat((torch.zeros(8, 1, 2), table[moves].cumsum(1)), 1)
    assert horizon_error(point_model, latents, moves, horizon=3)["error"] == [0.0] * 3


def test_bad_shapes_and_still_latents_are_refused(point_model, walk) -> None:
    latents, actions = walk
    with pytest.raises(ValueError, match="do not fit"):
        horizon_error(point_model, latents[:, 1:], actions)
    with pytest.raises(ValueError, match="at least 1"):
        horizon_error(point_model, latents, actions, horizon=0)
    with pytest.raises(ValueError, match="nothing to predict"):
        horizon_error(point_model, torch.zeros_like(latents), actions)


def test_intervals_of_ratios_hold_the_true_ratio() -> None:
    """200 experiments of 40 pairs with ratio 0.5; standard error of the coverage 2 %."""
    draws = np.random.default_rng(0)
    covered = 0
    for seed in range(200):
        bottom = draws.gamma(2.0, 1.0, size=40)
        top = 0.5 * bottom * draws.gamma(4.0, 0.25, size=40)
        interval = bootstrap_ratio(top, bottom, resamples=400, seed=seed)
        assert interval.low <= interval.mean <= interval.high
        covered += interval.low <= 0.5 <= interval.high
    assert 0.86 <= covered / 200 <= 0.99


# -- ranks -------------------------------------------------------------------------------------------------


def test_the_true_distance_ranks_perfectly() -> None:
    tool = torch.randn(6, 40, 3, generator=torch.Generator().manual_seed(4))
    for result in cost_ranks(tool, tool, pairs=500).values():
        assert result == {"mean": 1.0, "low": 1.0, "high": 1.0}


def test_episodes_of_one_step_have_no_pairs_to_rank() -> None:
    tool = torch.randn(3, 5, 3, generator=torch.Generator().manual_seed(4))
    valid = torch.zeros(3, 5, dtype=torch.bool)
    valid[:, 0] = True
    result = cost_ranks(tool, tool, valid=valid, pairs=500)
    assert result["across"]["mean"] == 1.0 and math.isnan(result["within"]["mean"])


def test_unrelated_latents_have_no_rank_correlation() -> None:
    generator = torch.Generator().manual_seed(5)
    tool, latents = (torch.randn(10, 60, 3, generator=generator) for _ in range(2))
    for result in cost_ranks(latents, tool, pairs=2000).values():
        assert abs(result["mean"]) < 0.1


def test_pairs_within_episodes_do_not_mix_goals() -> None:
    """Latents that carry a large number of their own in each episode: across episodes that number rules."""
    generator = torch.Generator().manual_seed(6)
    tool = torch.randn(12, 50, 3, generator=generator)
    goal = 100 * torch.randn(12, 1, 1, generator=generator).expand(12, 50, 1)
    result = cost_ranks(torch.cat((tool, goal), -1), tool)
    assert result["within"]["mean"] == pytest.approx(1.0)
    assert result["across"]["mean"] < 0.5


def test_intervals_of_ranks_draw_whole_episodes() -> None:
    """Each episode's latents are right or wrong as a whole: 600 pairs know no more than 12 episodes do."""
    truth = []
    widths, covered = [], 0
    for trial in range(40):
        generator = torch.Generator().manual_seed(trial)
        tool = torch.randn(12, 40, 3, generator=generator)
        noise = torch.randn(12, 40, 3, generator=generator)
        good = (torch.rand(12, 1, 1, generator=generator) < 0.5).float()
        result = cost_ranks(good * tool + (1 - good) * noise, tool, pairs=600, seed=trial)["within"]
        assert result["low"] <= result["mean"] <= result["high"]
        truth.append(result["mean"])
        widths.append(result["high"] - result["low"])
        covered += result["low"] <= 0.5 <= result["high"]
    spread = float(torch.tensor(truth).std())
    assert covered / 40 >= 0.8
    assert (
        2 * spread < sum(widths) / 40 < 8 * spread
    )  # 1.96 · 2 is right; independent pairs would give about 0.5


def test_grouped_ranks_of_equal_weights_are_spearmans() -> None:
    generator = torch.Generator().manual_seed(9)
    x = torch.randint(20, (300,), generator=generator).double()
    y = x + 8 * torch.randn(300, generator=generator)
    own = torch.arange(300)[:, None].expand(
        300, 2
    )  # every pair an episode of its own: as good as independent
    grouped, rho = grouped_spearman(x, y, own), stats.spearmanr(x.numpy(), y.numpy()).statistic
    assert grouped.mean == pytest.approx(rho, abs=1e-12)
    # Fisher's z with Bonett & Wright's variance (2000).
    half = 1.96 * math.sqrt((1 + rho**2 / 2) / 297)
    ends = math.tanh(math.atanh(rho) - half), math.tanh(math.atanh(rho) + half)
    assert grouped.high - grouped.low == pytest.approx(ends[1] - ends[0], rel=0.15)
    with pytest.raises(ValueError, match="groups"):
        grouped_spearman(x, y, own[1:])


# -- values ------------------------------------------------------------------------------------------------


def test_an_exact_value_is_the_identity() -> None:
    returns = torch.randn(500, generator=torch.Generator().manual_seed(7))
    result = value_calibration(returns, returns)
    assert result["slope"] == pytest.approx(1.0) and result["intercept"] == pytest.approx(0.0, abs=1e-12)
    assert result["bias"] == 0 and result["error"] == 0 and result["correlation"] == pytest.approx(1.0)
    assert result["predicted"] == pytest.approx(result["true"])
    assert sum(result["count"]) == result["samples"] == 500


def test_an_optimist_and_a_coward() -> None:
    """Values of 2 · return + 3: half the slope; 3 too high on average."""
    returns = torch.randn(2000, generator=torch.Generator().manual_seed(8))
    returns -= returns.mean()
    result = value_calibration(2 * returns + 3, returns)
    assert result["slope"] == pytest.approx(0.5, rel=1e-5)
    assert result["intercept"] == pytest.approx(-1.5, rel=1e-5)
    assert result["bias"] == pytest.approx(3.0, rel=1e-5)
    assert result["correlation"] == pytest.approx(1.0)


def test_a_constant_value_has_no_slope() -> None:
    result = value_calibration(torch.zeros(30), torch.arange(30.0))
    assert math.isnan(result["slope"]) and math.isnan(result["correlation"])
    assert result["bias"] == pytest.approx(-14.5)


def test_rewards_are_forgotten_in_time() -> None:
    for discount in (0.9, 0.95, 0.99):
        steps = steps_until_forgotten(discount)
        assert discount**steps <= 0.02 < discount ** (steps - 1)
    assert steps_until_forgotten(1.0) == 400
