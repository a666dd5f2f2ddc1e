import json
import subprocess
import sys

import pytest
import torch

from franka_wm.models.regularizers import (
    BatchNorm,
    CollapseGuard,
    ProjectionMLP,
    SIGReg,
    covariance_loss,
    feature_std,
    info_nce,
    participation_ratio,
)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def skewed(count: int, width: int = 4) -> torch.Tensor:
    """Off centre, stretched, correlated and one-sided."""
    x = 1.5 * torch.rand(count, width) ** 4
    return x @ torch.diag(torch.tensor([1.0, 0.5, 0.2, 0.1])) + 0.5 * x[:, :1] + 0.5


def spread(x: torch.Tensor) -> tuple[float, float, float, float]:
    """Norm of the mean, smallest and largest variance along any direction, and the mean absolute skewness."""
    variances = torch.linalg.eigvalsh(torch.cov(x.T))
    skew = ((x - x.mean(0)) / x.std(0)).pow(3).mean(0).abs().mean()
    return x.mean(0).norm().item(), variances[0].item(), variances[-1].item(), skew.item()


def test_sigreg_pulls_a_skewed_distribution_to_isotropy():
    x = skewed(128).requires_grad_()
    sigreg, before = SIGReg(directions=64), spread(x.detach())
    assert before[0] > 1.2 and before[1] < 0.01 and before[3] > 1.0
    optimiser = torch.optim.SGD([x], lr=1.0)
    for _ in range(400):
        optimiser.zero_grad()
        sigreg(x).backward()
        optimiser.step()
    mean, least, most, skew = spread(x.detach())
    assert mean < 0.15 and least > 0.7 and most < 1.4 and skew < 0.6 * before[3]


def test_sigreg_is_least_for_the_standard_normal():
    sigreg, x = SIGReg(directions=256), torch.randn(2048, 8)
    own = sigreg(x)
    assert own < 2.0  # of the order of one for any number of samples
    for wrong in (x + 0.5, 1.5 * x, 0.6 * x, x.exp(), torch.zeros_like(x), x[:, :1].expand(-1, 8)):
        assert sigreg(wrong) > 5 * own


def test_sigreg_against_its_integral():
    """Along a single direction of one-dimensional data the statistic is an integral that we can compute."""
    x = torch.randn(50, 1, dtype=torch.float64) * 0.7 + 0.3
    t = torch.linspace(-3, 3, 20001, dtype=torch.float64)
    phi = torch.exp(1j * t * x).mean(0)
    integrand = (phi - torch.exp(-0.5 * t**2)).abs() ** 2 * torch.exp(-0.5 * t**2)
    expected = 50 * torch.trapezoid(integrand, t)
    assert SIGReg(directions=3)(x).item() == pytest.approx(expected.item(), rel=0.01)


def test_sigreg_is_the_trapezoid_on_its_knots():
    x, sigreg = torch.randn(50, 1) + 1.0, SIGReg(directions=3, knots=5, limit=2.0)
    t = torch.linspace(-2, 2, 9)
    error = (torch.exp(1j * t * x).mean(0) - torch.exp(-0.5 * t**2)).abs() ** 2
    expected = 50 * torch.trapezoid(error * torch.exp(-0.5 * t**2), t)
    assert sigreg(x).item() == pytest.approx(expected.item(), rel=1e-4)
    for nothing in ({"limit": 0.0}, {"knots": 1}, {"directions": 0}):
        with pytest.raises(ValueError, match="directions >= 1, knots >= 2 and limit > 0"):
            SIGReg(**nothing)  # type: ignore[arg-type]


def test_sigreg_takes_each_set_by_itself_in_float32():
    sigreg = SIGReg(directions=32)
    x = torch.randn(3, 100, 5)
    torch.manual_seed(1)
    together = sigreg(x)
    parts = []
    for part in x:
        torch.manual_seed(1)
        parts.append(sigreg(part))
    torch.testing.assert_close(together, torch.stack(parts).mean())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.manual_seed(1)
        assert torch.equal(sigreg(x), together)


WORKER = """
import json, sys, torch
from torch import distributed
from franka_wm import processes
from franka_wm.models.regularizers import SIGReg

rank, folder = int(sys.argv[1]), sys.argv[2]
distributed.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2)
torch.manual_seed(0)
x = (torch.randn(16, 3) + 1.0)[rank * 8 : rank * 8 + 8].requires_grad_()
torch.manual_seed(5 + rank)  # the directions must come from rank 0 all the same
value = SIGReg(directions=16)(x)
value.backward()
with open(f"{folder}/{rank}.json", "w") as file:
    json.dump([value.item(), x.grad.tolist()], file)
distributed.barrier()
processes.leave()  # gloo's threads may abort a process that merely ends
"""


@pytest.mark.slow
def test_two_processes_see_the_statistic_of_both(tmp_path):
    ranks = [subprocess.Popen([sys.executable, "-c", WORKER, str(rank), str(tmp_path)]) for rank in range(2)]
    assert [rank.wait(timeout=300) for rank in ranks] == [0, 0]
    (a, ga), (b, gb) = (json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2))
    torch.manual_seed(0)
    whole = (torch.randn(16, 3) + 1.0).requires_grad_()
    torch.manual_seed(5)
    value = SIGReg(directions=16)(whole)
    value.backward()
    assert a == pytest.approx(value.item(), rel=1e-4) and b == pytest.approx(a, rel=1e-5)
    # Data-parallel training averages the gradients of the processes.
    torch.testing.assert_close(torch.tensor(ga + gb) / 2, whole.grad, rtol=1e-3, atol=1e-5)


def test_the_guard_of_vicreg_spreads_and_decorrelates():
    x = (0.01 * torch.randn(128, 4)).requires_grad_()
    guard, optimiser = CollapseGuard("vicreg"), torch.optim.Adam([x], lr=0.02)
    for _ in range(200):
        optimiser.zero_grad()
        guard(x).backward()
        optimiser.step()
    covariance = torch.cov(x.detach().T)
    assert covariance.diagonal().min() > 0.8
    assert (covariance - torch.diag(covariance.diagonal())).abs().max() < 0.05


def test_info_nce_rewards_the_match():
    x = torch.randn(32, 16)
    matched = info_nce(x, x + 0.01 * torch.randn_like(x))
    assert matched < 0.1 < 3.0 < info_nce(x, x.roll(1, 0))
    unit = torch.nn.functional.normalize(x.double(), dim=-1)
    logits = unit @ unit.roll(1, 0).mT / 0.1
    expected = -0.5 * (logits.log_softmax(0) + logits.log_softmax(1)).diagonal().mean()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert info_nce(x, x.roll(1, 0)).item() == pytest.approx(expected.item(), rel=1e-5)


def test_collapse_is_seen():
    ball, line, point = torch.randn(4096, 8), torch.randn(4096, 1) * torch.ones(8), torch.ones(4096, 8)
    assert feature_std(ball) == pytest.approx(1.0, abs=0.05) and feature_std(point) == 0
    assert participation_ratio(ball) > 7.9 and participation_ratio(line) == pytest.approx(1.0, abs=1e-3)
    assert participation_ratio(point) == 0
    for measure in (feature_std, participation_ratio):
        assert measure(ball.view(64, 64, 8)).item() == pytest.approx(measure(ball).item(), rel=1e-5)


def test_guards():
    x = torch.randn(64, 4) * 0.01
    assert CollapseGuard("none")(x) == 0 == CollapseGuard("ema")(x)
    for kind in ("sigreg", "vicreg"):
        assert CollapseGuard(kind)(x) > 5 * CollapseGuard(kind)(100 * x)
        assert CollapseGuard(kind, coef=0.0)(x) == 0
    guard = CollapseGuard("sigreg")  # LeJEPA's
    assert guard.coef == 0.05 and guard.sigreg is not None and guard.sigreg.directions == 1024
    assert [CollapseGuard(kind).coef for kind in ("vicreg", "ema", "none")] == [1.0, 0.0, 0.0]
    with pytest.raises(ValueError, match="vicreg"):
        CollapseGuard("hope")
    with pytest.raises(ValueError, match="negative"):
        CollapseGuard("sigreg", coef=-1.0)


def test_batch_normalisation_asks_which_statistics():
    norm, x = BatchNorm(3), 5 * torch.randn(4, 50, 3) + 2
    y = norm(x, batch_statistics=True)
    torch.testing.assert_close(y.mean((0, 1)), torch.zeros(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(norm.running_mean, 0.5 * x.mean((0, 1)))
    one = norm.train()(x, batch_statistics=False)[:1, :1]
    assert torch.equal(norm(x[:1, :1], batch_statistics=False), one)  # whatever else is in the batch
    assert ProjectionMLP(3, 5)(x, batch_statistics=True).shape == (4, 50, 5)


@pytest.mark.parametrize("measure", [covariance_loss, participation_ratio])
def test_covariances_are_float32_whatever_the_update_computes_in(measure):
    torch.manual_seed(0)
    x = torch.randn(4096, 64)
    with torch.autocast("cpu", torch.bfloat16):
        half = measure(x)
    assert half.dtype == torch.float32 and half.equal(measure(x))
