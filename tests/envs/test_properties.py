"""Whatever is done to the environment: every observation stays finite and within its spec; memory stays put."""

from __future__ import annotations

import gc
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from franka_wm.envs import FrankaEnv

N = 3
OPERATIONS = st.lists(
    st.one_of(
        st.tuples(st.just("step"), st.integers(0, 1000), st.sampled_from([0.0, 0.3, 1.0, 50.0])),
        st.tuples(st.just("reset"), st.lists(st.booleans(), min_size=N, max_size=N)),
        st.tuples(st.just("reset all"), st.one_of(st.none(), st.integers(-(2**40), 2**40))),
        st.tuples(st.just("seed"), st.integers(0, 2**33)),
        st.tuples(st.just("auto"), st.integers(0, 1000)),
    ),
    max_size=25,
)


@pytest.fixture(scope="module")
def env(small_env) -> FrankaEnv:
    return small_env(
        N,
        substeps=1,
        image_size=8,
        observations=("pixels", "state", "joint_target"),
        goal_sampling="reachable",
        episode_length=6,
    )


def sound(env: FrankaEnv, observation: TensorDict) -> None:
    for key, spec in env.observation_spec.items():
        assert spec.is_in(observation[key]), key
        assert torch.isfinite(observation[key].float()).all(), key
    low, high = env.kinematics.lower - 0.05, env.kinematics.upper + 0.05
    joints = observation["state"][:, :7]
    assert ((joints >= low) & (joints <= high)).all()
    offset = observation["state"][:, 14:17] - observation["goal"]
    torch.testing.assert_close(observation["state"][:, 17:], offset, atol=1e-6, rtol=0)


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(operations=OPERATIONS)
def test_any_sequence_of_calls(env: FrankaEnv, operations: list[tuple]) -> None:
    observation = env.reset()
    for name, *arguments in operations:
        if name == "step":
            seed, size = arguments
            action = size * torch.randn(N, 7, generator=torch.Generator().manual_seed(seed))
            step = env.step(observation.clone().set("action", action))["next"]
            assert torch.isfinite(step["reward"]).all() and (step["reward"] <= 0).all()
            assert (step["reward"] > -1 - env.config.action_penalty - 1e-6).all()
            sound(env, step)
        elif name == "reset" and any(arguments[0]):
            mask = torch.tensor(arguments[0]).unsqueeze(-1)
            first = observation["is_init"] | mask  # an observation that was a first one stays one
            observation = env.reset(observation.clone().set("_reset", mask))
            assert torch.equal(observation["is_init"], first)
        elif name == "reset all":
            observation = env.reset(seed=arguments[0])
            assert observation["is_init"].all()
        elif name == "seed":
            env.set_seed(arguments[0])
        elif name == "auto":
            action = torch.rand(N, 7, generator=torch.Generator().manual_seed(arguments[0]))
            step, observation = env.step_and_maybe_reset(observation.set("action", action))
            assert torch.equal(observation["is_init"], step["next", "done"])
            sound(env, step["next"])
        sound(env, observation)
    assert env.statistics()["nonfinite"] == 0


def resident() -> float:
    """Memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_memory_does_not_grow(env: FrankaEnv) -> None:
    """Steps with resets and pictures: 2000 of them, under 4 MB."""
    action = torch.zeros(N, 7)
    tensordict = env.reset()

    def run(steps: int) -> None:
        nonlocal tensordict
        for _ in range(steps):
            _, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            tensordict.pop("next", None)

    run(300)
    env.render(16)
    gc.collect()
    before = resident()
    run(2000)
    for _ in range(50):
        env.render(16)
    gc.collect()
    assert resident() - before < 4
