"""Policies of a model with memory carry it from step to step, with the action that was really executed."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from franka_wm.models import WorldModel
from franka_wm.planning import MPPI
from franka_wm.policies import ExploringPolicy, ModelPolicy, PlannerPolicy
from points import Points


class Begun(WorldModel):
    """Its latents say whether an episode begins."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_sizes, self.discount = {"state": 2}, 0.9

    def encode(self, observation):
        return observation.get("is_init").float()

    def policy(self, z, deterministic=False):
        return z.expand(-1, 2)


def test_a_model_without_memory_may_read_where_episodes_begin():
    """`check_model` gives it that."""
    begins = torch.tensor([[True], [False]])
    seen = TensorDict({"state": torch.zeros(2, 2), "is_init": begins}, [2])
    assert torch.equal(ModelPolicy.for_model(Begun())(seen)["action"], begins.float().expand(-1, 2))


NEVER = torch.zeros(4, 1, dtype=torch.bool)


class Diary(WorldModel):
    """Latents: how many steps it remembers, and the sum of the actions in them."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_sizes, self.discount = {"state": 2}, 0.9

    def encode(self, observation):
        return observation.get("state").new_zeros(*observation.batch_size, 3)

    def observe(self, observation, previous_z, action, is_init):
        more = torch.cat((previous_z[:, :1] + 1, previous_z[:, 1:] + action), -1)
        return torch.where(is_init, self.encode(observation), more)

    def next(self, z, action):
        return torch.cat((z[..., :1] + 1, z[..., 1:] + action), -1)

    def reward(self, z, action):
        return -action.square().sum(-1, keepdim=True)

    def value(self, z):
        return z[..., :1]

    def policy(self, z, deterministic=False):
        return torch.full_like(z[..., :2], 0.25)


def planner():
    sizes = dict(horizon=2, num_samples=8, num_elites=2, num_policy_samples=2, iterations=1)
    return MPPI(action_dim=2, **sizes)


def test_a_collector_carries_memory_and_drops_it_where_an_episode_begins():
    model = Diary()
    collector = Collector(
        TransformedEnv(Points(), InitTracker()),
        ModelPolicy.for_model(model),
        frames_per_batch=3 * 12,
        total_frames=3 * 24,
    )
    data = torch.cat([batch.clone() for batch in collector], dim=1)
    collector.shutdown()
    count = torch.zeros(3)
    for t in range(24):
        count = torch.where(data["is_init"][:, t, 0], 0.0, count + 1)
        torch.testing.assert_close(data["context"][:, t, 0], count)
        torch.testing.assert_close(data["context"][:, t, 1], 0.25 * count)
    assert int(data["is_init"].sum()) > 3  # episodes ended on the way


def test_memory_without_the_mark_of_first_steps_is_refused():
    policy = ModelPolicy.for_model(Diary())
    step = policy(TensorDict({"state": torch.zeros(4, 2), "is_init": ~NEVER}, [4]))
    with pytest.raises(ValueError, match="is_init is missing"):
        policy(step.exclude("is_init"))


def test_explored_actions_are_what_is_remembered():
    model = Diary()
    acts = ExploringPolicy(ModelPolicy.for_model(model), noise=0.5)
    with set_exploration_type(ExplorationType.RANDOM):
        step = acts(TensorDict({"state": torch.zeros(4, 2), "is_init": ~NEVER}, [4]))
        first = step["action"].clone()
        assert not torch.equal(first[1:], torch.full((3, 2), 0.25))
        step = acts(step.set("is_init", NEVER))
    torch.testing.assert_close(step["context"][:, 1:], first)


def test_worlds_of_the_planner_and_of_the_policy_keep_their_own_memory():
    model = Diary()
    planned = PlannerPolicy.for_model(model, planner())
    acts = ExploringPolicy(ModelPolicy.for_model(model), planner=planned, planner_worlds=1)
    assert {"context", "context_action", "is_init", "plan"} <= {*acts.out_keys, *acts.in_keys}
    with set_exploration_type(ExplorationType.RANDOM):
        step = acts(TensorDict({"state": torch.zeros(4, 2), "is_init": ~NEVER}, [4]))
        total = step["action"].clone()
        for k in range(1, 4):
            step = acts(step.set("is_init", NEVER))
            torch.testing.assert_close(step["context"], torch.cat((torch.full((4, 1), float(k)), total), -1))
            total = total + step["action"]
    torch.testing.assert_close(total[:3], torch.ones(3, 2))
    assert not torch.allclose(total[3], torch.ones(2))
