"""A model of one's own is held against the shapes that `WorldModel` promises."""

from contextlib import nullcontext

import pytest
import torch
from torch import nn

from franka_wm import models
from franka_wm.errors import UserError
from franka_wm.models import WorldModel
from franka_wm.models.check import check_model
from small_tdmpc2 import small


class Own(WorldModel):
    """Everything that is looked at, in layers that draw where they should not be heard."""

    def __init__(
        self, *, observation_sizes, action_dim, episode_length=None, width: int = 4, wrong: str = ""
    ):
        super().__init__()
        self.observation_sizes, self.action_dim, self.wrong = observation_sizes, action_dim, wrong
        self.encoder = nn.Sequential(nn.Linear(sum(observation_sizes.values()), width), nn.BatchNorm1d(width))

    def encode(self, observation):
        z = self.encoder(torch.cat([observation[key] for key in self.observation_sizes], -1))
        return z[:2] if self.wrong == "encode" else z + 0 * torch.rand(())

    def next(self, z, action):
        return z[:, :1] if self.wrong == "next" else z

    def reward(self, z, action):
        return z[:, 0] if self.wrong == "reward" else z[:, :1]

    def value(self, z):
        return z if self.wrong == "value" else z[:, :1]

    def policy(self, z, deterministic=False):
        if self.wrong == "fails":
            raise ValueError("no way")
        return z[:, : self.action_dim - (self.wrong == "policy")]

    def loss(self, batch):
        raise AssertionError


def own(**given) -> Own:
    return Own(observation_sizes={"state": 3, "goal": 2}, action_dim=2, **given)


def test_models_that_do_what_they_promise_pass():
    model = own()
    before, state = {k: v.clone() for k, v in model.state_dict().items()}, torch.get_rng_state()
    check_model(model, action_dim=2)
    assert model.training and torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())
    check_model(small(), action_dim=2)
    images = models.make(
        "tdmpc2", image_sizes={"pixels": (40, 40, 3)}, action_dim=2, discount=0.9, latent_dim=16, channels=2
    )
    check_model(images, action_dim=2)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("encode", r"Own.encode of 3 observations must return a tensor \(3, …\), not \(2, 4\)"),
        ("next", r"Own.next for 3 latents must return \(3, 4\), not \(3, 1\)"),
        ("reward", r"Own.reward for 3 latents must return \(3, 1\), not \(3,\)"),
        ("value", r"Own.value for 3 latents must return \(3, 1\), not \(3, 4\)"),
        ("policy", r"Own.policy for 3 latents must return \(3, 2\), not \(3, 1\)"),
        ("fails", r"Own.policy fails: ValueError: no way \(.*test_check_model.py, line \d+\)"),
    ],
)
def test_what_a_model_answers_otherwise_is_told_in_one_line(wrong, says):
    with pytest.raises(UserError, match=says):
        check_model(own(wrong=wrong), action_dim=2)


@pytest.mark.parametrize(
    ("method", "wrong", "says"),
    [
        ("reward", lambda self, state: state, r"must take \(z, action\), not \(state\)"),
        ("policy", lambda self, z: z, r"must take \(z, deterministic\), not \(z\)"),
        ("loss", lambda self: None, r"must take \(batch\), not \(\)"),
        ("parameter_groups", lambda self: [], r"must take \(lr\), not \(\)"),
        ("after_update", lambda self, step: None, r"must take \(\), not \(step\)"),
        ("set_observation_statistics", lambda self, mean: None, r"must take \(mean, std\), not \(mean\)"),
    ],
)
def test_a_method_that_takes_other_arguments_is_told_in_one_line(method, wrong, says):
    cls = type("Odd", (Own,), {method: wrong})
    with pytest.raises(UserError, match=rf"Odd.{method} {says}; see docs/models.md"):
        check_model(cls(observation_sizes={"state": 3}, action_dim=2), action_dim=2)


def test_names_of_arguments_are_free_and_more_may_have_defaults():
    class Free(Own):
        def reward(self, *given, scale=1.0):
            return scale * given[0][:, :1]

        def value(self, latents):
            return latents[:, :1]

    check_model(Free(observation_sizes={"state": 3}, action_dim=2), action_dim=2)


def test_what_its_constructor_froze_stays_frozen():
    for wrong in ("", "value"):
        model = own(wrong=wrong)
        model.encoder[1].eval()
        with nullcontext() if not wrong else pytest.raises(UserError):
            check_model(model, action_dim=2)
        assert model.training and model.encoder[0].training and not model.encoder[1].training


def test_a_policy_may_take_its_mode_by_keyword_alone():
    model = own()
    model.policy = lambda z, *, deterministic: z[:, :2] if deterministic else 1 / 0  # type: ignore[method-assign]
    check_model(model, action_dim=2)


def test_actions_that_are_numbers_are_not_tried():
    check_model(own(wrong="next"), action_dim=None)
    model = own(wrong="next")
    model.discrete = True
    check_model(model, action_dim=2)


@pytest.fixture
def registered(monkeypatch):
    monkeypatch.setattr(models, "_REGISTERED", {})


def test_a_model_of_ones_own_is_tried_when_it_is_made(registered):
    sizes = {"observation_sizes": {"state": 3}, "action_dim": 2}
    models.register("own", Own)
    assert isinstance(models.make("own", **sizes), Own)
    with pytest.raises(UserError, match=r"Own.value for 3 latents"):
        models.make("own", **sizes, wrong="value")
    with pytest.raises(UserError, match=r"Own takes no depth, size; a run gives observation_sizes"):
        models.make("own", **sizes, depth=3, size=2)


def test_a_constructor_that_forgets_its_base_is_told_in_one_line(registered):
    class Sizes(Own):
        def __init__(self, *, observation_sizes, action_dim):
            self.observation_sizes, self.action_dim = observation_sizes, action_dim

    class Layers(Sizes):
        def __init__(self, *, observation_sizes, action_dim):
            self.encoder = nn.Linear(3, 4)

    for cls, says in (
        (Sizes, r"Sizes.__init__ must begin with super\(\).__init__\(\)"),
        (
            Layers,
            r"Layers.__init__ fails: AttributeError: .* before Module.__init__\(\) call \(.*py, line \d+\)",
        ),
    ):
        models.register("own", cls)
        with pytest.raises(UserError, match=says):
            models.make("own", observation_sizes={"state": 3}, action_dim=2)


def test_what_is_no_whole_model_is_not_registered(registered):
    class Half(WorldModel):
        def loss(self, batch):
            return batch

    for name, cls, says in (
        ("half", Half, "model 'half': Half must define encode and loss; encode is missing"),
        ("none", type("Nothing", (WorldModel,), {}), "encode and loss are missing, see"),
        ("tdmpc2", Own, "the package has this name; choose another"),
    ):
        with pytest.raises(UserError, match=says):
            models.register(name, cls)
    assert not models._REGISTERED
