"""Decisions as CUDA graphs: when one is captured, what it remembers, and, on a GPU, that it decides the same."""

import copy
import pickle
from contextlib import contextmanager, nullcontext

import pytest
import torch
from tensordict import TensorDict

from franka_wm import models
from franka_wm.errors import CaptureError
from franka_wm.planning import CEM, MCTS, MPPI
from franka_wm.planning.objectives import ActionPenalty, GoalDistance, Sum
from franka_wm.policies import ModelPolicy, PlannerPolicy, SearchPolicy, capture
from franka_wm.policies.capture import GraphCache
from franka_wm.seeding import drawing_for

on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


@pytest.fixture(autouse=True)
def _on_the_cpu(monkeypatch, request):
    """Stand-ins for graphs run on the CPU, also where there is a GPU; `torch.cuda.device` refuses that device."""
    if request.node.get_closest_marker("gpu"):
        return
    real = torch.cuda.device

    def device(asked):
        return nullcontext() if isinstance(asked, torch.device) and asked.type == "cpu" else real(asked)

    monkeypatch.setattr(torch.cuda, "device", device)


class FakeGraph:
    """Replays by running the work again on the captured memory, as a graph does."""

    def __init__(self, work, inputs, outputs):
        self.work, self.inputs, self.outputs = work, inputs, outputs

    def replay(self):
        self.outputs.update_(self.work(self.inputs))


@pytest.fixture
def recorded(monkeypatch):
    """How often a capture took place, without a GPU."""
    count = []

    def record(work, inputs, held):
        count.append(1)
        static = inputs.clone()
        outputs = work(static).clone()
        return capture._Graph(FakeGraph(work, static, outputs), static, outputs, held)  # type: ignore[arg-type]

    monkeypatch.setattr(capture, "_record", record)
    monkeypatch.setattr(capture, "_beside", lambda work, inputs: work(inputs))
    return count


def double(entries):
    return TensorDict({"y": 2 * entries["x"]}, batch_size=entries.batch_size)


def numbers(value, size=3):
    return TensorDict({"x": torch.full((size,), float(value))}, batch_size=[size])


def test_the_third_call_of_a_kind_is_captured_and_sees_new_inputs(recorded):
    cache = GraphCache()
    results = [cache(double, numbers(n)) for n in range(6)]
    assert len(recorded) == 1
    for n, result in enumerate(results):  # none was overwritten by a later one
        assert (result["y"] == 2 * n).all()


def test_kinds_are_kept_apart(recorded):
    cache, one, other = GraphCache(), object(), object()
    for _ in range(4):
        for size in (2, 3):
            for key in ("a", "b"):
                for held in (one, other):
                    assert cache(double, numbers(1, size), key=key, held=(held,))["y"].shape == (size,)
    assert len(recorded) == 8


def test_the_graph_not_used_for_longest_is_forgotten(recorded):
    cache = GraphCache(keep=2)
    for key in "abab" * 2 + "ccc":
        cache(double, numbers(1), key=key)
    assert len(recorded) == 3 and len(cache._graphs) == 2
    assert [kind[0] for kind in cache._graphs] == ["b", "c"]  # type: ignore[index]


def test_a_failed_capture_gives_the_generator_back(monkeypatch):
    """The steps of a capture, with stand-ins for CUDA's."""
    given = []

    class Noise:
        def __init__(self, device=None, state="before"):
            self.state = state

        def get_state(self):
            return self.state

        def set_state(self, state):
            self.state = state

        graphsafe_get_state = get_state
        graphsafe_set_state = given.append

    @contextmanager
    def refuse(graph, pool, capture_error_mode):
        assert (pool, capture_error_mode) == ("pool", "thread_local")
        yield
        raise RuntimeError("operation not permitted")

    ended = []
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: "pool")
    monkeypatch.setattr(
        torch._C, "_cuda_endAllocateToPool", lambda *which: ended.append(which), raising=False
    )
    monkeypatch.setattr(torch.cuda, "CUDAGraph", object)
    monkeypatch.setattr(torch.cuda, "default_generators", (Noise(),))
    monkeypatch.setattr(torch.cuda, "graph", refuse)
    monkeypatch.setattr(torch, "Generator", Noise)
    with pytest.raises(CaptureError, match="give capture=False"):
        capture._record(double, numbers(1), ())
    assert given == ["before"] and ended == [(0, "pool")]


def test_copies_have_no_graphs(recorded):
    cache = GraphCache(keep=5)
    for n in range(3):
        cache(double, numbers(n))
    for twin in (copy.deepcopy(cache), pickle.loads(pickle.dumps(cache))):
        assert not twin._graphs and twin.keep == 5


def test_a_policy_captures_anew_when_settings_mode_or_planner_change(recorded, monkeypatch):
    model = small_model()
    policy = PlannerPolicy.for_model(model, small(MPPI), explore=False)
    monkeypatch.setattr("franka_wm.policies.planner.captures", lambda wanted, observation: True)

    def decide():
        for _ in range(3):
            policy(observation(4))

    decide()
    assert len(recorded) == 1
    for change in (
        lambda: setattr(policy.planner, "temperature", 2.0),
        lambda: setattr(policy, "planner", small(CEM)),
        lambda: model.eval(),
        lambda: setattr(policy, "explore", True),
        lambda: setattr(policy, "precision", "bfloat16"),
    ):
        before = len(recorded)
        decide()
        assert len(recorded) == before
        change()
        decide()
        assert len(recorded) == before + 1


def test_a_captured_plan_is_of_one_share_of_the_worlds(monkeypatch):
    """It draws for some of the worlds; another share of them must not replay it."""
    monkeypatch.setattr("franka_wm.policies.planner.captures", lambda *_: True)
    policy, keys = PlannerPolicy.for_model(small_model(), small(MPPI), explore=True), []
    policy._graphs = lambda decide, inputs, *, key, **_: (keys.append(key), decide(inputs))[1]  # type: ignore[assignment]
    for first in (0, 0, 2):
        with drawing_for(first, 2, 4):
            policy(observation(2))
    assert keys[0] == keys[1] != keys[2]


def test_a_policy_captures_anew_when_its_objective_changes(recorded, monkeypatch):
    """Another goal, or another weight within a sum: the old graph would go on planning to the old one."""
    model = small_model()
    with torch.no_grad():
        goals = model.encode(observation(2))
    distance, penalty = GoalDistance(goals[0]), ActionPenalty(0.1)
    policy = PlannerPolicy.for_model(
        model, small(MPPI), objective=Sum([(1.0, distance), (1.0, penalty)]), explore=False
    )
    monkeypatch.setattr("franka_wm.policies.planner.captures", lambda wanted, observation: True)

    seen = observation(4)

    def decide():
        for _ in range(3):
            policy(seen.clone())
        torch.manual_seed(0)
        return policy(seen.clone())["action"]

    first = decide()
    assert torch.equal(decide(), first) and len(recorded) == 1
    distance.goal_latent = goals[1]
    assert not torch.equal(decide(), first) and len(recorded) == 2
    penalty.weight = 10.0
    decide()
    assert len(recorded) == 3
    distance.goal_latent = goals[0]
    penalty.weight = 0.1
    assert torch.equal(decide(), first) and len(recorded) == 3  # kept


def test_an_actor_is_captured_anew_for_another_mode_number_or_share_of_the_worlds(recorded, monkeypatch):
    monkeypatch.setattr("franka_wm.policies.planner.captures", lambda *_: True)
    model = small_model()
    actor, found = ModelPolicy.for_model(model, explore=False), []

    def decide():
        found.extend(actor(observation(4))["action"] for _ in range(3))
        return len(recorded)

    assert (decide(), decide()) == (1, 1)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1)
    assert decide() == 1 and not torch.equal(found[-1], found[0])  # it reads the weights of now
    actor.explore = True
    assert decide() == 2
    model.eval()
    assert decide() == 3
    with drawing_for(0, 4, 8):
        assert decide() == 4
    model.discount = 0.5  # a number that its methods may read
    assert decide() == 5


class Held:
    """Something that a graph reads from."""


def test_early_calls_count_for_their_objects_alone(recorded):
    """Others at the address of one that is gone have not been called yet."""
    cache = GraphCache()
    for n in range(6):
        cache(double, numbers(n), held=(Held(),))
    assert not recorded


def test_no_capture_on_the_cpu_unless_asked_for(recorded):
    policy = PlannerPolicy.for_model(small_model(), small(MPPI))
    for _ in range(4):
        policy(observation(2))
    assert not recorded


def small_model(device="cpu"):
    torch.manual_seed(0)
    return models.make(
        "tdmpc2",
        observation_sizes={"state": 6},
        action_dim=2,
        episode_length=20,
        latent_dim=16,
        encoder_dim=16,
        hidden_dim=16,
    ).to(device)


def small(planner):
    return planner(action_dim=2, horizon=2, num_samples=16, num_elites=4, iterations=2, num_policy_samples=2)


def observation(envs, device="cpu", seed=0):
    generator = torch.Generator().manual_seed(seed)
    entries = {
        "state": torch.randn(envs, 6, generator=generator),
        "plan": torch.zeros(envs, 2, 2),
        "is_init": torch.zeros(envs, 1, dtype=torch.bool),
    }
    return TensorDict(entries, batch_size=[envs]).to(device)


# -- on a GPU ---------------------------------------------------------------------------------------------


@pytest.mark.gpu
@on_gpu
@pytest.mark.parametrize("explore", [False, True])
def test_captured_plans_are_the_eager_ones(explore):
    """With the same seed: noise goes on from where the default generator stands, in a graph as outside."""
    model = small_model("cuda")
    eager, captured = (
        PlannerPolicy.for_model(model, small(MPPI), explore=explore, capture=wanted)
        for wanted in (False, True)
    )
    for seed in range(6):
        torch.manual_seed(seed)
        expected = eager(observation(8, "cuda", seed))
        torch.manual_seed(seed)
        found = captured(observation(8, "cuda", seed))
        for key in ("action", "plan"):
            torch.testing.assert_close(found[key], expected[key], rtol=1e-3, atol=1e-4)
    assert len(captured._graphs._graphs) == 1


@pytest.mark.gpu
@on_gpu
@pytest.mark.parametrize("explore", [False, True])
@pytest.mark.parametrize("name", ["tdmpc2", "dreamer"])
def test_captured_actors_are_the_eager_ones(name, explore):
    """Dreamer's carries its memory from decision to decision."""
    model = small_model("cuda")
    if name == "dreamer":
        sizes = dict(deter_dim=16, hidden_dim=16, codes=3, classes=4, blocks=2, bins=41)
        model = models.make(name, observation_sizes={"state": 6}, action_dim=2, discount=0.9, **sizes).cuda()
    found = []
    for wanted in (False, True):
        actor, carried, actions = ModelPolicy.for_model(model, explore=explore, capture=wanted), None, []
        for seed in range(6):
            seen = observation(8, "cuda", seed)
            if carried is not None:
                seen.update(carried.select("context", "context_action", strict=False))
            torch.manual_seed(seed)
            carried = actor(seen)
            actions.append(carried["action"])
        found.append(torch.stack(actions))
        assert len(actor._graphs._graphs) == int(wanted)
    torch.testing.assert_close(found[1], found[0], rtol=1e-3, atol=1e-4)


@pytest.mark.gpu
@on_gpu
def test_a_captured_decision_sees_new_weights():
    model = small_model("cuda").eval()
    policy = PlannerPolicy.for_model(model, small(MPPI), explore=False)
    for _ in range(4):
        torch.manual_seed(0)
        before = policy(observation(8, "cuda"))["action"]
    torch.manual_seed(0)
    assert torch.equal(policy(observation(8, "cuda"))["action"], before)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn_like(parameter))
    torch.manual_seed(0)
    assert not torch.equal(policy(observation(8, "cuda"))["action"], before)


@pytest.mark.gpu
@on_gpu
@pytest.mark.parametrize("variant", ["puct", "gumbel"])
@pytest.mark.parametrize("kernels", [False, True], ids=["plain", "kernels"])
def test_captured_searches_are_the_eager_ones(variant, kernels):
    torch.manual_seed(0)
    model = models.make("muzero", observation_sizes={"state": 6}, num_actions=5, latent_dim=16, hidden_dim=16)
    model = model.cuda().eval()
    # What is captured is compared with the plain search.
    plain, search = (
        MCTS(num_actions=5, num_simulations=12, variant=variant, kernels=fast) for fast in (False, kernels)
    )
    eager, captured = (
        SearchPolicy.for_model(model, one, explore=True, capture=wanted)
        for one, wanted in ((plain, False), (search, True))
    )
    agreeing = []
    for seed in range(6):
        found = []
        for policy in (eager, captured):
            torch.manual_seed(seed)
            found.append(policy(observation(64, "cuda", seed).select("state")))
        agreeing.append((found[0]["action"] == found[1]["action"]).float().mean())
        assert (found[0]["search_policy"].sum(-1) - 1).abs().max() < 1e-5
    assert torch.stack(agreeing).mean() > 0.95  # rounding may turn a tie
    assert len(captured._graphs._graphs) == 1


@pytest.mark.gpu
@on_gpu
def test_work_that_waits_for_the_device_is_refused_in_one_line():
    def waits(entries):
        return TensorDict({"y": entries["x"] * entries["x"].sum().item()}, batch_size=entries.batch_size)

    cache, inputs = GraphCache(), numbers(1).to("cuda")
    for _ in range(GraphCache.EAGER_CALLS):
        cache(waits, inputs)
    with pytest.raises(RuntimeError, match=r"trainer\.capture=false"):
        cache(waits, inputs)
    torch.cuda.synchronize()
    assert torch.randn(2, device="cuda").isfinite().all()  # the device goes on working, its generator, too
