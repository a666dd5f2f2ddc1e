"""What `torch.compile` needs of a machine: asked before a run, done without where a checkpoint only acts."""

from __future__ import annotations

import sysconfig

import pytest
import torch

from franka_wm.device import missing_to_compile
from franka_wm.errors import UserError
from franka_wm.training import build
from franka_wm.training.check import check
from franka_wm.training.spaces import Spaces


def test_a_machine_without_a_compiler_plans_uncompiled_and_says_so(settled, monkeypatch, capsys) -> None:
    """As where a checkpoint of another machine is evaluated; a run that asks for it is refused before."""
    monkeypatch.setenv("CXX", "no-such-compiler")
    cfg = settled("scale=smoke", "planner.compile=true")
    with pytest.raises(
        UserError, match=r"planner.compile=true: torch.compile needs a compiler \(no-such-compiler\)"
    ):
        check(cfg)
    with pytest.raises(
        UserError, match=r"trainer.compile=true: .* is not here; install it, or trainer.compile=false"
    ):
        check(settled("scale=smoke", "trainer.compile=true"))
    env = build.make_evaluation_env(cfg, num_envs=2)
    model = build.make_model(cfg, spaces := Spaces.of_env(env), "cpu")
    capsys.readouterr()
    policy = build.make_agent_policies(cfg, model, env, spaces)["planner"]
    assert policy.next == model.next
    assert (
        "planner.compile: a compiler (no-such-compiler) is not here; it plans without"
        in capsys.readouterr().out
    )


def test_what_compiling_needs(monkeypatch, tmp_path) -> None:
    cpu, cuda = torch.device("cpu"), torch.device("cuda")
    for name in ("CC", "CXX"):
        monkeypatch.delenv(name, raising=False)
    assert missing_to_compile(cpu) is None  # as tests of what is compiled need it
    monkeypatch.setenv("PATH", str(tmp_path))
    assert (
        missing_to_compile(cpu) == "a compiler (g++)"
        and missing_to_compile(cuda) == "a compiler (gcc or clang)"
    )
    (tmp_path / "clang").touch(mode=0o755)
    assert missing_to_compile(cuda) is None
    monkeypatch.setattr(sysconfig, "get_path", lambda *args: str(tmp_path))
    assert missing_to_compile(cuda) == "Python's headers (Python.h; the package python3-dev)"
