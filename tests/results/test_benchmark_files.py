"""What a benchmark says of itself in the file of its --out, and what is made of it."""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
import torch

from benchmarks.results import records, state
from benchmarks.results.rows import Row, Section
from franka_wm.errors import UserError

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
ROW = Row(
    name="search",
    section=Section(title="Speed", threads=64),
    title="Tree search",
    script="benchmarks/search.py",
    arguments="--device cpu --envs 1 16",
)


@pytest.fixture
def common(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.delitem(sys.modules, "common", raising=False)
    monkeypatch.setattr(sys, "argv", ["benchmarks/search.py", *ROW.words, "--out", "a file"])
    return import_module("common")


def test_the_device_is_the_one_that_computed(common: ModuleType, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)  # a machine with a GPU that was not used
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "a GPU")
    for device, name in (("cpu", "cpu"), ("auto", "a GPU")):
        common.publish("search", [{"ms": 1.0}], str(tmp_path / "out"), device=device)
        assert json.loads((tmp_path / "out").read_text())["machine"]["device"] == name


def test_code_that_other_processes_ran_counts(common: ModuleType, tmp_path: Path) -> None:
    def files(**options) -> set[str]:
        common.publish("search", [{"ms": 1.0}], str(tmp_path / "out"), device="cpu", **options)
        return set(json.loads((tmp_path / "out").read_text())["machine"]["source"])

    other = "benchmarks/_xwm_side.py"
    assert other not in files()
    assert files(ran=("benchmarks/_xwm",)) == files() | {other}


def test_a_configuration_that_gives_other_numbers_makes_a_row_stale(
    common: ModuleType, tmp_path: Path
) -> None:
    file = tmp_path / "out.json"
    common.compose("planner=mppi", "scale=gpu")
    common.publish("search", [{"ms": 1.0}], str(file), device="cpu")
    record = records.record_benchmark(ROW, file)
    assert state.stale([record]) == []
    record["code"]["composed"]["planner=mppi scale=gpu"]["planner"]["num_samples"] = 256
    assert state.stale([record]) == ["planner.num_samples 256 → 512"]
    record["code"]["composed"] = {"planner=of_former_times": {}}
    assert "refused now" in state.stale([record])[0]


@pytest.mark.parametrize("script", sorted(BENCHMARKS.glob("*.py")), ids=lambda script: script.stem)
def test_a_benchmark_notes_the_configurations_that_it_composes(script: Path) -> None:
    text = script.read_text()
    assert script.stem == "common" or ("conf.compose" not in text and "import compose\n" not in text)


@pytest.mark.parametrize("script", sorted(BENCHMARKS.glob("*.py")), ids=lambda script: script.stem)
def test_a_benchmark_that_starts_processes_says_what_they_run(script: Path) -> None:
    text = script.read_text()
    assert ("subprocess" in text) == ("ran=" in text) or script.stem == "common"


def test_a_benchmark_with_other_arguments_is_refused(common: ModuleType, monkeypatch, tmp_path: Path) -> None:
    file = tmp_path / "out.json"
    common.publish("search", [{"ms": 1.0}], str(file), device="cpu")
    assert (
        records.record_benchmark(ROW, file)["command"]
        == "python benchmarks/search.py --device cpu --envs 1 16"
    )
    for other in (
        ["search.py", "--device", "cpu"],
        ["learner.py", *ROW.words],
        ["search.py", *ROW.words, "-x"],
    ):
        monkeypatch.setattr(common, "COMMAND", other)
        common.publish("search", [{"ms": 1.0}], str(file), device="cpu")
        with pytest.raises(UserError, match=f"not a measurement of search, made by benchmarks/{other[0]}"):
            records.record_benchmark(ROW, file)
