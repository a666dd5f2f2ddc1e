"""On a GPU: nothing waits for the device, nothing is copied to or from the host, and the numbers are the CPU's.

These run where there is a GPU (``make test ARGS="-m gpu"``); everywhere else they are skipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from franka_wm.envs import FrankaConfig, FrankaEnv, Randomization, TransformedFrankaEnv
from franka_wm.envs.discretize import DiscreteActions
from franka_wm.envs.tasks import TorchTask
from franka_wm.errors import UserError
from franka_wm.training.learner import Learner

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

BASE = {
    "substeps": 2,
    "gravity_compensation": True,
    "episode_length": 7,
    "image_size": 32,
    "observations": ("state", "joint_target"),
}
RANDOM = Randomization(
    color=0.2, brightness=0.2, camera_position=0.05, camera_target=0.05, gains=0.2, armature=0.2, friction=0.5,
    mass=0.2, action_noise=0.05, action_latency=2, observation_noise=0.01,
)  # fmt: skip
CASES: dict[str, dict[str, Any]] = {
    "state": {},
    "pixels": {"observations": ("pixels", "state", "joint_target")},
    "every picture": {
        "observations": ("pixels", "depth", "segmentation", "goal_pixels", "state", "joint_target"),
        "cameras": ("front", "wrist"),
        "goal_sampling": "reachable",
        "show_goal": True,
    },
    "stacked": {
        "observations": ("pixels", "goal_pixels", "state", "joint_target"),
        "cameras": ("side", "front"),
        "frame_stack": 3,
    },
    "joint_position": {"action_mode": "joint_position"},
    "ee_delta": {"action_mode": "ee_delta"},
    "track": {"task": "track"},
    "normalized": {"reward": "normalized"},
    "sparse": {"reward": "sparse", "terminate_on_success": True, "success_distance": 0.3},
    "limit_velocity": {"limit_velocity": True, "action_scale": 0.085},
    "randomized": {"randomization": RANDOM, "observations": ("pixels", "state", "joint_target")},
}
STEPS, N = 16, 8


@contextmanager
def no_waiting() -> Iterator[None]:
    """Any call of torch's that waits for the device is an error."""
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def play(env: FrankaEnv, actions: torch.Tensor) -> dict[str, torch.Tensor]:
    """What the steps gave, (T, N, …), over the ends of episodes."""
    tensordict = env.reset(seed=3)
    steps = []
    for action in actions[..., : env.action_dim].unbind(1):
        step, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
        steps.append(step["next"].clone())
    stacked = torch.stack(steps)
    return {str(key): stacked[key] for key in stacked.keys()}  # noqa: SIM118


@pytest.mark.parametrize("case", CASES)
def test_no_step_waits_or_copies(case: str) -> None:
    """Counted by torch's own guard, and by CUPTI, which sees Warp's copies, too."""
    env = FrankaEnv(FrankaConfig(**BASE | CASES[case]), num_envs=N, device="cuda")
    tensordict = env.reset()
    action = env.rand_action(tensordict)["action"]

    def run(steps: int) -> None:
        nonlocal tensordict
        for _ in range(steps):
            _, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            tensordict.pop("next", None)

    run(3)
    with no_waiting():
        run(STEPS)
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as seen:
        run(STEPS)
        torch.cuda.synchronize()
    names = [event.key for event in seen.key_averages() for _ in range(event.count)]
    copies = [name for name in names if "DtoH" in name or "HtoD" in name]
    waits = [name for name in names if "Synchronize" in name]
    assert copies == []
    # One is ours, after the steps; the profiler's own stop may add a few, but never one for each step.
    assert len(waits) < STEPS // 2


class Hover(TorchTask):
    """A task in torch, with everything that one may do: draws, a goal, reward and success."""

    def goal(self, draws: torch.Tensor) -> torch.Tensor:
        x, y, z = draws[:, :3].unbind(-1)
        return torch.stack([0.3 + 0.2 * x, 0.5 * y - 0.25, 0.3 + 0.4 * z], -1)

    def reward(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return -torch.tanh(state[..., 17:20].norm(dim=-1)) - 0.01 * action.square().mean(-1)

    def success(self, state: torch.Tensor) -> torch.Tensor:
        return state[..., 17:20].norm(dim=-1) < 0.2


def hover(device: str, **changes: Any) -> FrankaEnv:
    config = FrankaConfig(**BASE | {"terminate_on_success": True} | changes)
    return FrankaEnv(config, num_envs=N, device=device, task=Hover(config))


@pytest.mark.parametrize("observations", [("state", "joint_target"), ("state", "goal_pixels")])
def test_a_task_in_torch_is_part_of_the_graph(observations: tuple[str, ...], random_actions) -> None:
    """Nothing waits, its functions are not called again, other work of torch's does not disturb it, the CPU agrees."""
    actions = 0.3 * random_actions(N, STEPS)
    expected = play(hover("cpu", observations=observations), actions)
    env = hover("cuda", observations=observations)
    got = play(env, actions.cuda())
    check_agreement(expected, {key: value.cpu() for key, value in got.items()})

    def never(*_: Any) -> torch.Tensor:
        raise AssertionError

    for name in ("goal", "reward", "success"):
        setattr(env.simulation.task, name, never)
    tensordict = env.reset(seed=3)
    moves = actions.cuda()[..., : env.action_dim].unbind(1)
    torch.cuda.empty_cache()
    with no_waiting():
        others, again = [], []
        for action in moves:
            others += [torch.full((k * k,), float("nan"), device="cuda") for k in (8, 64, 512)]
            step, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            again.append(step["next"].clone())
    for key, value in got.items():
        assert torch.equal(torch.stack(again)[key], value), key
    assert all(other.isnan().all() for other in others)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")
def test_another_gpu_than_the_current_one(random_actions) -> None:
    """What is captured there allocates there."""
    actions = 0.3 * random_actions(N, STEPS)
    check_agreement(episodes("pixels", "cuda:0", actions), episodes("pixels", "cuda:1", actions))


def test_a_task_in_torch_that_waits_is_told_so() -> None:
    class Waiting(Hover):
        def success(self, state: torch.Tensor) -> torch.Tensor:
            return state[..., 16] > state[0, 16].item()

    config = FrankaConfig(**BASE)
    env = FrankaEnv(config, num_envs=N, device="cuda", task=Waiting(config))
    tensordict = env.reset()
    with pytest.raises(UserError, match="must not wait"):
        env.step(tensordict.set("action", env.rand_action(tensordict)["action"]))


def test_no_step_waits_under_transforms() -> None:
    env = TransformedFrankaEnv(
        FrankaEnv(FrankaConfig(**BASE | CASES["stacked"]), num_envs=N, device="cuda"), DiscreteActions()
    )
    tensordict = env.reset()
    action = env.rand_action(tensordict)["action"]
    for steps in (3, STEPS):
        with no_waiting() if steps == STEPS else nullcontext():
            for _ in range(steps):
                _, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
                tensordict.pop("next", None)


@pytest.mark.parametrize("case", CASES)
def test_as_on_the_cpu(case: str, random_actions) -> None:
    """The same episodes: draws are exact, physics agree to single precision over an episode and its reset."""
    actions = 0.3 * random_actions(N, STEPS)
    check_agreement(episodes(case, "cpu", actions), episodes(case, "cuda", actions))


def episodes(case: str, device: str, actions: torch.Tensor) -> dict[str, torch.Tensor]:
    """What a case gives on a device."""
    env = FrankaEnv(FrankaConfig(**BASE | CASES[case]), num_envs=N, device=device)
    return {key: value.cpu() for key, value in play(env, actions.to(device)).items()}


def check_agreement(here: dict[str, torch.Tensor], there: dict[str, torch.Tensor]) -> None:
    """Whether two devices gave the same, but for rounding."""
    assert here.keys() == there.keys()
    for key, expected in here.items():
        got = there[key]
        assert got.dtype == expected.dtype and got.shape == expected.shape, key
        if expected.dtype == torch.uint8:  # rounding moves an edge by a pixel here and there
            differing = (got.float() - expected.float()).abs().amax(-1) > 8
            assert differing.float().mean() < 0.02, key
        elif expected.dtype == torch.bool:
            assert (got != expected).float().mean() < 0.02, key
        elif key.startswith("depth"):
            assert ((got - expected).abs() > 0.02).float().mean() < 0.02, key
        else:
            torch.testing.assert_close(got, expected, rtol=1e-3, atol=2e-3, msg=lambda m, k=key: f"{k}: {m}")


def test_a_masked_reset_touches_no_other_world() -> None:
    env = FrankaEnv(
        FrankaConfig(**BASE | CASES["every picture"] | {"auto_reset": "standard"}), num_envs=N, device="cuda"
    )
    tensordict = env.rollout(3, break_when_any_done=False)[:, -1]["next"]
    mask = torch.zeros(N, 1, dtype=torch.bool, device="cuda")
    mask[2] = True
    after = env.reset(tensordict.clone().set("_reset", mask))
    others = ~mask.squeeze(1)
    for key in env._observed:
        assert torch.equal(after[key][others], tensordict[key][others]), key
    assert not torch.equal(after["state"][2], tensordict["state"][2])


def test_states_go_in_and_out(random_actions) -> None:
    env = FrankaEnv(FrankaConfig(**BASE), num_envs=N, device="cuda")
    env.rollout(4, break_when_any_done=False)
    state = env.get_state()
    actions = random_actions(N, 3).cuda()

    def future() -> torch.Tensor:
        tensordict = env.set_state(state)
        out = []
        for action in actions.unbind(1):
            step, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            out.append(step["next", "state"].clone())
        return torch.stack(out)

    first = future()
    env.reset(seed=9)
    torch.testing.assert_close(future(), first, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_captured_and_eager_updates_agree(precision: str, settled) -> None:
    from franka_wm.training import build
    from franka_wm.training.spaces import Spaces

    cfg = settled("scale=smoke", "device=cuda", "model.dropout=0.0")

    def trained(capture: bool) -> dict[str, torch.Tensor]:
        torch.manual_seed(0)
        model = build.make_model(cfg, Spaces.of_config(FrankaConfig(**BASE)), "cuda")
        learner = Learner(model, capture=capture, precision=precision)
        generator = torch.Generator(device="cuda").manual_seed(1)
        for _ in range(12):
            learner.update(windows(generator))
        # The critic's and the policy's draws differ between the two; what they do not enter must agree.
        return {k: v.clone() for k, v in model.reward_head.state_dict().items()}

    eager, captured = trained(False), trained(True)
    for key, value in eager.items():
        torch.testing.assert_close(
            captured[key], value, rtol=0.05, atol=5e-3, msg=lambda m, k=key: f"{k}: {m}"
        )


def windows(generator: torch.Generator) -> Any:
    """A batch of windows on the GPU."""
    from tensordict import TensorDict

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(16, 3, *shape, device="cuda", generator=generator)

    after = {"state": draw(20), "joint_target": draw(7), "reward": -draw(1).abs()}
    after["terminated"] = torch.zeros(16, 3, 1, dtype=torch.bool, device="cuda")
    root = {"state": draw(20), "joint_target": draw(7), "action": draw(7).tanh()}
    return TensorDict(root | {"next": TensorDict(after, batch_size=[16, 3])}, batch_size=[16, 3])
