# pyright: reportArgumentType=false, reportCallIssue=false
import copy
import math
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from franka_wm.planning import (
    CEM,
    ActionPenalty,
    GoalDistance,
    GoalImage,
    GoalPolicyPenalty,
    PolicyPenalty,
    RewardPlusValue,
    Smoothness,
    Sum,
)
from franka_wm.policies import PlannerPolicy

# Two environments, three candidates, two steps, latents of two numbers.
E, S, H, D = 2, 3, 2, 2


@pytest.fixture
def trajectory():
    return torch.randn(E, S, H + 1, D, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def actions():
    return torch.randn(E, S, H, 2, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("summed", [True, False])
@pytest.mark.parametrize("metric", ["l2", "l1", "cosine"])
def test_goal_distance_is_what_it_says(trajectory, actions, metric, summed):
    goal = torch.tensor([[1.0, -2.0], [0.5, 3.0]])

    def distance(x, g):
        if metric == "l2":
            return sum((a - b) ** 2 for a, b in zip(x, g, strict=True))
        if metric == "l1":
            return sum(abs(a - b) for a, b in zip(x, g, strict=True))
        size = (sum(a * a for a in x) * sum(b * b for b in g)) ** 0.5
        return 1 - sum(a * b for a, b in zip(x, g, strict=True)) / size

    expected = [
        [
            -sum(
                distance(trajectory[e, s, t].tolist(), goal[e].tolist())
                for t in (range(1, H + 1) if summed else [H])
            )
            for s in range(S)
        ]
        for e in range(E)
    ]
    score = GoalDistance(goal, summed, metric=metric)(trajectory, actions)
    torch.testing.assert_close(score, torch.tensor(expected))
    # one goal for all
    one = GoalDistance(goal[1], summed, metric=metric)(trajectory, actions)
    torch.testing.assert_close(one[1], score[1])


def test_cosine_only_sees_the_direction():
    trajectory = torch.tensor([[0.0, 0.0], [2.0, 0.0], [0.0, -3.0]]).view(1, 1, 3, 2)
    objective = GoalDistance(torch.tensor([5.0, 0.0]), metric="cosine")
    assert objective(trajectory, torch.zeros(1, 1, 2, 1)).item() == pytest.approx(-0.0 - 1.0)
    backwards = GoalDistance(torch.tensor([0.0, 1.0]), summed=False, metric="cosine")
    assert backwards(trajectory, torch.zeros(1, 1, 2, 1)).item() == pytest.approx(-2.0)


def test_distances_are_measured_on_the_embedding(trajectory, actions):
    embed = lambda z: z[..., :1] * 10  # noqa: E731
    goal = torch.tensor([[3.0], [4.0]])
    expected = -(10 * trajectory[:, :, 1:, 0] - goal[:, None]).square().sum(-1)
    torch.testing.assert_close(GoalDistance(goal, embed=embed)(trajectory, actions), expected)
    with pytest.raises(ValueError, match="embed"):
        GoalDistance(goal)(trajectory, actions)
    with pytest.raises(ValueError, match="cosine"):
        GoalDistance(goal, metric="l3")


def test_actions_and_their_changes_are_penalised():
    trajectory = torch.zeros(1, 2, 4, 1)
    actions = torch.tensor([[[[1.0, 2.0], [0.0, 2.0], [0.0, -1.0]], [[0.0, 0.0]] * 3]])
    assert ActionPenalty(0.5)(trajectory, actions).tolist() == [[-5.0, 0.0]]
    assert Smoothness(2.0)(trajectory, actions).tolist() == [[-2.0 * (1 + 9), 0.0]]
    for kind in (ActionPenalty, Smoothness, lambda weight: PolicyPenalty(torch.tanh, weight)):
        with pytest.raises(ValueError, match="weight"):
            kind(-1.0)


def test_the_policy_penalty_counts_the_first_action_from_the_policys_own(trajectory, actions):
    trajectory = trajectory[:, :1].expand(E, S, H + 1, D)  # all candidates start at the same latent
    score = PolicyPenalty(torch.tanh, 0.5)(trajectory, actions)
    for e in range(E):
        for k in range(S):
            own = trajectory[e, k, 0].tanh()
            assert score[e, k].item() == pytest.approx(-0.5 * (actions[e, k, 0] - own).square().sum().item())


def test_the_policy_penalty_keeps_a_plan_at_the_policy_unless_more_is_promised():
    policy = PolicyPenalty(lambda z: torch.full((*z.shape[:-1], 2), 0.5), 1.0)
    planner = CEM(action_dim=2, horizon=1, num_samples=200, num_elites=20, iterations=6)
    z = torch.zeros(1, D)
    for promise, expected in ((0.0, 0.5), (100.0, -1.0)):
        total = Sum([(1.0, lambda _, a, promise=promise: -promise * a.sum((-2, -1))), (1.0, policy)])
        action = planner.plan(z, lambda z, a: z, total)["action"]
        torch.testing.assert_close(action, torch.full((1, 2), expected), atol=0.1, rtol=0)


def test_smoothness_counts_the_step_from_the_last_executed_action_unless_an_episode_begins():
    actions = torch.tensor([[[[1.0], [1.0]]], [[[1.0], [1.0]]]])
    last = torch.tensor([[3.0], [torch.nan]])  # what lies in a buffer before the first action
    td = TensorDict({"action": last, "is_init": torch.tensor([[False], [True]])}, [2])
    free = Smoothness(0.5)
    bound = free.bind(td)
    assert bound(torch.zeros(2, 1, 3, 1), actions).flatten().tolist() == [-0.5 * 4, 0.0]
    assert free(torch.zeros(2, 1, 3, 1), actions).flatten().tolist() == [0.0, 0.0]  # itself unchanged
    td["action"].fill_(100.0)  # the policy writes the next action into the same memory
    assert bound(torch.zeros(2, 1, 3, 1), actions).flatten().tolist() == [-0.5 * 4, 0.0]
    reset = free.bind(td.exclude("action"))
    assert reset(torch.zeros(2, 1, 3, 1), actions).flatten().tolist() == [0.0, 0.0]


def encode_goal(observation):
    assert set(observation.keys()) == {"pixels"}  # not the present joint angles
    return observation["pixels"].float().mean((-3, -2)) / 255.0


def test_a_goal_picture_becomes_a_distance(trajectory, actions):
    picture = torch.randint(256, (E, 4, 4, D), dtype=torch.uint8)
    td = TensorDict({"goal_pixels": picture, "pixels": 255 - picture, "state": torch.zeros(E, 1)}, [E])
    objective = GoalImage(encode_goal, embed=torch.tanh, metric="l1", summed=False)
    expected = GoalDistance(picture.float().mean((1, 2)) / 255, False, metric="l1", embed=torch.tanh)
    bound = objective.bind(td)
    torch.testing.assert_close(bound(trajectory, actions), expected(trajectory, actions))
    assert objective.in_keys == ["goal_pixels"]
    with pytest.raises(ValueError, match="'goal_pixels'"):
        objective.bind(td.exclude("goal_pixels"))
    with pytest.raises(ValueError, match="bind"):
        objective(trajectory, actions)
    with pytest.raises(ValueError, match="metric"):
        GoalImage(encode_goal, metric="euclid")


def test_other_names_for_pictures():
    td = TensorDict({"wanted": torch.full((1, 2, 2, 1), 255, dtype=torch.uint8)}, [1])
    objective = GoalImage(lambda o: o["eye"].float().mean((1, 2)), goals={"eye": "wanted"})
    assert objective.bind(td).goal_latent.tolist() == [[255.0]]


def test_a_sum_adds_weighted_terms_and_binds_them(trajectory, actions):
    goal = GoalDistance(torch.zeros(D))
    both = Sum([(2.0, goal), (0.5, ActionPenalty(3.0))])
    expected = 2 * goal(trajectory, actions) + 0.5 * ActionPenalty(3.0)(trajectory, actions)
    torch.testing.assert_close(both(trajectory, actions), expected)

    picture = torch.randint(256, (E, 4, 4, D), dtype=torch.uint8)
    td = TensorDict(
        {"goal_pixels": picture, "action": torch.ones(E, 2), "is_init": torch.zeros(E, 1).bool()}, [E]
    )
    image, smooth = GoalImage(encode_goal), Smoothness(1.0)
    nested = Sum([(0.3, Sum([(2.0, image), (1.0, ActionPenalty(1.0))])), (4.0, smooth)])
    assert nested.in_keys == ["goal_pixels"]
    assert Sum([(1.0, image), (1.0, nested)]).in_keys == ["goal_pixels"]  # each once
    expected = (
        0.6 * image.bind(td)(trajectory, actions)
        + 0.3 * ActionPenalty(1.0)(trajectory, actions)
        + 4.0 * smooth.bind(td)(trajectory, actions)
    )
    torch.testing.assert_close(nested.bind(td)(trajectory, actions), expected)
    assert goal.bind(td) is goal
    with pytest.raises(ValueError, match="at least one"):
        Sum([])
    with pytest.raises(ValueError, match="ActionPenalty"):
        Sum([(float("nan"), ActionPenalty(1.0))])


def test_nothing_counts_past_a_predicted_end():
    """One environment; candidates end after no, the first, the second, the last, the first and third step."""
    ends = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1]]).bool()
    trajectory = torch.cat((torch.full((5, 1), 9.0), ends.float()), 1).view(1, 5, 4, 1)
    arguments = (lambda z, a: a, lambda z: torch.full_like(z, 100.0), 0.5)
    terminated = lambda z: z == 1.0  # noqa: E731  (the present latent, 9, is not asked)
    actions = torch.tensor([4.0, 6.0, 8.0]).expand(1, 5, 3).unsqueeze(-1)
    found = RewardPlusValue(*arguments, terminated)(trajectory, actions)
    whole = 4.0 + 3.0 + 2.0 + 12.5
    assert found.flatten().tolist() == [whole, 4.0, 7.0, 9.0, 4.0]
    assert RewardPlusValue(*arguments)(trajectory, actions).flatten().tolist() == [whole] * 5
    compiled = RewardPlusValue(*arguments, terminated).compiled()
    assert compiled.terminated is not None


def test_an_objective_of_ones_own_is_compiled_as_what_it_is(trajectory, actions) -> None:
    class Halved(RewardPlusValue):
        def __call__(self, trajectory, actions):
            return 0.5 * super().__call__(trajectory, actions)

    own = Halved(lambda z, a: a[..., :1], lambda z: z[..., :1], 0.5)
    own.coarse = True
    compiled = own.compiled()
    assert type(compiled) is Halved and compiled.coarse and compiled.terminated is None
    assert compiled.reward is not own.reward and compiled.value is not own.value
    torch.testing.assert_close(compiled(trajectory, actions), own(trajectory, actions))


def test_objectives_can_be_copied():
    copied = copy.deepcopy(Sum([(1.0, RewardPlusValue(encode_goal, encode_goal, 0.9)), (1.0, Smoothness(1))]))
    assert len(copied.terms) == 2


class Noisy(EnvBase):
    """A point that is thrown about at every step, so that plain planning is jerky."""

    def __init__(self, n: int) -> None:
        super().__init__(device="cpu", batch_size=[n])
        self.observation_spec = Composite(state=Unbounded((n, 1)), shape=(n,))
        self.action_spec = Bounded(-1.0, 1.0, (n, 1))
        self.reward_spec = Unbounded((n, 1))
        self.generator = torch.Generator().manual_seed(0)
        self.state = torch.zeros(n, 1)

    def _draw(self):
        return torch.randn(self.state.shape, generator=self.generator)

    def _reset(self, tensordict=None):
        self.state = self._draw()
        return TensorDict({"state": self.state}, self.batch_size)

    def _step(self, tensordict):
        self.state = 0.2 * self._draw() + self.state + 0.5 * tensordict["action"]
        done = torch.zeros_like(self.state, dtype=torch.bool)
        reward = -self.state.square()
        return TensorDict({"state": self.state, "reward": reward, "done": done}, self.batch_size)

    def _set_seed(self, seed):
        self.generator.manual_seed(seed or 0)


def test_smoothness_smooths_what_is_executed():
    """An environment carries its last action to the next decision, where `bind` finds it."""

    def roughness(weight):
        env = TransformedEnv(Noisy(16), InitTracker())
        objective = Sum([(1.0, GoalDistance(torch.zeros(1))), (1.0, Smoothness(weight))])
        policy = PlannerPolicy(
            CEM(action_dim=1, horizon=3, num_samples=64, num_elites=8, iterations=4),
            encode=lambda td: td["state"],
            next=lambda z, a: z + 0.5 * a,
            objective=objective,
            observation_keys=["state"],
            explore=False,
        )
        torch.manual_seed(0)
        actions = env.rollout(12, policy)["action"]
        return actions[:, 2:].diff(dim=1).square().mean().item()

    assert roughness(1.0) < 0.3 * roughness(0.0)


def test_the_penalty_of_a_policy_towards_goals_is_that_of_the_decision_s_goal() -> None:
    reader = GoalImage(lambda images: images["pixels"].float().flatten(1)[:, :2])
    penalty = GoalPolicyPenalty(lambda z, goal: 0.1 * z + goal, reader, 2.0)
    assert penalty.in_keys == ["goal_pixels"]
    trajectory, actions = torch.randn(3, 5, 4, 2), torch.randn(3, 5, 3, 2)
    images = torch.randint(0, 9, (3, 2, 2, 3), dtype=torch.uint8)
    bound = penalty.bind(TensorDict({"goal_pixels": images}, [3]))
    own = 0.1 * trajectory[:, :1, 0] + images.float().flatten(1)[:, None, :2]
    torch.testing.assert_close(bound(trajectory, actions), -2.0 * (actions[:, :, 0] - own).square().sum(-1))
    with pytest.raises(ValueError, match="no goal yet"):
        penalty(trajectory, actions)
    with pytest.raises(ValueError, match="of GoalPolicyPenalty"):
        GoalPolicyPenalty(lambda z, goal: z, reader, -1.0)


@pytest.mark.parametrize("lacking", ["reward", "value", "discount"])
def test_a_model_that_lacks_a_part_of_returns_is_told_which(lacking: str) -> None:
    has = {"has_reward": lacking != "reward", "has_value": lacking != "value"}
    model = SimpleNamespace(discount=math.nan if lacking == "discount" else 0.0, **has)
    with pytest.raises(ValueError, match=f"SimpleNamespace has no {lacking}$"):
        RewardPlusValue.of(model)  # type: ignore[arg-type]
