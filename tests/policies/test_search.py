# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false, reportOptionalMemberAccess=false, reportIncompatibleMethodOverride=false
import copy
import pickle
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type

from franka_wm import models
from franka_wm.models import WorldModel
from franka_wm.planning import MCTS
from franka_wm.policies import SearchPolicy
from franka_wm.seeding import drawing_for

compiled = torch.compile
LEFT, RIGHT, STAY = 0, 1, 2


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


class Line(EnvBase):
    """N walkers on a line; a step costs the distance to 3."""

    def __init__(self, n: int = 4) -> None:
        super().__init__(device="cpu", batch_size=[n])
        self.observation_spec = Composite(state=Unbounded((n, 1)), shape=(n,))
        self.action_spec = Categorical(3, shape=(n,), dtype=torch.int64)
        self.reward_spec = Unbounded((n, 1))

    def _reset(self, tensordict=None):
        self.state = torch.arange(self.batch_size[0]).float().unsqueeze(-1) * 2
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict({"state": self.state, "done": done, "terminated": done.clone()}, self.batch_size)

    def _step(self, tensordict):
        self.state = move(self.state, tensordict["action"])
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict(
            {
                "state": self.state,
                "reward": -(self.state - 3).abs(),
                "done": done,
                "terminated": done.clone(),
            },
            self.batch_size,
        )

    def _set_seed(self, seed): ...


def move(state, action):
    return state + torch.tensor([-1.0, 1.0, 0.0])[action].unsqueeze(-1)


class Known(WorldModel):
    """The line's own law as a model, without an opinion of its own."""

    num_actions = 3

    def __init__(self) -> None:
        super().__init__()
        self.observation_sizes = {"state": 1}
        self.gain = nn.Parameter(torch.ones(()))

    def encode(self, observation):
        return observation.get("state") * self.gain

    def prediction(self, z):
        return torch.zeros(len(z), 3), -5.0 * (z - 3).abs()

    def recurrent(self, z, action):
        after = move(z, action)
        return after, -(after - 3).abs(), torch.full_like(z, 0.9), *self.prediction(after)


def acting(variant="puct", kernels=None, **options) -> SearchPolicy:
    search = MCTS(num_actions=3, num_simulations=24, variant=variant, kernels=kernels)
    return SearchPolicy.for_model(Known(), search, **options)


def test_the_toy_environment_is_sound():
    check_env_specs(Line())


@pytest.mark.parametrize("variant", ["puct", "gumbel"])
def test_it_acts_well_and_records_what_a_model_learns_from(variant):
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = Line().rollout(6, acting(variant))
    assert (rollout["next", "state"][:, -1] == 3).all()
    assert rollout["action"].shape == (4, 6) and rollout["action"].dtype == torch.int64
    assert rollout["search_policy"].shape == (4, 6, 3) and rollout["search_value"].shape == (4, 6, 1)
    torch.testing.assert_close(rollout["search_policy"].sum(-1), torch.ones(4, 6))
    assert not rollout["search_value"].requires_grad


def test_it_runs_inside_a_collector():
    collector = Collector(Line(), acting(), frames_per_batch=4 * 5, total_frames=4 * 10)
    batches = list(collector)
    collector.shutdown()
    assert len(batches) == 2 and batches[0]["search_policy"].shape == (4, 5, 3)


def test_exploration_follows_torchrl_unless_told():
    start = TensorDict({"state": torch.full((200, 1), 3.0)}, [200])

    def distinct(explore, kind):
        policy = acting(explore=explore)
        with set_exploration_type(kind):
            return len(policy(start.clone())["action"].unique())

    assert distinct(None, ExplorationType.RANDOM) > 1
    assert distinct(None, ExplorationType.DETERMINISTIC) == 1
    assert distinct(True, ExplorationType.DETERMINISTIC) > 1
    assert distinct(False, ExplorationType.RANDOM) == 1


def test_a_copy_of_the_policy_uses_its_own_model():
    original = acting(explore=False)
    duplicate = copy.deepcopy(original)
    with torch.no_grad():
        duplicate.model.gain.zero_()
    start = TensorDict({"state": torch.full((2, 1), 6.0)}, [2])
    assert (original(start.clone())["action"] == LEFT).all()
    assert (duplicate(start.clone())["action"] == RIGHT).all()  # it believes to be at 0


def test_a_captured_search_is_of_one_share_of_the_worlds(monkeypatch):
    """It draws for some of the worlds; another share of them must not replay it."""
    monkeypatch.setattr("franka_wm.policies.search.captures", lambda *_: True)
    policy, keys = acting(explore=True), []
    policy._graphs = lambda decide, inputs, *, key, **_: (keys.append(key), decide(inputs))[1]
    start = TensorDict({"state": torch.full((2, 1), 3.0)}, [2])
    for first in (0, 0, 2):
        with drawing_for(first, 2, 4):
            policy(start.clone())
    assert keys[0] == keys[1] != keys[2]


@pytest.mark.parametrize(("kernels", "program"), [(True, "ask"), (False, "recurrent")])
def test_a_compiled_search_decides_the_same(monkeypatch, kernels, program):
    """In kernels the model is one program with what is read from the tree and written back."""
    calls = []

    def compile(function, **options):
        calls.append((function.__name__, options["options"]))
        return compiled(function, backend="eager", dynamic=options["dynamic"])

    monkeypatch.setattr(torch, "compile", compile)
    start = TensorDict({"state": torch.randn(8, 1)}, [8])
    plain, fast = (
        acting(explore=False, compile=wanted, kernels=kernels)(start.clone()) for wanted in (False, True)
    )
    assert calls == [(program, {"cpp_wrapper": True})]
    for key in ("action", "search_policy", "search_value"):
        torch.testing.assert_close(plain[key], fast[key])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda policy: pickle.loads(pickle.dumps(policy))])
@pytest.mark.parametrize("kernels", [True, False])
def test_a_copy_of_a_compiled_search_asks_its_own_model(monkeypatch, kernels, copied):
    monkeypatch.setattr(torch, "compile", lambda function, **_: compiled(function, backend="eager"))
    model = models.make("muzero", observation_sizes={"state": 1}, num_actions=3, latent_dim=8, hidden_dim=8)
    search = MCTS(num_actions=3, num_simulations=2, kernels=kernels)
    policy = SearchPolicy.for_model(model, search, explore=False, compile=True)
    start = TensorDict({"state": torch.ones(2, 1)}, [2])
    policy(start.clone())  # it has compiled
    other = copied(policy)
    with torch.no_grad():
        for parameter in other.model.parameters():
            parameter.normal_()
    wanted = SearchPolicy.for_model(other.model, search, explore=False)(start.clone())
    torch.testing.assert_close(other(start.clone())["search_value"], wanted["search_value"])


@pytest.mark.slow
def test_a_search_that_is_really_compiled_decides_the_same():
    model = models.make("muzero", observation_sizes={"state": 1}, num_actions=3, latent_dim=8, hidden_dim=8)
    plain, fast = (
        SearchPolicy.for_model(model, MCTS(num_actions=3, num_simulations=8), explore=False, compile=wanted)
        for wanted in (False, True)
    )
    for worlds in (1, 3):
        start = TensorDict({"state": torch.randn(worlds, 1)}, [worlds])
        for key in ("action", "search_policy", "search_value"):
            torch.testing.assert_close(plain(start.clone())[key], fast(start.clone())[key])


def test_a_compiled_search_stays_compiled_for_many_numbers_of_worlds(monkeypatch):
    from torch._dynamo import config, reset

    reset()
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    with config.patch(recompile_limit=8, fail_on_recompile_limit_hit=True):  # the limit is torch's own
        policy = acting(compile=True)
        for worlds in range(1, 13):
            assert policy(TensorDict({"state": torch.ones(worlds, 1)}, [worlds]))["action"].shape == (worlds,)


def test_mistakes_are_named():
    with pytest.raises(ValueError, match=r"batch size \[E\]"):
        acting()(TensorDict({"state": torch.zeros(2, 3, 1)}, [2, 3]))
    with pytest.raises(ValueError, match="no prediction and recurrent"):
        SearchPolicy.for_model(WorldModel(), MCTS(num_actions=3))
    with pytest.raises(ValueError, match="num_actions=4"):
        SearchPolicy.for_model(Known(), MCTS(num_actions=4))
