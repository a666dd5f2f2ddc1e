"""The benchmark of the environment measures what its table says."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from franka_wm.envs import FrankaEnv

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.delitem(sys.modules, "common", raising=False)
    spec = importlib.util.spec_from_file_location("env_benchmark", BENCHMARKS / "env.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_worlds_are_apart_while_the_collector_is_timed(benchmark: ModuleType) -> None:
    """TorchRL's collector begins with a reset of all worlds, which would all end in the same step from then on."""
    env = FrankaEnv(replace(benchmark.PRESET, episode_length=20), num_envs=16, device="cpu")
    assert benchmark.collector(env, 2, 0.01, benchmark.uniform) > 0
    assert env.simulation.tensors.step_count.unique().numel() > 4
