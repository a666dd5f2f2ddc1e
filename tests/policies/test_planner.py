# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
import copy
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type

from franka_wm.models import WorldModel, make
from franka_wm.planning import CEM, ICEM, MPPI, GoalDistance, GoalImage, GradientPlanner
from franka_wm.planning.objectives import Objective
from franka_wm.policies import ModelPolicy, PlannerPolicy
from franka_wm.policies.planner import Guide
from points import GOAL, Points
from small_tdmpc2 import small, windows

HORIZON = 3


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


class Exact(WorldModel):
    """The points' own law as a world model."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_sizes = {"state": 2}
        self.gain = nn.Parameter(torch.ones(()))

    def encode(self, observation):
        return observation.get("state")

    def next(self, z, action):
        return z + self.gain * action


class Recording(MPPI):
    """MPPI that keeps what it was asked to start from."""

    def __init__(self, **settings) -> None:
        super().__init__(**settings)
        self.calls = []

    def plan(self, z, next, objective, **options):
        result = super().plan(z, next, objective, **options)
        self.calls.append((options["previous"], options["is_init"], result["plan"]))
        return result


def mppi(cls=MPPI):
    return cls(
        action_dim=2, horizon=HORIZON, num_samples=64, num_elites=8, num_policy_samples=4, iterations=3
    )


def policy(planner, **options) -> PlannerPolicy:
    return PlannerPolicy.for_model(
        Exact(), planner, objective=GoalDistance(torch.full((2,), GOAL)), **options
    )


def observation(n: int = 3) -> TensorDict:
    return TensorDict({"state": torch.randn(n, 2), "is_init": torch.ones(n, 1, dtype=torch.bool)}, [n])


def test_the_toy_environment_is_sound():
    check_env_specs(Points())


def test_a_collector_carries_the_plan_and_clears_it_where_an_episode_begins():
    planner = mppi(Recording)
    collector = Collector(
        TransformedEnv(Points(), InitTracker()), policy(planner), frames_per_batch=3 * 12, total_frames=3 * 24
    )
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    data = torch.cat(batches, dim=1)
    assert data.batch_size == (3, 24) and data["plan"].shape == (3, 24, HORIZON, 2)
    # where an episode begins: at the start, and after every truncation, each point at its own time
    begins = torch.cat((torch.ones(3, 1, 1, dtype=torch.bool), data["next", "done"][:, :-1]), dim=1)
    assert torch.equal(data["is_init"], begins)
    assert begins.sum(1).flatten().tolist() == [8, 6, 5]
    # the calls of the rollout itself; collectors may call the policy before, to learn its outputs
    calls = planner.calls[-24:]
    for t in range(1, 24):
        previous, is_init, _ = calls[t]
        assert previous is not None
        assert torch.equal(is_init, begins[:, t])
        inside = ~is_init.squeeze(-1)  # where an episode begins the collector may leave anything
        assert torch.equal(previous[inside], data["plan"][inside, t - 1])  # carried, across batches too
        assert previous[inside].abs().min() > 0


def test_what_is_carried_matters_only_within_an_episode():
    decided = policy(mppi(), explore=False)
    start = observation()
    misleading = torch.full((3, HORIZON, 2), -1.0)

    def act(td):
        torch.manual_seed(0)
        return decided(td)["plan"]

    cold = act(start.clone())
    assert torch.equal(act(start.clone().set("plan", misleading)), cold)
    inside = start.clone().set("is_init", torch.tensor([[True], [False], [True]])).set("plan", misleading)
    changed = (act(inside) != cold).flatten(1).any(1)
    assert changed.tolist() == [False, True, False]


def test_closed_loop_reaches_the_goal():
    env = TransformedEnv(Points(6), InitTracker())
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = env.rollout(3, policy(MPPI(action_dim=2, horizon=HORIZON, num_samples=256, num_elites=16)))
    assert (rollout["next", "state"][:, -1] - GOAL).norm(dim=-1).max() < 0.4


@pytest.mark.parametrize(
    "planner",
    [
        CEM(action_dim=2, horizon=HORIZON, num_samples=64, num_elites=8, iterations=3),
        ICEM(action_dim=2, horizon=HORIZON),
        GradientPlanner(action_dim=2, horizon=HORIZON, iterations=5),
    ],
    ids=lambda planner: type(planner).__name__,
)
def test_every_planner_acts_inside_a_collector_and_its_plan_is_carried(planner):
    env = TransformedEnv(Points(), InitTracker())
    collector = Collector(env, policy(planner), frames_per_batch=3 * 9, total_frames=3 * 18)
    data = torch.cat([batch.clone() for batch in collector], dim=1)
    collector.shutdown()
    shape = planner.plan(torch.zeros(3, 2), Exact().next, GoalDistance(torch.zeros(2)))["plan"].shape
    assert data["plan"].shape == (3, 18, *shape[1:])
    assert data["action"].abs().max() <= 1 and not data["action"].requires_grad
    # towards the goal in every episode, which no action and random actions are not
    assert (data["next", "state"] - data["state"]).mean() > 0.3
    assert data["next", "done"].sum(1).flatten().tolist() == [6, 4, 3]


def test_exploration_follows_torchrl_unless_told():
    def spread(explore, kind):
        torch.manual_seed(0)
        acting = policy(mppi(), explore=explore)
        with set_exploration_type(kind):
            td = acting(observation())
        return (td["action"] - td["plan"][:, 0]).abs().max()

    assert spread(None, ExplorationType.RANDOM) > 0
    assert spread(None, ExplorationType.DETERMINISTIC) == 0
    assert spread(True, ExplorationType.DETERMINISTIC) > 0
    assert spread(False, ExplorationType.RANDOM) == 0


def test_mistakes_are_named():
    acting = policy(mppi())
    with pytest.raises(ValueError, match="is_init"):
        acting(observation().exclude("is_init").set("plan", torch.zeros(3, HORIZON, 2)))
    with pytest.raises(ValueError, match="batch size"):
        acting(observation()[0])
    with pytest.raises(ValueError, match="objective"):
        PlannerPolicy.for_model(Exact(), mppi())
    with pytest.raises(ValueError, match=r"the plan reads state, which is not there, but .*goal.*; is it"):
        acting(observation().rename_key_("state", "goal"))


@pytest.mark.slow
@pytest.mark.parametrize("compile", [False, True])
def test_a_policy_may_be_given_another_objective(compile: bool):
    """A plain function, or one that reads the present observation, which the policy then asks for."""
    acting = policy(mppi(), compile=compile, explore=False)
    acting.plan_for(lambda trajectory, actions: -(actions - 0.5).square().sum((-2, -1)))
    torch.testing.assert_close(acting(observation())["action"], torch.full((3, 2), 0.5), atol=0.2, rtol=0)

    class Own(Objective):
        in_keys = ("wanted",)

        def bind(self, tensordict):
            return lambda z, actions: -(actions - tensordict["wanted"][:, None, None]).square().sum((-2, -1))

    acting.plan_for(Own())
    assert acting.in_keys == ["state", "wanted", "is_init"]

    class Learned(nn.Module):
        def forward(self, trajectory, actions):
            return -actions.square().sum((-2, -1))

    other = policy(mppi(), explore=False)
    other.plan_for(Learned())
    assert other(observation())["action"].abs().max() < 0.2
    asked = observation().set("wanted", torch.full((3, 2), -0.5))
    torch.testing.assert_close(acting(asked)["action"], asked["wanted"], atol=0.2, rtol=0)


def test_a_copy_of_the_policy_uses_its_own_model():
    """Collectors copy policies; a copy whose callables still point at the original would never be updated."""
    original = policy(mppi())
    duplicate = copy.deepcopy(original)
    assert {id(p) for p in duplicate.parameters()}.isdisjoint({id(p) for p in original.parameters()})
    with torch.no_grad():
        duplicate.model.gain.zero_()  # type: ignore[union-attr,operator]
    z, action = torch.zeros(1, 2), torch.ones(1, 2)
    assert duplicate.next(z, action).sum() == 0 and original.next(z, action).sum() == 2


def tdmpc2():
    return make(
        "tdmpc2",
        observation_sizes={"state": 2},
        action_dim=2,
        discount=0.9,
        latent_dim=16,
        encoder_dim=16,
        hidden_dim=16,
    )


def test_a_learned_model_plans_and_acts_inside_a_collector():
    model = tdmpc2().eval()
    acting = PlannerPolicy.for_model(model, mppi())
    assert acting.in_keys == ["state", "is_init"] and acting.out_keys == ["action", "plan"]
    env = TransformedEnv(Points(), InitTracker())
    for behaviour in (acting, ModelPolicy.for_model(model)):
        collector = Collector(env, behaviour, frames_per_batch=12, total_frames=12)
        (data,) = [batch.clone() for batch in collector]
        assert data["action"].abs().max() <= 1 and not data["action"].requires_grad


def test_the_model_policy_samples_or_takes_the_mode():
    model, td = tdmpc2(), observation()
    quiet, noisy = ModelPolicy.for_model(model, explore=False), ModelPolicy.for_model(model, explore=True)
    assert torch.equal(quiet(td.clone())["action"], quiet(td.clone())["action"])
    assert not torch.equal(noisy(td.clone())["action"], noisy(td.clone())["action"])
    mode = model.policy(model.encode(td), deterministic=True)
    assert torch.equal(quiet(td.clone())["action"], mode)


def opinionated(**sizes):
    """A model whose rewards, values and policy differ from action to action; untrained ones are zero."""
    model = make("tdmpc2", observation_sizes={"state": 2}, action_dim=2, episode_length=9, **sizes).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return model


def test_plans_in_low_precision_stay_float32_and_close():
    model = opinionated(latent_dim=32, hidden_dim=32)
    planner = CEM(action_dim=2, horizon=HORIZON, num_samples=64, num_elites=8, iterations=4)
    actions = []
    for precision, linear in (("float32", torch.float32), ("bfloat16", torch.bfloat16)):
        policy = PlannerPolicy.for_model(model, planner, explore=False, precision=precision)
        dtypes = []
        handle = model.dynamics[0].linear.register_forward_hook(
            lambda module, args, out, dtypes=dtypes: dtypes.append(out.dtype)
        )
        torch.manual_seed(1)
        td = policy(TensorDict({"state": torch.ones(5, 2)}, batch_size=[5]))
        handle.remove()
        assert set(dtypes) == {linear}
        assert td["action"].dtype == td["plan"].dtype == torch.float32
        actions.append(td["action"])
    assert not torch.equal(*actions)
    assert (
        actions[0] - actions[1]
    ).abs().mean() < 0.2  # of a range of 2; scores near each other may change places
    with pytest.raises(ValueError, match="float32, bfloat16"):
        PlannerPolicy.for_model(model, planner, precision="float16")


def test_a_compiled_policy_decides_the_same():
    model = opinionated(latent_dim=16, hidden_dim=16)
    planner = MPPI(action_dim=2, horizon=2, num_samples=16, num_elites=4, iterations=2, num_policy_samples=4)
    calls, compiled = [], torch.compile

    def compile(function, **options):
        calls.append(function)
        return compiled(function, backend="eager", **options)

    actions = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "compile", compile)
        for wanted in (False, True):
            policy = PlannerPolicy.for_model(model, planner, explore=False, compile=wanted)
            torch.manual_seed(1)
            actions.append(policy(TensorDict({"state": torch.ones(3, 2)}, batch_size=[3]))["action"])
    assert all(part in calls for part in (model.next, model.reward, model.value))
    assert any(getattr(part, "__func__", None) is Guide.act for part in calls)
    torch.testing.assert_close(*actions)


def test_a_compiled_policy_stays_compiled_for_many_numbers_of_worlds(monkeypatch):
    """Those that gather, are evaluated and are filmed differ, and each of iCEM's rounds has its own candidates."""
    from torch._dynamo import config, reset

    reset()
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    planner = ICEM(action_dim=2, horizon=2, num_samples=16, num_elites=4, iterations=3, num_policy_samples=4)
    with config.patch(recompile_limit=8, fail_on_recompile_limit_hit=True):  # the limit is torch's own
        policy = PlannerPolicy.for_model(opinionated(latent_dim=16, hidden_dim=16), planner, compile=True)
        for worlds in (1, 2, 5, 7):
            assert policy(observation(worlds))["action"].shape == (worlds, 2)


def test_what_is_compiled_sees_latents_of_one_kind(monkeypatch):
    """Other strides would be compiled again."""
    monkeypatch.setattr(torch, "compile", lambda function, **_: function)
    kinds = set()

    def push(z, action):
        kinds.add((tuple(z.shape), z.stride()))
        return z + action

    def guess(z):
        kinds.add((tuple(z.shape), z.stride()))
        return z.tanh()

    planner = MPPI(action_dim=2, horizon=3, num_samples=16, num_elites=4, num_policy_samples=4)
    PlannerPolicy(
        planner,
        encode=lambda entries: entries["state"],
        next=push,
        objective=GoalDistance(torch.zeros(2)),
        observation_keys=["state"],
        prior=guess,
        compile=True,
    )(observation())
    assert {shape for shape, _ in kinds} == {(3, 4, 2), (3, 16, 2)} and len(kinds) == 2


class Towards(Exact):
    """Its policy acts towards an image, whose encodings it counts."""

    has_goal_policy, encoded = True, 0

    def __init__(self) -> None:
        super().__init__()
        self.image_sizes = {"pixels": 4}

    def encode_goal(self, observation):
        self.encoded += 1
        return observation.get("pixels").float().flatten(1)[:, :2]

    def goal_policy(self, z, goal, deterministic=False):
        return (goal - z).clamp(-1, 1)


@pytest.mark.parametrize(("samples", "encodings"), [(0, 1), (2, 2)])
def test_an_image_of_a_goal_is_encoded_for_the_policy_only_where_it_proposes(samples, encodings):
    model = Towards()
    acting = PlannerPolicy.for_model(
        model,
        CEM(action_dim=2, horizon=2, num_samples=16, num_elites=4, num_policy_samples=samples),
        objective=GoalImage(model.encode_goal),
    )
    seen = observation().update(
        {key: torch.zeros(3, 4, 4, 3, dtype=torch.uint8) for key in ("pixels", "goal_pixels")}
    )
    acting(seen.clone())
    assert model.encoded == encodings
    assert acting.bound_prior(seen) is not None  # what is asked of it otherwise
    acting.plan_for(lambda trajectory, actions: -actions.square().sum((-2, -1)))
    assert (
        acting.in_keys == ["state", "pixels", "goal_pixels", "is_init"]
        and acting(seen.clone())["action"].isfinite().all()
    )


def test_capture_is_refused_where_there_is_no_gpu():
    policy = PlannerPolicy.for_model(
        opinionated(latent_dim=16, hidden_dim=16), MPPI(action_dim=2), capture=True
    )
    with pytest.raises(ValueError, match="on CUDA"):
        policy(TensorDict({"state": torch.ones(3, 2)}, batch_size=[3]))


def test_a_plan_knows_the_policy_s_mode_however_noisy_the_policy_is():
    """The first of its candidates follows the mode at every step; the others are samples."""
    torch.manual_seed(0)
    model = small()
    z = model.encode(windows()[:, 0])
    seen: list[torch.Tensor] = []

    def objective(trajectory, actions):
        seen.append(actions)
        return -actions.square().sum((-2, -1))

    policy = PlannerPolicy.for_model(
        model,
        MPPI(action_dim=2, horizon=3, num_samples=32, num_policy_samples=5, num_elites=4),
        objective=objective,
    )
    assert policy.prior is not None
    policy.planner.plan(z, model.next, policy.objective, prior=policy.prior, explore=False)
    latent = z
    for t in range(3):
        mode = model.policy(latent, deterministic=True)
        torch.testing.assert_close(seen[0][:, 0, t], mode)
        assert not torch.isclose(seen[0][:, 1:5, t], mode.unsqueeze(1)).all(-1).any()
        latent = model.next(latent, mode)
    mode = policy.prior(z.unsqueeze(1), deterministic=True)[:, 0]
    torch.testing.assert_close(mode, model.policy(z, deterministic=True))
