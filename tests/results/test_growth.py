"""How cost grows: what is measured, its power, and its picture on the page."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks.results import plots, render
from benchmarks.results.rows import Row, Section

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
ROW = Row(
    name="growth",
    section=Section(title="Speed", threads=2),
    title="How cost grows",
    script="benchmarks/growth.py",
    plot={"panels": "what", "x": "size", "y": "time [ms]"},
)
ROWS = [
    {"what": what, "size": size, "time [ms]": 0.5 * size**power}
    for what, power in (("worlds", 1.0), ("batch", 0.5), ("replay", 0.0), ("horizon", 1.0))
    for size in (1, 10, 100)
]


@pytest.fixture
def growth(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    for name in ("common", "env", "learner", "planners", "growth"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return import_module("growth")


def test_each_number_changes_the_work_that_is_timed(growth: ModuleType, monkeypatch) -> None:
    cpu, seen = torch.device("cpu"), {}
    assert set(growth.WORK) == set(growth.SIZES)
    for name, size in (("worlds", 3), ("batch", 5), ("replay", 640)):
        growth.WORK[name](size, cpu)()
    monkeypatch.setattr(growth, "make_observation", lambda *args: SimpleNamespace())
    monkeypatch.setattr(
        growth.PlannerPolicy, "for_model", lambda model, planner: lambda _: seen.update(vars(planner))
    )
    growth.WORK["horizon"](7, cpu)()
    assert (seen["horizon"], seen["num_samples"]) == (7, 512)
    growth.WORK["candidates"](99, cpu)()
    assert (seen["horizon"], seen["num_samples"]) == (3, 99)


def test_worlds_batch_and_replay_have_the_size(growth: ModuleType, monkeypatch) -> None:
    cpu, made = torch.device("cpu"), []
    real = growth.FrankaEnv
    monkeypatch.setattr(
        growth, "FrankaEnv", lambda *args, **options: made.append(real(*args, **options)) or made[-1]
    )
    growth.worlds(3, cpu)()
    assert made[0].num_envs == 3 and made[0].simulation.tensors.step_count.max() > 0
    assert "pixels" not in [*made[0].observation_spec.keys()]
    update = growth.batch(5, cpu)
    update()
    windows = next(
        cell.cell_contents for cell in update.__closure__ if hasattr(cell.cell_contents, "batch_size")
    )
    assert windows.batch_size == (5, 3)
    sample = growth.replay(640, cpu)
    assert len(sample.__self__) == 640 and sample().batch_size == (256, 3)


def test_power_is_what_the_counter_gained(growth: ModuleType, monkeypatch) -> None:
    common, counted, clock = sys.modules["common"], iter([1000, 7000]), iter([10.0, 12.0])
    nvml = SimpleNamespace(
        nvmlInit=lambda: None,
        nvmlShutdown=lambda: None,
        nvmlDeviceGetHandleByUUID=lambda name: name,
        nvmlDeviceGetTotalEnergyConsumption=lambda gpu: next(counted) if gpu == "GPU-abc" else None,
    )
    monkeypatch.setitem(sys.modules, "pynvml", nvml)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: SimpleNamespace(uuid="abc"))
    monkeypatch.setattr(common.time, "perf_counter", lambda: next(clock))
    with common.power(torch.device("cuda:0")) as drawn:
        pass
    assert drawn.watts == 3.0  # 6 J in 2 s
    with common.power(torch.device("cpu")) as drawn:
        pass
    assert drawn.watts != drawn.watts


def test_without_its_library_power_is_said_to_be_missing(growth: ModuleType, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "pynvml", None)
    with sys.modules["common"].power(torch.device("cuda:0")) as drawn:
        pass
    assert drawn.watts != drawn.watts
    assert capsys.readouterr().out == "power is not measured; pip install nvidia-ml-py\n"


def test_a_panel_for_each_kind_and_the_same_file_for_the_same_numbers(tmp_path: Path) -> None:
    figure = plots.draw(ROW, {"rows": ROWS})
    assert [axes.get_xlabel() for axes in figure.axes] == ["worlds", "batch", "replay", "horizon"]
    line = figure.axes[1].lines[-1]
    assert np.asarray(line.get_xydata())[:, 0].tolist() == [1, 10, 100]
    assert np.asarray(line.get_xydata())[0, 1] == 0.5
    first = plots.write(ROW, {"rows": ROWS}, tmp_path / "one")
    second = plots.write(ROW, {"rows": ROWS}, tmp_path / "two")
    assert first == tmp_path / "one" / "growth" / "plot.svg"
    assert first.read_bytes() == second.read_bytes()


def test_the_page_shows_the_picture(monkeypatch) -> None:
    monkeypatch.setattr(render, "_provenance", lambda row, records: "")
    monkeypatch.setattr(render, "_command", lambda row, records: "")
    shown = "![How cost grows](results/growth/plot.svg)"
    assert shown in render.part(ROW, [{"rows": ROWS}], ("fresh", []))
    assert shown not in render.part(replace(ROW, plot=None), [{"rows": ROWS}], ("fresh", []))
