"""Warp is quiet unless somebody asks for what it says; other lines on file descriptor 2 are not lost."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from franka_wm.envs.simulation.compiling import FORWARD_ONLY

MAKE = """
import ctypes, json, os, sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
import warp as wp
from forks import run_in_fork
from franka_wm.envs import FrankaConfig, FrankaEnv

def make():
    config = FrankaConfig(substeps=2, solver_ls_iterations=1)  # every line search ends at its limit
    env = FrankaEnv(config, num_envs=8, device="cpu", seed=0)
    root = env.reset()
    for _ in range(12):
        root = env.step(root.set("action", env.action_spec.high))["next"]
    ctypes.CDLL(None).fflush(None)  # what kernels printed

def others():
    init = wp.init
    def speak():
        wp.init = init
        os.write(2, b"another line\\n")
        init()
    wp.init = speak
    make()

def asked():
    wp.config.log_level = wp.LOG_INFO
    make()

ends = [run_in_fork(work, Path.cwd()) for work in (make, others, asked)]
print(json.dumps([[done.returncode, done.stdout, done.stderr] for done in ends]))
"""


@pytest.fixture(scope="module")
def made(root: Path) -> dict[str, tuple[str, str]]:
    """What was printed and what was on standard error, in forks of a process that has loaded the package alone."""
    command = [sys.executable, "-c", MAKE, str(root / "tests" / "helpers")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr == ""  # as it was imported
    ends = json.loads(done.stdout)
    assert [status for status, *_ in ends] == [0, 0, 0], ends
    return {name: (out, err) for name, (_, out, err) in zip(("quiet", "others", "asked"), ends, strict=True)}


def test_an_environment_is_quiet(made) -> None:
    assert made["quiet"] == ("", "")


def test_other_lines_are_not_lost(made) -> None:
    assert made["others"] == ("", "another line\n")


def test_warp_speaks_where_it_is_asked_to(made) -> None:
    assert "Module newton" in made["asked"][0]


def test_kernels_of_newton_are_compiled_without_their_backward_pass() -> None:
    """All of them; the modules have these names."""
    for name in FORWARD_ONLY:
        importlib.import_module(name)
        module = wp.get_module(name)
        assert module.kernels and module.options["enable_backward"] is False, name
