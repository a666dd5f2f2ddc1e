"""Ends of episodes: what a collector hands over, auto-reset in both modes, transforms, statistics."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import CatFrames, Compose, EnvBase, RewardSum, StepCounter
from torchrl.envs.utils import check_env_specs, step_mdp

from franka_wm.envs import FrankaEnv, TransformedFrankaEnv
from franka_wm.errors import UserError

LENGTH = 5
N = 3
OPTIONS = {"episode_length": LENGTH, "goal_sampling": "reachable", "image_size": 16}
PIXELS = ("pixels", "state", "joint_target")


class Play(TensorDictModuleBase):
    """A fixed sequence of actions (N, T, 7). Collectors may call a policy once to see what it gives."""

    in_keys = ["is_init"]
    out_keys = ["action"]

    def __init__(self, actions: torch.Tensor):
        super().__init__()
        self.actions, self.t = actions, 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.t += 1
        return tensordict.set("action", self.actions[:, (self.t - 1) % self.actions.shape[1]])


def collect(env: EnvBase, actions: torch.Tensor, batches: int = 2) -> TensorDictBase:
    """(N, T): all steps, gathered in several batches as the trainer does."""
    steps = actions.shape[1] // batches
    env.set_seed(0)
    collector = Collector(
        env,
        Play(actions),
        frames_per_batch=steps * env.batch_size[0],
        total_frames=batches * steps * env.batch_size[0],
        track_traj_ids=False,
        no_cuda_sync=True,
        trust_policy=True,
    )
    data = torch.cat([batch.clone() for batch in collector], 1)
    collector.shutdown(close_env=False)
    return data


@pytest.fixture(scope="module", params=["state", "pixels"])
def observations(request) -> tuple[str, ...]:
    return PIXELS if request.param == "pixels" else PIXELS[1:]


@pytest.fixture(scope="module")
def env(small_env, observations) -> FrankaEnv:
    return small_env(N, observations=observations, **OPTIONS)


@pytest.fixture(scope="module")
def data(env, random_actions) -> TensorDictBase:
    """Twelve steps of three worlds: two whole episodes and the start of a third."""
    return collect(env, random_actions(N, 12))


# -- specs -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("auto_reset", ["native", "standard"])
def test_specs(small_env, observations, auto_reset: str) -> None:
    env = small_env(N, observations=observations, auto_reset=auto_reset, **OPTIONS)
    check_env_specs(env)
    assert ("pixels" in set(env.observation_spec.keys())) == ("pixels" in observations)


def test_specs_under_transforms(env: FrankaEnv) -> None:
    frames = CatFrames(N=3, dim=-1, in_keys=["state"], out_keys=["history"])
    check_env_specs(TransformedFrankaEnv(env, Compose(StepCounter(), RewardSum(), frames)))


def test_one_world_keeps_its_leading_dimension(small_env) -> None:
    rollout = small_env(1, **OPTIONS).rollout(3)
    assert rollout["state"].shape == (1, 3, 20) and rollout["next", "reward"].shape == (1, 3, 1)


def test_shapes_and_types(env: FrankaEnv, observations, data: TensorDictBase) -> None:
    expected = {"state": (20,), "joint_target": (7,), "goal": (3,), "success": (1,), "is_init": (1,)}
    expected |= {("next", "reward"): (1,), ("next", "done"): (1,), "action": (7,)}
    expected |= {"pixels": (16, 16, 3)} if "pixels" in observations else {}
    for key, shape in expected.items():
        assert data[key].shape == (N, 12, *shape), key
        kind = torch.uint8 if key == "pixels" else torch.float32
        assert data[key].dtype == (torch.bool if shape == (1,) and key != ("next", "reward") else kind), key
    assert ("pixels" in set(data.keys())) == ("pixels" in observations)


# -- auto-reset ------------------------------------------------------------------------------------------


def test_next_is_the_true_last_observation(small_env, observations, data) -> None:
    """Against a world that is never reset, stepped by hand with the same actions."""
    endless = small_env(N, observations=observations, **(OPTIONS | {"episode_length": 1000}))
    observation = endless.reset(seed=0)
    for t in range(LENGTH):
        for key in observations:
            assert torch.equal(data[key][:, t], observation[key]), (key, t)
        step = endless.step(observation.set("action", data["action"][:, t]))
        for key in (*observations, "goal", "reward"):
            assert torch.equal(data["next", key][:, t], step["next", key]), (key, t)
        observation = step_mdp(step)
    assert data["next", "done"][:, LENGTH - 1].all()


def test_the_following_root_is_the_next_episode_s_first(env, data, observations) -> None:
    env.reset(seed=0)
    for episode in (1, 2):
        fresh = env.reset()
        for key in (*observations, "goal"):
            assert torch.equal(data[key][:, episode * LENGTH], fresh[key]), (key, episode)


def test_next_is_the_following_root_inside_an_episode(data, observations) -> None:
    inside = [t for t in range(11) if (t + 1) % LENGTH]
    for key in (*observations, "goal", "success"):
        for t in inside:
            assert torch.equal(data["next", key][:, t], data[key][:, t + 1]), (key, t)
    for t in (LENGTH - 1, 2 * LENGTH - 1):
        for key in observations:
            assert not torch.equal(data["next", key][:, t], data[key][:, t + 1]), (key, t)


def test_flags(data) -> None:
    time = torch.arange(12)
    assert (data["is_init"].squeeze(-1) == (time % LENGTH == 0)).all()
    for key in ("done", "truncated"):
        assert (data["next", key].squeeze(-1) == (time % LENGTH == LENGTH - 1)).all()
        assert not data[key].any()
    assert not data["next", "terminated"].any()
    assert not data["next", "is_init"].any()


def test_standard_auto_reset_gives_the_same(small_env, observations, data, random_actions) -> None:
    env = small_env(N, observations=observations, auto_reset="standard", **OPTIONS)
    other = collect(env, random_actions(N, 12))
    keys = (*observations, "goal", "is_init", "done", "success")
    for key in (*keys, *(("next", k) for k in (*observations, "goal", "reward", "done", "success"))):
        assert torch.equal(data[key], other[key]), key


def test_rollout_is_what_the_collector_sees(env, data, observations) -> None:
    env.set_seed(0)
    rollout = env.rollout(12, Play(data["action"]), break_when_any_done=False)
    for key in (*observations, ("next", "reward"), ("next", "state")):
        assert torch.equal(data[key], rollout[key]), key


@pytest.mark.parametrize("auto_reset", ["native", "standard"])
def test_transforms_at_the_end_of_episodes(small_env, random_actions, auto_reset: str) -> None:
    """Return and length are right at done, stacked frames start anew with each episode."""
    env = small_env(N, auto_reset=auto_reset, **OPTIONS)
    frames = CatFrames(N=3, dim=-1, in_keys=["state"], out_keys=["history"])
    transformed = TransformedFrankaEnv(env, Compose(StepCounter(), RewardSum(), frames))
    data = collect(transformed, random_actions(N, 12))
    state = data["state"].split(LENGTH, 1)
    following = data["next", "state"].split(LENGTH, 1)
    reward = data["next", "reward"].split(LENGTH, 1)
    time = torch.arange(12)
    assert torch.equal(data["next", "step_count"][..., 0], (time % LENGTH + 1).expand(N, 12))
    assert torch.equal(data["step_count"][..., 0], (time % LENGTH).expand(N, 12))
    total = torch.cat([r.cumsum(1) for r in reward], 1)
    torch.testing.assert_close(data["next", "episode_reward"], total)
    for root, after, history, later in zip(
        state,
        following,
        data["history"].split(LENGTH, 1),
        data["next", "history"].split(LENGTH, 1),
        strict=True,
    ):
        every = torch.cat([root[:, :1], root[:, :1], root, after[:, -1:]], 1)  # the first one pads
        for t in range(root.shape[1]):
            assert torch.equal(history[:, t], every[:, t : t + 3].flatten(1)), t
            assert torch.equal(later[:, t], every[:, t + 1 : t + 4].flatten(1)), t


# -- ends ------------------------------------------------------------------------------------------------


def test_success_terminates_if_asked(small_env, random_actions) -> None:
    """With a threshold that some steps meet and some do not."""
    options = {"success_distance": 0.25, "pose_noise": 0.3}
    actions = random_actions(6, 10)
    ends = collect(small_env(6, terminate_on_success=True, **options), actions)
    goes_on = collect(small_env(6, **options), actions)
    for data in (ends, goes_on):
        near = data["next", "state"][..., 17:].norm(dim=-1, keepdim=True) < 0.25
        assert torch.equal(data["next", "success"], near)
        assert near.any() and not near.all()
    assert torch.equal(ends["next", "terminated"], ends["next", "success"])
    assert torch.equal(ends["next", "done"], ends["next", "success"])
    assert not ends["next", "truncated"].any()
    assert torch.equal(ends["is_init"][:, 1:], ends["next", "done"][:, :-1])
    assert not goes_on["next", "done"].any()


def test_ends_by_success_under_transforms(small_env, random_actions) -> None:
    """Worlds end at different times; each sum and count starts anew in its own world only."""
    env = small_env(6, terminate_on_success=True, success_distance=0.25, episode_length=4)
    data = collect(TransformedFrankaEnv(env, Compose(StepCounter(), RewardSum())), random_actions(6, 10))
    done, reward = data["next", "done"], data["next", "reward"]
    assert data["next", "terminated"].any() and data["next", "truncated"].any()
    total, count = torch.zeros(6, 1), torch.zeros(6, 1, dtype=torch.int64)
    for t in range(10):
        total, count = total + reward[:, t], count + 1
        torch.testing.assert_close(data["next", "episode_reward"][:, t], total)
        assert torch.equal(data["next", "step_count"][:, t], count), t
        total, count = total * ~done[:, t], count * ~done[:, t]
    assert torch.equal(data["is_init"][:, 1:], done[:, :-1])


def test_success_at_the_time_limit_is_terminated_not_truncated(small_env) -> None:
    env = small_env(2, success_distance=10.0, terminate_on_success=True, episode_length=1)
    step = env.rand_step(env.reset())["next"]
    assert step["terminated"].all() and not step["truncated"].any() and step["done"].all()


def test_statistics_are_those_of_the_data(small_env, random_actions) -> None:
    env = small_env(N, **(OPTIONS | {"success_distance": 0.4}))
    env.statistics()
    data = collect(env, random_actions(N, 22))
    got = env.statistics(clear=False)
    reward = data["next", "reward"][:, :20].reshape(-1, LENGTH)
    success = data["next", "success"][:, :20].reshape(-1, LENGTH)
    assert got["episodes"] == 4 * N == reward.shape[0]
    assert got["return"] == pytest.approx(reward.sum(1).mean().item(), abs=1e-5)
    assert got["length"] == LENGTH and got["nonfinite"] == 0
    assert got["success"] == pytest.approx(success[:, -1].float().mean().item())
    assert got["success_once"] == pytest.approx(success.any(1).float().mean().item())
    assert 0 < got["success"] <= got["success_once"] < 1
    assert env.statistics() == got
    assert env.statistics() == {"episodes": 0.0, "nonfinite": 0.0}


def test_emitted_tensors_are_not_overwritten(env: FrankaEnv) -> None:
    first = env.reset(seed=0)
    kept = first.clone()
    step = env.rand_step(first.clone())
    copy = step.clone()
    for _ in range(LENGTH):
        env.rand_step(env.reset())
    assert (first == kept).all() and (step == copy).all()


@pytest.mark.parametrize("shape", [(N, 6), (7,), (N + 1, 7), (N, 1, 7)])
def test_wrong_action_shape(env: FrankaEnv, shape: tuple[int, ...]) -> None:
    before = env.reset(seed=0)
    with pytest.raises(UserError) as caught:
        env._step(TensorDict({"action": torch.zeros(shape)}))
    assert "\n" not in str(caught.value)
    assert torch.equal(env.state_observation(), before["state"])


def test_no_action(env: FrankaEnv) -> None:
    with pytest.raises(UserError, match=r"there is no action; it must be \(\d+, 7\)"):
        env.step(env.reset(seed=0))
