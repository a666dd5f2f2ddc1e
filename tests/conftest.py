"""What the tests share: small environments, configurations as train.py composes them."""

from __future__ import annotations

import gc
import importlib.util
import itertools
import logging
import os
import random
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

# Torch and the simulator are imported inside: `pytest -n` loads this file in a process that runs no test, too, before
# it starts those that do.
if TYPE_CHECKING:
    import torch
    from omegaconf import DictConfig

    from franka_wm.envs import FrankaEnv
    from franka_wm.training.load import Agent
    from franka_wm.training.settings import RunSettings

ROOT = Path(__file__).resolve().parents[1]

LONG = (
    "tests/processes/test_job.py",
    "tests/fuzz/test_faults.py",
    "tests/training/test_undisturbed.py",
    "tests/training/test_resume.py",
    "tests/commands/test_train.py",
    "tests/fuzz/test_rooms.py",
    "tests/training/test_build.py",
    "tests/envs/test_manipulation.py",
    "tests/data/lerobot/test_collect.py",
)
"""Files that take longest. They begin: else one process works at them when the other has nothing left."""


MANY = 200
"""Tests of a process among which there are many runs."""


def pytest_configure(config: pytest.Config) -> None:
    """One thread by plain ``pytest``, too, as by ``make test``: tests compare with processes that have one."""
    threads = int(os.environ.setdefault("OMP_NUM_THREADS", "1"))
    if config.getoption("numprocesses", None) and not hasattr(config, "workerinput"):
        return  # others run the tests
    # What to type is said as `franka-wm` where the shell finds it, else as a path: tests compare the first.
    os.environ["PATH"] = os.pathsep.join(
        (str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath))
    )
    # Until all modules are loaded: a sixth of the time goes into looking for garbage among what stays.
    gc.disable()
    import torch

    torch.set_num_threads(threads)
    # dm_control brings absl, which takes the stderr that it finds, here pytest's file, and closes it as Hydra sets up
    # logging: in whichever tests a process has come to by then.
    if importlib.util.find_spec("absl"):
        from absl import logging as absl_logging

        absl_logging.get_absl_handler().python_handler.stream = sys.__stderr__


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """The same random numbers for a test whichever ran before it in its process, and for the fixtures that it makes."""
    import numpy as np
    import torch

    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)


def pytest_runtest_teardown() -> None:
    """LeRobot's video encoder, run by root, leaves whoever called it realtime; what is started later would be, too."""
    if hasattr(os, "sched_getscheduler") and os.sched_getscheduler(0) == os.SCHED_FIFO:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first; otherwise as they are found."""
    place = {name: k for k, name in enumerate(LONG)}
    items.sort(key=lambda item: place.get(item.nodeid.partition("::")[0], len(LONG)))


def pytest_collection_finish(session: pytest.Session) -> None:
    """All modules are loaded, and no test has run."""
    gc.enable()
    if session.items and not session.config.option.collectonly:
        import franka_wm.training.load  # noqa: F401  with torch and the simulator, for all forks
        from configuration import compose_once, load_what_runs_load
        from forks import spare

        compose_once()
        if len(session.items) > MANY:
            load_what_runs_load()
        spare()


def pytest_sessionfinish() -> None:
    forks = sys.modules.get("forks")
    if forks is not None and forks.spare.cache_info().currsize:
        forks.spare().close()


@pytest.fixture(autouse=True)
def registries_as_before(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What a test registers, or removes, is not there for the next one of its process.

    Nor are the examples and the modules of its folder: imported once more, in a fork, too, they register again.
    """
    from franka_wm import models
    from franka_wm.envs import tasks
    from franka_wm.planning import registry

    names = tasks._REGISTERED, models._REGISTERED, registry._REGISTERED
    before, known, loaded = [dict(one) for one in names], list(tasks.TASKS), set(sys.modules)
    yield
    places = str(ROOT / "examples"), str(tmp_path_factory.getbasetemp())
    for name in sys.modules.keys() - loaded:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(places):
            del sys.modules[name]
    for one, kept in zip(names, before, strict=True):
        one.clear()
        one.update(kept)
    tasks.TASKS[:] = known


@pytest.fixture(autouse=True)
def process_as_before() -> Iterator[None]:
    """Environment variables, and the root logger, to which Hydra gives handlers on streams that pytest closes.

    Environments without a seed are counted: the same test makes the same ones wherever it runs.
    """
    from franka_wm.envs import franka

    franka._unseeded = itertools.count()
    variables, root = dict(os.environ), logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    for name in os.environ.keys() | variables.keys():
        if name == "PYTEST_CURRENT_TEST":
            continue
        if name not in variables:
            del os.environ[name]
        elif os.environ.get(name) != variables[name]:
            os.environ[name] = variables[name]


SMALL = {"substeps": 2, "gravity_compensation": True, "observations": ("state", "joint_target")}


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository."""
    return ROOT


@pytest.fixture(scope="session")
def small_env() -> Callable[..., FrankaEnv]:
    """Makes a cheap environment on the CPU: two substeps, no pictures unless asked for."""
    from franka_wm.envs import FrankaConfig, FrankaEnv

    def make(num_envs: int = 3, *, seed: int = 0, **changes: Any) -> FrankaEnv:
        config = FrankaConfig(**(SMALL | changes))
        return FrankaEnv(config, num_envs=num_envs, device="cpu", seed=seed)

    return make


@pytest.fixture(scope="session")
def composed() -> Callable[..., DictConfig]:
    """The configuration that ``python train.py …`` would run with."""
    from franka_wm import conf

    return conf.compose


@pytest.fixture(scope="session")
def settled() -> Callable[..., RunSettings]:
    """Settings of the run that ``python train.py …`` would be."""
    from franka_wm import conf
    from franka_wm.training.settings import RunSettings

    return lambda *overrides: RunSettings.of(conf.compose(*overrides))


@pytest.fixture(scope="session")
def random_actions() -> Callable[..., torch.Tensor]:
    """Uniform actions (N, T, 7) whose first worlds do not depend on N."""
    import torch

    def make(num_envs: int, steps: int, seed: int = 0) -> torch.Tensor:
        worlds = [
            torch.rand(steps, 7, generator=torch.Generator().manual_seed(1000 * seed + k))
            for k in range(num_envs)
        ]
        return 2 * torch.stack(worlds) - 1

    return make


SMOKE = [
    "scale=smoke",
    "device=cpu",
    "env.episode_length=12",
    "env.substeps=2",
    "collector.num_envs=4",
    "evaluation.episodes=2",
    "evaluation.video_episodes=0",
    "logger=none",
]


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished smoke run."""
    from forks import train_in_fork

    place = tmp_path_factory.mktemp("agent")
    done = train_in_fork(*SMOKE, f"hydra.run.dir={place}/run", cwd=place)
    assert done.returncode == 0, done.stdout + done.stderr
    return place / "run"


@pytest.fixture(scope="session")
def agent(run_folder: Path) -> Agent:
    """That run's agent in six worlds."""
    from franka_wm.training.load import load_agent

    return load_agent(run_folder, num_envs=6, device="cpu", seed=0)
