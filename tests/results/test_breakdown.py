"""Where a run's time goes: what is counted, and that a run is built and timed as train.py runs it."""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
import torch

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def breakdown(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    for name in ("common", "breakdown"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return import_module("breakdown")


def test_time_that_is_covered_counts_once(breakdown: ModuleType) -> None:
    assert breakdown.busy([(0.0, 4.0), (1.0, 2.0), (3.0, 5.0), (7.0, 8.0)]) == 6.0
    assert breakdown.busy([]) == 0.0


def test_names_lose_their_types(breakdown: ModuleType) -> None:
    name = "void at::native::(anonymous namespace)::vectorized_layer_norm_kernel<float, float, false>(int, float)"
    assert breakdown.shortened(name) == "vectorized_layer_norm_kernel"
    assert (
        breakdown.shortened("walk_gumbel_a5ea909a_cuda_kernel_forward")
        == "walk_gumbel_a5ea909a_cuda_kernel_forward"
    )


def test_operators_that_call_others_are_not_counted_twice(breakdown: ModuleType) -> None:
    x = torch.randn(64, 64)
    found, spans = breakdown.launched(lambda: torch.nn.functional.linear(x, x), 3, torch.device("cpu"))
    names = [name for name, _ in found]
    assert names.count("aten::linear") == names.count("aten::mm") == 3
    assert sum(time for _, time in found) == pytest.approx(breakdown.busy(spans), rel=0.05)


@pytest.mark.slow
def test_a_run_is_taken_apart(breakdown: ModuleType, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(breakdown, "WARMUP", 1)
    out = tmp_path / "out.json"
    arguments = ["scale=smoke", "env=reach_fixed", "device=cpu"]
    monkeypatch.setattr(
        sys, "argv", ["breakdown.py", *arguments, "--seconds", "0.01", "--longest", "2", "--out", str(out)]
    )
    breakdown.main()
    rows = json.loads(out.read_text())["rows"]
    assert [row["part"] for row in rows[::5]] == ["gather", "draw", "update"] and len(rows) == 15
    for first, total, covered, *longest in (rows[:5], rows[5:10], rows[10:]):
        assert first["what"] == "one call" and first["time [ms]"] > 0
        assert 0 < covered["time [ms]"] <= total["time [ms]"] * 1.001
        assert longest[0]["time [ms]"] >= longest[1]["time [ms]"]
