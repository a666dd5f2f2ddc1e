"""TorchRL's wrappers × what drives them × both auto-resets: the ends of episodes are those of a plain loop."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import count

import cloudpickle
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl._utils import seed_generator
from torchrl.collectors import (
    AsyncCollector,
    BaseCollector,
    Collector,
    MultiAsyncCollector,
    MultiSyncCollector,
)
from torchrl.envs import Compose, EnvBase, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.transforms import CatFrames, RewardSum, StepCounter, VecNormV2
from torchrl.envs.utils import check_env_specs, step_mdp
from torchrl.objectives.value import GAE

from franka_wm.envs import FrankaConfig, FrankaEnv, TransformedFrankaEnv, franka
from franka_wm.errors import UserError

N, T, LENGTH, LIMIT = 3, 14, 5, 3
OPTIONS = {
    "substeps": 2, "gravity_compensation": True, "observations": ("state", "joint_target"), "episode_length": LENGTH,
    "goal_sampling": "reachable", "terminate_on_success": True, "success_distance": 0.3,
}  # fmt: skip
cloudpickle.register_pickle_by_value(sys.modules[__name__])  # other processes need not find this file
SEEN = ("state", "joint_target", "goal", "success", "is_init")
AFTER = (*SEEN, "reward", "done", "terminated", "truncated")


def make(auto_reset: str = "native", seed: int | None = 0) -> FrankaEnv:
    """A cheap arm whose episodes end by success and by time."""
    return FrankaEnv(FrankaConfig(**OPTIONS, auto_reset=auto_reset), num_envs=N, device="cpu", seed=seed)


class Wave(TensorDictModuleBase):
    """Actions by what is seen alone, so that a wrong observation shows in all that follows."""

    in_keys = ["state"]
    out_keys = ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", (7.0 * tensordict["state"][..., :7]).sin())


# -- the plain loop ------------------------------------------------------------------------------------------


def plain_loop(env: FrankaEnv, steps: int = T, limit: int = 10**6) -> TensorDict:
    """(N, T): ``step`` and, where a world is done, a reset of it. Sums and counts are kept by hand.

    ``limit`` ends episodes as ``StepCounter(max_steps=limit)`` does.
    """
    root = env.reset()
    total, age = torch.zeros(N, 1), torch.zeros(N, 1, dtype=torch.int64)
    rows = []
    for _ in range(steps):
        row = {key: root[key].clone() for key in SEEN} | {"episode_reward": total, "step_count": age}
        action = Wave()(root.clone())["action"]
        after = env.step(TensorDict({"action": action}, batch_size=[N]))["next"]
        total, age = total + after["reward"], age + 1
        over = age >= limit
        done = after["done"] | over
        ends = {"done": done, "truncated": after["truncated"] | over, "terminated": after["terminated"]}
        following = {key: after[key].clone() for key in AFTER} | ends
        following |= {"episode_reward": total, "step_count": age}
        rows.append(TensorDict(row | {"action": action, "next": TensorDict(following, [N])}, [N]))
        root = after.select(*SEEN)
        if done.any():
            first = env.reset(TensorDict({"_reset": done, "done": done.clone()}, [N])).select(*SEEN)
            root = torch.where(done.squeeze(-1), first, root)
        total, age = total * ~done, age * ~done
    return torch.stack(rows, 1)


@pytest.fixture(scope="module")
def arm() -> FrankaEnv:
    return make("standard")


@pytest.fixture(scope="module")
def plain(arm: FrankaEnv) -> Callable[..., TensorDict]:
    """What a plain loop sees from seed 0, and with a limit of its own to episodes."""
    known: dict[tuple[int, int], TensorDict] = {}

    def loop(seed: int = 0, limit: int = 10**6) -> TensorDict:
        if (seed, limit) not in known:
            arm.set_seed(seed)
            known[seed, limit] = plain_loop(arm, limit=limit)
        return known[seed, limit]

    return loop


def check(data: TensorDictBase, expected: TensorDictBase) -> None:
    """Whether all that both have is the same: true last observations, first observations, flags, sums."""
    for name in (*SEEN, "action", "episode_reward", "step_count", *(("next", key) for key in AFTER)):
        if name in data.keys(True):
            assert torch.equal(data[name], expected[name]), name
    for name in ("episode_reward", "step_count"):
        if ("next", name) in data.keys(True):
            torch.testing.assert_close(data["next", name], expected["next", name])
    assert not any(value.isnan().any() for value in data.values(True, True))


def test_the_plain_loop_has_every_end(plain, arm: FrankaEnv) -> None:
    """Worlds end by time and by success and at different steps; episode k is the one that the k-th reset begins."""
    data = plain()
    ends = data["next"]
    assert ends["terminated"].any() and ends["truncated"].any()
    assert (ends["done"].any(0) != ends["done"].all(0)).any()
    arm.set_seed(0)
    firsts = torch.stack([arm.reset()["state"] for _ in range(T)])
    for world in range(N):
        begun = data["state"][world][data["is_init"][world].squeeze(-1)]
        assert len(begun) > 2 and torch.equal(begun, firsts[: len(begun), world])


# -- wrappers of one environment -----------------------------------------------------------------------------


def counters() -> Compose:
    return Compose(RewardSum(), StepCounter())


WRAPPERS: dict[str, Callable[[FrankaEnv], EnvBase]] = {
    "bare": lambda env: env,
    "RewardSum": lambda env: TransformedEnv(env, RewardSum()),
    "Compose": lambda env: TransformedEnv(
        env,
        Compose(RewardSum(), StepCounter(), CatFrames(N=3, dim=-1, in_keys=["state"], out_keys=["history"])),
    ),
    "append_transform": lambda env: env.append_transform(RewardSum()).append_transform(StepCounter()),
    "TorchRL's in TorchRL's": lambda env: TransformedEnv(
        TransformedEnv(env, RewardSum()), StepCounter(), auto_unwrap=False
    ),
    "ours": lambda env: TransformedFrankaEnv(env, counters()),
    "ours, append_transform": lambda env: TransformedFrankaEnv(env, RewardSum()).append_transform(
        StepCounter()
    ),
    "ours in ours": lambda env: TransformedFrankaEnv(TransformedFrankaEnv(env, RewardSum()), StepCounter()),
    "ours in TorchRL's": lambda env: TransformedEnv(TransformedFrankaEnv(env, RewardSum()), StepCounter()),
    "TorchRL's in ours": lambda env: TransformedFrankaEnv(TransformedEnv(env, RewardSum()), StepCounter()),
    "VecNorm": lambda env: TransformedEnv(env, VecNormV2(in_keys=["state"], out_keys=["normal"])),
    "VecNorm in ours": lambda env: TransformedFrankaEnv(
        env, VecNormV2(in_keys=["state"], out_keys=["normal"])
    ),
    "limit": lambda env: TransformedEnv(env, Compose(RewardSum(), StepCounter(max_steps=LIMIT))),
    "limit in ours": lambda env: TransformedFrankaEnv(
        env, Compose(RewardSum(), StepCounter(max_steps=LIMIT))
    ),
}


def by_hand(env: EnvBase) -> TensorDictBase:
    """``step`` and ``maybe_reset``, as in TorchRL's tutorials."""
    root, rows = env.reset(), []
    for _ in range(T):
        step = env.step(Wave()(root))
        rows.append(step.clone())
        root = env.maybe_reset(step_mdp(step))
    return torch.stack(rows, root.batch_dims)


def by_step_and_maybe_reset(env: EnvBase) -> TensorDictBase:
    root, rows = env.reset(), []
    for _ in range(T):
        step, root = env.step_and_maybe_reset(Wave()(root))
        rows.append(step.clone())
    return torch.stack(rows, root.batch_dims)


def by_rollout(env: EnvBase) -> TensorDictBase:
    """Two, the second of which goes on where the first ended."""
    first = env.rollout(T // 2, Wave(), break_when_any_done=False)
    root = env.maybe_reset(step_mdp(first[..., -1].clone()))
    rest = env.rollout(T - T // 2, Wave(), break_when_any_done=False, auto_reset=False, tensordict=root)
    return torch.cat([first, rest], -1)


def by_collector(env: EnvBase) -> TensorDictBase:
    """In two batches."""
    frames = T // 2 * env.batch_size.numel()
    collector = Collector(env, Wave(), frames_per_batch=frames, total_frames=2 * frames)
    data = torch.cat([batch.clone() for batch in collector], -1)
    collector.shutdown(close_env=False)
    return data


DRIVERS = [by_hand, by_step_and_maybe_reset, by_rollout, by_collector]


@pytest.fixture(scope="module", params=["native", "standard"])
def env(request) -> FrankaEnv:
    return make(request.param)


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize("drive", DRIVERS)
def test_episodes_are_those_of_a_plain_loop(env, plain, wrapper: str, drive) -> None:
    env.set_seed(0)
    wrapped = WRAPPERS[wrapper](env)
    data = drive(wrapped)
    check(data, plain(limit=LIMIT if "limit" in wrapper else 10**6))
    assert (("next", "episode_reward") in data.keys(True)) == (
        "bare" not in wrapper and "VecNorm" not in wrapper
    )


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_specs_hold(env, wrapper: str) -> None:
    check_env_specs(WRAPPERS[wrapper](env))


def test_stacked_frames_begin_anew_in_their_own_world(env, plain) -> None:
    env.set_seed(0)
    data = by_collector(WRAPPERS["Compose"](env))
    env.set_seed(0)
    frames = CatFrames(N=3, dim=-1, in_keys=["state"], out_keys=["history"])
    ours = by_collector(TransformedFrankaEnv(env, frames))
    assert torch.equal(data["history"], ours["history"])
    assert torch.equal(data["next", "history"], ours["next", "history"])
    first = plain()["is_init"].squeeze(-1)
    assert torch.equal(data["history"][first], plain()["state"][first].repeat(1, 3))


def test_stacked_pictures_are_those_of_a_bare_environment(env) -> None:
    config = replace(env.config, observations=("pixels", "state"), image_size=8, frame_stack=3)
    arm, seen = FrankaEnv(config, num_envs=N, device="cpu", seed=0), []
    for wrapper in ("bare", "RewardSum", "ours"):
        for drive in (by_hand, by_step_and_maybe_reset):
            arm.set_seed(0)
            seen.append(drive(WRAPPERS[wrapper](arm)))
    for data in seen[1:]:
        assert torch.equal(data["pixels"], seen[0]["pixels"])
        assert torch.equal(data["next", "pixels"], seen[0]["next", "pixels"])
    root = arm.reset()
    for _ in range(LENGTH + 2):  # beyond the end, without a reset, the episode goes on
        after = arm.step(Wave()(root.clone()))["next"]
        assert torch.equal(after["pixels"][..., :6], root["pixels"][..., 3:])
        root = after.select("state", "pixels")


@pytest.mark.parametrize("drive", DRIVERS[1:])
def test_what_is_normalised_is_counted_once(env, drive) -> None:
    """The numbers of ``VecNorm`` depend on how often it is called."""
    env.set_seed(0)
    expected = by_hand(WRAPPERS["VecNorm"](env))
    for wrapper in ("VecNorm", "VecNorm in ours"):
        env.set_seed(0)
        data = drive(WRAPPERS[wrapper](env))
        inside = slice(None) if drive is not by_rollout else slice(T // 2)
        assert torch.equal(data["next", "normal"][:, inside], expected["next", "normal"][:, inside]), wrapper


def test_a_rollout_until_all_are_done(env, plain) -> None:
    """Finished worlds wait for the others: what they did last stands, and they are counted once."""
    env.set_seed(0)
    env.statistics()
    wrapped = TransformedEnv(env, RewardSum())
    data = wrapped.rollout(LENGTH + 1, Wave(), break_when_any_done=False, break_when_all_done=True)
    expected = plain()
    for world in range(N):
        end = int(expected["next", "done"][world].squeeze(-1).int().argmax())
        assert torch.equal(
            data["next", "episode_reward"][world, -1], expected["next", "episode_reward"][world, end]
        )
        assert torch.equal(data["next", "state"][world, -1], expected["next", "state"][world, end])
    assert data["next", "done"][:, -1].all()
    assert env.statistics()["episodes"] == N


def test_a_finished_world_stays_so_until_its_reset(env) -> None:
    env.set_seed(0)
    root, seen = env.reset(), torch.zeros(N, 1, dtype=torch.bool)
    for _ in range(LENGTH + 2):
        after = env.step(Wave()(root))["next"]
        assert (after["done"] | ~seen).all()
        seen |= after["done"]
        root = after.select(*SEEN)
    assert seen.all()
    assert env.reset()["is_init"].all()


def test_a_bare_native_step_restarts_by_itself(monkeypatch) -> None:
    """The fast path is taken: no mask is read from the device, and no reset is launched beside the step."""
    env, asked = make("native"), []
    root = env.reset()
    monkeypatch.setattr(env, "maybe_reset", lambda *_: asked.append("maybe_reset"))
    monkeypatch.setattr(env, "_reset", lambda *_: asked.append("_reset"))
    for _ in range(2 * LENGTH):
        _, root = env.step_and_maybe_reset(Wave()(root))
    assert asked == [] and env.statistics()["episodes"] >= N


def test_ours_does_not_ask_the_device(env, monkeypatch) -> None:
    wrapped, asked = TransformedFrankaEnv(env, counters()), []
    monkeypatch.setattr(EnvBase, "any_done", lambda *_: asked.append("any_done"))
    wrapped.step_and_maybe_reset(Wave()(wrapped.reset()))
    assert (asked == []) == (env.config.auto_reset == "native")


# -- advantages ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrapper", ["RewardSum", "ours", "ours in ours"])
def test_advantages_are_those_of_a_plain_loop(env, plain, wrapper: str) -> None:
    env.set_seed(0)
    data = by_collector(WRAPPERS[wrapper](env))
    value = torch.nn.Linear(20, 1)
    with torch.no_grad():
        torch.nn.init.constant_(value.weight, 0.1)
    gae = GAE(gamma=0.9, lmbda=0.9, value_network=TensorDictModule(value, ["state"], ["state_value"]))
    got, expected = (gae(d.clone())["advantage"] for d in (data, plain()))
    assert got.isfinite().all()
    torch.testing.assert_close(got, expected)


# -- several environments ------------------------------------------------------------------------------------


BATCHED: dict[str, Callable[[str], EnvBase]] = {
    "SerialEnv": lambda mode: SerialEnv(2, lambda: make(mode)),
    "SerialEnv of transformed": lambda mode: SerialEnv(2, lambda: TransformedEnv(make(mode), counters())),
    "SerialEnv of ours": lambda mode: SerialEnv(2, lambda: TransformedFrankaEnv(make(mode), counters())),
    "transformed SerialEnv": lambda mode: TransformedEnv(SerialEnv(2, lambda: make(mode)), counters()),
    "ours of SerialEnv": lambda mode: TransformedFrankaEnv(SerialEnv(2, lambda: make(mode)), counters()),
}


@pytest.mark.parametrize("auto_reset", ["native", "standard"])
@pytest.mark.parametrize("wrapper", list(BATCHED))
def test_episodes_of_several_environments(plain, wrapper: str, auto_reset: str) -> None:
    env = BATCHED[wrapper](auto_reset)
    seeds = [0, seed_generator(0)]
    for drive in DRIVERS:
        env.set_seed(0)
        data = drive(env)
        for k, seed in enumerate(seeds):
            check(data[k], plain(seed))


def test_environments_without_a_seed_play_their_own_episodes(monkeypatch) -> None:
    def goals() -> torch.Tensor:
        env = SerialEnv(2, lambda: make(seed=None))
        goal = env.reset()["goal"].clone()
        env.close()
        return goal

    monkeypatch.setattr(franka, "_unseeded", count())
    first = goals()
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first, goals())
    monkeypatch.setattr(franka, "_unseeded", count())  # as when the program is run again
    assert torch.equal(first, goals())
    for rank in ("0", "1"):  # torchrun's processes count alike, and are no children
        monkeypatch.setattr(franka, "_unseeded", count())
        monkeypatch.setenv("RANK", rank)
        assert torch.equal(first, goals()) is (rank == "0")


def test_a_seed_that_is_given_decides_alone() -> None:
    first, second = (make(seed=0).reset() for _ in range(2))
    assert torch.equal(first["goal"], second["goal"]) and torch.equal(first["state"], second["state"])
    assert not torch.equal(first["goal"], make(seed=1).reset()["goal"])


def modes() -> list[Callable[[], EnvBase]]:
    """Worlds for two processes, each with its own auto-reset."""
    return [
        lambda: TransformedEnv(make("native", seed=None), RewardSum()),
        lambda: TransformedEnv(make("standard", seed=None), RewardSum()),
    ]


@pytest.mark.slow
def test_processes(plain) -> None:
    """Workers have episodes of their own; seeded, they are those of plain loops."""
    env = ParallelEnv(2, modes())
    try:
        goal = env.reset()["goal"].clone()
        assert not torch.equal(goal[0], goal[1])
        env.set_seed(0)
        data = by_rollout(env)
        for k, seed in enumerate([0, seed_generator(0)]):
            check(data[k], plain(seed))
    finally:
        env.close()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [AsyncCollector, MultiSyncCollector, MultiAsyncCollector])
def test_collectors_of_other_processes(plain, kind: type[BaseCollector]) -> None:
    workers = [lambda mode=mode: TransformedEnv(make(mode), counters()) for mode in ("native", "standard")]
    collector = kind(
        workers[0] if kind is AsyncCollector else workers,
        policy_factory=lambda: Wave(),
        frames_per_batch=N * T * (2 if kind is MultiSyncCollector else 1),  # of all of them, or of each
        total_frames=2 * N * T,
    )
    try:
        batch = next(iter(collector))
        for data in batch if kind is MultiSyncCollector else [batch]:
            check(data, plain())
    finally:
        collector.shutdown()


def test_a_state_is_put_back_below_the_transforms() -> None:
    env = TransformedFrankaEnv(make(), StepCounter())
    env.reset()
    state = env.get_state()
    with pytest.raises(UserError, match=r"transforms have memories of their own; call base_env\.set_state"):
        env.set_state(state)
    assert env.base_env.set_state(state).batch_size == (N,)
