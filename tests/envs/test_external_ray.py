"""Worlds of other libraries in Ray actors: what one process plays, and one line where Ray cannot."""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch

from franka_wm.envs import external_ray
from franka_wm.envs.external import ExternalEnv
from franka_wm.envs.external_config import ExternalConfig
from franka_wm.errors import UserError

pytest.importorskip("gymnasium")
CARTPOLE = ExternalConfig(kind="gym", name="CartPole-v1", episode_length=30)
KEYS = (
    "state",
    "is_init",
    *(("next", key) for key in ("state", "reward", "done", "terminated", "step_count")),
)


class Died(Exception):
    """What Ray says of an actor that has ended."""


class Failed(Exception):
    """What Ray says of a call that has raised."""

    def __init__(self, cause: Exception):
        super().__init__(str(cause))
        self.cause = cause


class InProcess:
    """Ray's few functions, without processes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        self.cores, self.asked, self.ended = 2.0, [], 0
        self.broken: dict[str, Exception] = {}
        errors = SimpleNamespace(RayActorError=Died, RayTaskError=Failed, GetTimeoutError=TimeoutError)
        module = ModuleType("ray")
        module.__dict__.update(
            is_initialized=lambda: True,
            cluster_resources=lambda: {"CPU": self.cores},
            remote=lambda **_: lambda made: SimpleNamespace(remote=lambda: self.actor(made())),
            get=lambda calls, timeout: [call() for call in calls],
            kill=self.kill,
            exceptions=errors,
        )
        monkeypatch.setitem(sys.modules, "ray", module)

    def kill(self, actor: object) -> None:
        self.ended += 1

    def actor(self, share: object) -> SimpleNamespace:
        def method(name: str) -> Callable[..., Any]:
            def call(*arguments: object) -> object:
                self.asked.append(name)
                if name in self.broken:
                    raise self.broken[name]
                return getattr(share, name)(*arguments)

            return lambda *arguments: lambda: call(*arguments)

        names = ("begin", "set_seed", "step", "reset")
        return SimpleNamespace(**{name: SimpleNamespace(remote=method(name)) for name in names})


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> InProcess:
    return InProcess(monkeypatch)


@pytest.fixture
def real() -> Iterator[Any]:
    """Ray itself where it is installed, with two cores on any machine."""
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=2, log_to_driver=False, include_dashboard=False)
    yield ray
    ray.shutdown()


def played(env: ExternalEnv) -> tuple[Any, dict[str, float]]:
    """Forty steps with episodes that end at different times, and a reset of one world alone."""
    carry, steps = env.reset(), []
    for _ in range(40):
        step, carry = env.step_and_maybe_reset(carry.set("action", torch.tensor([0, 1, 1, 0])))
        steps.append(step)
    carry = env.reset(carry.set("_reset", torch.tensor([[True], [False], [False], [False]])))
    steps.append(env.step(carry.set("action", torch.tensor([1, 0, 1, 0]))))
    return torch.stack(steps).to_tensordict(), env.statistics()


@pytest.mark.parametrize("ray", ["fake", pytest.param("real", marks=pytest.mark.slow)])
def test_actors_play_what_one_process_plays(ray: str, request: pytest.FixtureRequest) -> None:
    request.getfixturevalue(ray)
    one, told = played(ExternalEnv(CARTPOLE, num_envs=4, seed=3))
    env = ExternalEnv(CARTPOLE, num_envs=4, seed=3, workers=2, ray=True)
    other, said = played(env)
    env.close()
    ends = one["next", "done"].sum(1)
    assert told == said and ((ends > 0) & (ends < 4)).any()
    for key in KEYS:
        assert torch.equal(one[key], other[key]), key


def test_only_actors_with_a_world_to_reset_are_asked(fake: InProcess) -> None:
    env = ExternalEnv(CARTPOLE, num_envs=4, workers=2, ray=True)
    carry = env.reset()
    fake.asked.clear()
    again = env.reset(carry.clone().set("_reset", torch.tensor([[False], [False], [True], [False]])))
    assert fake.asked == ["reset"]
    assert torch.equal(
        again["state"] == carry["state"], torch.tensor([1, 1, 0, 1])[:, None].expand(4, 4) == 1
    )
    fake.asked.clear()
    now = env.step(env.rand_action(carry))["next"]
    none = env.reset(now.clone().set("_reset", torch.zeros(4, 1, dtype=torch.bool)))
    assert fake.asked == ["step", "step"] and torch.equal(none["state"], now["state"])
    env.close()
    assert fake.ended == 2


def test_what_goes_wrong_is_one_line_and_ends_the_actors(
    fake: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(workers: int = 2) -> str:
        with pytest.raises(UserError) as caught:
            ExternalEnv(CARTPOLE, num_envs=4, workers=workers, ray=True)
        return str(caught.value)

    assert refused(4).startswith("collector.workers=4: each actor takes a core, and Ray has 2;")
    fake.broken["begin"] = Failed(UserError("env=gym needs more"))
    assert refused() == "collector=ray, in an actor: env=gym needs more" and fake.ended == 2
    fake.broken["begin"] = TimeoutError()
    assert "2 actors have not begun after 300 s" in refused()
    fake.broken.clear()
    found = iter([{"gymnasium": "1"}, {"gymnasium": "1"}, {"gymnasium": "2"}])
    monkeypatch.setattr(external_ray, "_versions", lambda: next(found))
    assert refused() == "collector=ray: a host has gymnasium 1, this one 2; install the same on all"


def test_without_the_extra_or_the_cluster_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"collector=ray needs pip install 'franka-wm\[ray\]'"):
        external_ray.import_ray()
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{closed.getsockname()[1]}")
        with pytest.raises(UserError, match=r"cannot join RAY_ADDRESS=127.0.0.1:\d+: .*refused"):
            external_ray._join(SimpleNamespace(init=lambda **_: pytest.fail("tried")))


def test_an_actor_that_dies_ends_the_run(fake: InProcess) -> None:
    env = ExternalEnv(CARTPOLE, num_envs=4, workers=2, ray=True)
    carry = env.rand_action(env.reset())
    fake.broken["step"] = Died("gone\nsince then")
    with pytest.raises(UserError, match=r"an actor has died \(gone\); resume=FOLDER goes on"):
        env.step(carry)


@pytest.mark.slow
def test_an_actor_that_is_killed_ends_the_run(real: Any) -> None:
    env = ExternalEnv(CARTPOLE, num_envs=4, workers=2, ray=True)
    carry = env.rand_action(env.reset())
    base: Any = env.base_env
    os.kill(real.get(base._shares[1].__ray_call__.remote(lambda _: os.getpid())), signal.SIGKILL)
    with pytest.raises(UserError, match="an actor has died"):
        env.step(carry)
