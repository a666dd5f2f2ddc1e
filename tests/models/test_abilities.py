"""What each family can do is what docs/models.md says, and what trainers, planners and evaluation ask."""

import re
from inspect import signature

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from franka_wm import models
from franka_wm.errors import UserError
from franka_wm.models import WorldModel
from franka_wm.models.base import ABILITIES

NAMES = {
    "TD-MPC2": "tdmpc2",
    "MuZero": "muzero",
    "Dreamer": "dreamer",
    "LeWorldModel": "lewm",
    "action world model": "action_world_model",
    "DINO-WM": "dino_wm",
    "JEPA": "jepa",
}
"""How the page calls the families."""


@pytest.fixture(scope="module")
def page(root) -> dict[str, set[str]]:
    """Flag -> families that have it, by the table of docs/models.md."""
    text = (root / "docs/models.md").read_text(encoding="utf-8")
    text = text.split("| flag | method |")[1].split("\n\n")[0]
    rows = re.findall(r"^\| `(\w+)` \| [^|]* \| ([^|]*) \|", text, re.MULTILINE)
    notes = re.compile(r"\([^)]*\)")  # what stands in brackets is no family's name
    return {flag: {NAMES[name.strip()] for name in notes.sub("", who).split(",")} for flag, who in rows}


@pytest.mark.parametrize("flag", [*ABILITIES, "discrete", "cross_episode", "moved_windows"])
def test_the_page_tells_which_family_has_which_ability(page, flag):
    assert {name for name in NAMES.values() if getattr(models.family(name), flag)} == page[flag]


def test_the_page_tells_of_every_ability_and_of_nothing_else(page):
    assert set(page) == {
        *ABILITIES,
        "discrete",
        "cross_episode",
        "moved_windows",
        "terminates",
        "burn_in",
        "replay_keys",
    }
    assert set(NAMES.values()) == set(models._FAMILIES)
    assert page["terminates"] == {"tdmpc2", "dreamer"}
    built = {name for name in NAMES.values() if "burn_in" in signature(models.family(name)).parameters}
    assert built == page["burn_in"]
    asking = {name for name in NAMES.values() if models.family(name).replay_keys}
    by_option = {
        name for name in NAMES.values() if "stored_state" in signature(models.family(name)).parameters
    }
    assert asking | by_option == page["replay_keys"]


class Least(WorldModel):
    """The least that a family can be."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_sizes = {"state": 3}
        self.layer = nn.Linear(3, 2)

    def encode(self, observation):
        return self.layer(observation.get("state"))


def test_a_family_of_ones_own_gets_the_defaults():
    model = Least()
    assert not any(getattr(model, flag) for flag in ABILITIES)
    assert not model.discrete and not model.cross_episode and not model.terminates
    assert model.observation_keys == ["state"] and model.replay_keys == () and model.rebuild_overrides() == {}
    z = model.encode(TensorDict({"state": torch.ones(4, 3)}, [4]))
    assert model.embed(z) is z
    groups = model.parameter_groups(0.1)
    assert {id(p) for group in groups for p in group["params"]} == {id(p) for p in model.parameters()}
    model.after_update()
    model.set_observation_statistics(torch.zeros(3), torch.ones(3))
    for method, arguments in {
        "next": (z, z),
        "reward": (z, z),
        "value": (z,),
        "terminated": (z,),
        "policy": (z,),
        "prediction": (z,),
        "recurrent": (z, z),
        "encode_goal": (None,),
        "observe": (None, z, z, z),
        "loss": (None,),
    }.items():
        with pytest.raises(NotImplementedError, match=f"Least has no {method}"):
            getattr(model, method)(*arguments)


def test_to_define_a_method_is_to_have_the_ability():
    class More(Least):
        def next(self, z, action):
            return z

        def prediction(self, z):
            return z, z

    class Most(More):
        def recurrent(self, z, action):
            return z, z, z, z, z

    assert More.has_next and not Least.has_next
    assert not More.has_search and Most.has_search and Most.has_next  # a search needs both


def test_what_is_no_world_model_is_refused():
    with pytest.raises(UserError, match="must be a subclass of"):
        models.register("plain", nn.Linear)  # pyright: ignore[reportArgumentType]


def test_a_misspelt_family_names_the_nearest():
    with pytest.raises(ValueError, match=r"unknown model 'tdmpc'; .*; did you mean tdmpc2\?"):
        models.make("tdmpc")


# -- options ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("tdmpc2", {"latent_dim": 3.5}, "model.latent_dim=3.5: must be a whole number of at least 1"),
        ("tdmpc2", {"latent_dim": True}, "model.latent_dim=True: must be a whole number"),
        ("tdmpc2", {"num_q": 1}, "model.num_q=1: must be a whole number of at least 2"),
        ("tdmpc2", {"dropout": 1.0}, "model.dropout=1.0: must be a finite number of at least 0 and below 1"),
        ("tdmpc2", {"tau": 0.0}, "model.tau=0.0: must be a finite number above 0 and of at most 1"),
        ("tdmpc2", {"tau": float("nan")}, "model.tau=nan"),
        ("tdmpc2", {"tau": "fast"}, "model.tau='fast': must be a finite number"),
        (
            "tdmpc2",
            {"discount": 1.0},
            "model.discount=1.0: must be a finite number of at least 0 and below 1, or null",
        ),
        ("tdmpc2", {"freeze_encoder": 1}, "model.freeze_encoder=1: must be true or false"),
        ("tdmpc2", {"value_members": 9}, "model.value_members=9: must be at most model.num_q=5"),
        ("tdmpc2", {"simnorm_dim": 7}, "model.simnorm_dim=7: must divide model.latent_dim=512"),
        ("jepa", {"recipe": "mae"}, "model.recipe='mae': must be one of ijepa, vjepa, lejepa"),
        ("lewm", {"history": 0}, "model.history=0: must be a whole number of at least 1"),
        ("action_world_model", {"encoder_size": 3}, "model.encoder_size=3: must be text"),
    ],
)
def test_a_wrong_option_is_named_before_anything_is_built(name, options, said):
    with pytest.raises(UserError, match=said):
        models.family(name).validate(options)


@pytest.mark.parametrize(
    ("name", "options", "window"),
    [("muzero", {"unroll": 3, "n_step": 2}, 6), ("lewm", {"inverse_coef": 1.0, "history": 3}, 3)],
)
def test_windows_too_short_for_a_family_are_refused(name, options, window):
    family = models.family(name)
    family.validate(options)
    family.validate(options, window=window)
    with pytest.raises(UserError, match=f"replay.window={window}"):
        family.validate(options, window=window - 1)


def test_what_another_class_takes_is_not_looked_at():
    models.family("lewm").validate({"name": "lewm", "lr": "x", "observations": ["pixels"], "history": 2})


def test_options_of_a_base_class_are_looked_at():
    class Mine(models.family("tdmpc2")):
        def __init__(self, *, width: int = 3, **options):
            super().__init__(**options)

    for options in ({"width": "wide"}, {"latent_dim": "wide"}):
        with pytest.raises(UserError, match="must be a whole number"):
            Mine.validate(options)


def test_annotations_that_only_type_checkers_know_are_left_to_the_class():
    class Mine(models.family("tdmpc2")):
        def __init__(self, *, encoder: "Encoder | None" = None, **options):  # noqa: F821  # pyright: ignore
            super().__init__(**options)

    Mine.validate({"encoder": 3, "latent_dim": 16})
    with pytest.raises(UserError, match="must be a whole number"):
        Mine.validate({"encoder": 3, "latent_dim": "wide"})


def test_abilities_of_a_mixin_count():
    class Moves:
        def next(self, z, action):
            return z

        def reward(self, z, action):
            return z[..., :1]

    class Mine(Moves, WorldModel):
        pass

    class Plain(WorldModel):
        pass

    assert Mine.has_next and Mine.has_reward and not Mine.has_value
    assert not Plain.has_next and not Plain.has_reward


def test_what_is_no_class_is_no_family():
    with pytest.raises(UserError, match=r"model 'x': 3 must be a subclass"):
        models.register("x", 3)  # type: ignore[arg-type]


@pytest.mark.parametrize(("family", "actions"), [("tdmpc2", 2), ("dreamer", 2), ("muzero", None)])
@pytest.mark.parametrize(("made", "given"), [(3, 4), (1, 4), (4, 1)])
def test_vectors_of_another_size_are_told(family: str, actions: int | None, made: int, given: int) -> None:
    kind = {"num_actions": 3} if actions is None else {"action_dim": actions}
    model = models.make(family, observation_sizes={"state": made}, episode_length=9, **kind)
    seen = TensorDict({"state": torch.ones(2, given)}, [2])
    with pytest.raises(ValueError, match=rf"reads {made} numbers of an observation, here are {given}; is it"):
        model.encode(seen)
