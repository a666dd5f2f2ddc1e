"""Spectra: against their definitions and cases with a known answer; the warning fires where it should."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from franka_wm.evaluation.spectrum import (
    collapse_warning,
    effective_rank,
    latent_statistics,
    mean_cosine,
    rankme,
    spectrum,
)


@pytest.fixture
def isotropic() -> torch.Tensor:
    return torch.randn(400, 16, generator=torch.Generator().manual_seed(0))


def test_rankme_is_its_definition(isotropic: torch.Tensor) -> None:
    x = (isotropic * torch.linspace(0.1, 3, 16) + 0.5).double().numpy()
    sigma = np.linalg.svd(x, compute_uv=False)
    p = sigma / np.abs(sigma).sum() + 1e-7
    assert rankme(torch.from_numpy(x)) == pytest.approx(np.exp(-(p * np.log(p)).sum()))


@pytest.mark.parametrize("k", [1, 3, 8])
def test_ranks_of_equal_singular_values_are_their_number(k: int) -> None:
    x = torch.zeros(8, 8)
    x[:k, :k] = torch.eye(k)
    assert rankme(x) == pytest.approx(k, rel=1e-4)
    signs = torch.cat((x, -x))  # centred, so that the covariance has k equal eigenvalues
    assert effective_rank(signs) == pytest.approx(k, rel=1e-6)


def test_effective_rank_ignores_a_common_offset_and_rankme_does_not(isotropic: torch.Tensor) -> None:
    assert effective_rank(isotropic + 100) == pytest.approx(effective_rank(isotropic), rel=1e-3)
    assert rankme(isotropic + 100) < 0.5 * rankme(isotropic)


def test_effective_rank_is_the_entropy_of_the_covariance(isotropic: torch.Tensor) -> None:
    x = isotropic * torch.linspace(0.1, 3, 16)
    values = np.linalg.eigvalsh(np.cov(x.double().numpy().T))
    p = values / values.sum()
    assert effective_rank(x) == pytest.approx(math.exp(-(p * np.log(p)).sum()))


def test_mean_cosine_is_that_of_all_pairs(isotropic: torch.Tensor) -> None:
    x = isotropic[:30] + 0.5
    cosines = torch.nn.functional.cosine_similarity(x[:, None], x[None], dim=-1)
    expected = cosines[~torch.eye(30, dtype=torch.bool)].mean()
    assert mean_cosine(x) == pytest.approx(float(expected), abs=1e-6)
    assert mean_cosine(torch.ones(5, 3)) == pytest.approx(1.0)


def test_statistics_of_an_isotropic_latent(isotropic: torch.Tensor) -> None:
    s = latent_statistics(isotropic)
    assert s["feature_std"] == pytest.approx(1.0, abs=0.05)
    assert 0 < s["smallest_feature_std"] <= s["feature_std"]
    assert s["norm"] == pytest.approx(4.0, abs=0.1)
    assert s["spread"] == pytest.approx(1.0, abs=0.01)
    assert 15 < s["effective_rank"] <= 16 and 15 < s["rankme"] <= 16.01
    assert abs(s["mean_cosine"]) < 0.01
    assert (s["samples"], s["dimensions"]) == (400, 16)


def test_singular_values_are_deviations_along_the_main_directions() -> None:
    scale = torch.tensor([3.0, 1.0, 0.1])
    x = torch.randn(20_000, 3, generator=torch.Generator().manual_seed(1)) * scale + 7
    assert spectrum(x)["singular_values"] == pytest.approx(scale.tolist(), rel=0.03)


def test_the_warning_fires_on_a_point_and_a_line_and_not_otherwise(isotropic: torch.Tensor) -> None:
    assert collapse_warning(latent_statistics(isotropic)) is None
    assert collapse_warning(latent_statistics(isotropic + 5)) is None
    point = torch.ones(16) + 1e-3 * isotropic
    assert "to a point" in str(collapse_warning(latent_statistics(point)))
    assert "to a point" in str(collapse_warning(latent_statistics(torch.ones(64, 16))))
    line = isotropic[:, :1] * torch.ones(16) + 0.02 * isotropic
    assert "directions" in str(collapse_warning(latent_statistics(line)))
    assert collapse_warning(latent_statistics(isotropic[:, :1])) is None  # a latent of one number is a line
    assert spectrum(point)["warning"] is not None and spectrum(isotropic)["warning"] is None


def test_a_handful_of_latents_says_nothing() -> None:
    assert collapse_warning(latent_statistics(torch.ones(8, 16))) is None


def test_bad_latents_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        latent_statistics(torch.zeros(1, 4))
    with pytest.raises(ValueError, match="finite"):
        latent_statistics(torch.full((3, 4), math.nan))
