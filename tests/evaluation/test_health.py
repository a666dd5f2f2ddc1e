"""Training health: what is logged is right, cheap to ask for, and changes nothing."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from franka_wm.evaluation import health
from franka_wm.evaluation.health import diagnose_training, paired_gain, planner_health, training_diagnostics
from franka_wm.evaluation.spectrum import collapse_warning, latent_statistics
from franka_wm.models.tdmpc2 import TDMPC2
from franka_wm.planning import CEM, ICEM, MPPI, GradientPlanner
from franka_wm.policies import PlannerPolicy


@pytest.fixture
def model() -> TDMPC2:
    torch.manual_seed(0)
    sizes = {"state": 6}
    return TDMPC2(
        observation_sizes=sizes, action_dim=2, episode_length=20, latent_dim=16, encoder_dim=32, hidden_dim=32
    )


@pytest.fixture
def batch() -> TensorDict:
    generator = torch.Generator().manual_seed(1)
    states = torch.randn(64, 4, 6, generator=generator)
    return TensorDict(
        {
            "state": states[:, :3],
            "action": torch.rand(64, 3, 2, generator=generator) * 2 - 1,
            "is_init": torch.zeros(64, 3, 1, dtype=torch.bool),
            "next": {
                "state": states[:, 1:],
                "reward": torch.randn(64, 3, 1, generator=generator),
                "terminated": torch.zeros(64, 3, 1, dtype=torch.bool),
            },
        },
        batch_size=[64, 3],
    )


def test_diagnostics_are_those_of_the_encoded_batch(model: TDMPC2, batch: TensorDict) -> None:
    model.value = lambda z: z[..., :1]  # its own says 0 everywhere before training
    found = training_diagnostics(model, batch)
    expected = latent_statistics(model.encode(batch[:, 0]))
    assert {name.removeprefix("latent/"): v for name, v in found.items() if "latent/" in name} == expected
    assert all(isinstance(value, float) for value in found.values())
    assert {"value/mean", "value/td_bias", "value/td_correlation"} <= set(found)


def test_looking_changes_nothing(model: TDMPC2, batch: TensorDict) -> None:
    model.train()
    model.q_ensemble.eval()  # a part that is kept in another mode
    before = {name: value.clone() for name, value in model.state_dict().items()}
    torch.manual_seed(5)
    expected = torch.rand(4)
    torch.manual_seed(5)
    training_diagnostics(model, batch)
    assert torch.equal(torch.rand(4), expected)
    assert model.training and model.encoder.training and not model.q_ensemble.training
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_a_collapsed_encoder_is_told(model: TDMPC2, batch: TensorDict) -> None:
    assert collapse_warning(training_diagnostics(model, batch)) is None
    with torch.no_grad():
        for parameter in model.encoder.parameters():
            parameter.zero_()
    assert "to a point" in str(collapse_warning(training_diagnostics(model, batch)))


def test_an_exact_value_has_no_bias(model: TDMPC2, batch: TensorDict) -> None:
    """Reward 1 for ever is worth 1 / (1 − γ); a value of that is consistent with itself. One too high by c is too
    high by c − γ³ c over three steps."""
    batch["next", "reward"] = torch.ones(64, 3, 1)
    exact = 1 / (1 - model.discount)
    for offset in (0.0, 5.0):
        model.value = lambda z, offset=offset: torch.full((*z.shape[:-1], 1), exact + offset)
        found = training_diagnostics(model, batch)
        assert found["value/td_bias"] == pytest.approx(offset * (1 - model.discount**3), abs=1e-4)
        assert "value/td_correlation" not in found  # of constants there is none


def test_a_termination_ends_the_return(model: TDMPC2, batch: TensorDict) -> None:
    batch["next", "reward"] = torch.ones(64, 3, 1)
    batch["next", "terminated"] = torch.tensor([False, True, False]).view(1, 3, 1).expand(64, 3, 1).clone()
    model.value = lambda z: torch.full((*z.shape[:-1], 1), 100.0)
    expected = 100 - (1 + model.discount)
    assert training_diagnostics(model, batch)["value/td_bias"] == pytest.approx(expected, rel=1e-5)


def test_without_rewards_or_finite_latents(model: TDMPC2, batch: TensorDict) -> None:
    del batch["next", "reward"], batch["next", "terminated"]
    found = training_diagnostics(model, batch)
    assert found and not any(name.startswith("value/") for name in found)
    batch["state"].fill_(torch.nan)
    assert training_diagnostics(model, batch) == {}


def test_the_windows_are_spread_over_the_batch(model: TDMPC2, batch: TensorDict, monkeypatch) -> None:
    """Demonstrations stand in the first ones."""
    del batch["next", "reward"]
    for most, seen in ((32, batch[::2]), (30, batch[::3]), (64, batch)):
        monkeypatch.setattr(health, "SAMPLES", most)
        expected = latent_statistics(model.encode(seen[:, 0]))
        assert training_diagnostics(model, batch) == {f"latent/{name}": x for name, x in expected.items()}


def test_one_window_says_nothing_of_latents(model: TDMPC2, batch: TensorDict) -> None:
    assert diagnose_training(model, batch[:1]) == ({}, None)
    batch["state"].fill_(torch.nan)
    assert "no longer finite" in str(diagnose_training(model, batch)[1])


# -- planners ----------------------------------------------------------------------------------------------


def nearest_to_origin(trajectory: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    return -trajectory[:, :, -1].square().sum(-1)


@pytest.fixture
def states() -> TensorDict:
    position = torch.randn(40, 2, generator=torch.Generator().manual_seed(2))
    return TensorDict({"position": position, "is_init": torch.ones(40, 1, dtype=torch.bool)}, batch_size=[40])


@pytest.mark.parametrize("kind", [MPPI, CEM, ICEM, GradientPlanner])
def test_planning_gains_over_doing_nothing(point_model, states: TensorDict, kind) -> None:
    sizes = {} if kind is GradientPlanner else {"num_samples": 256, "num_elites": 32}
    planner = kind(action_dim=2, horizon=2, num_policy_samples=0, **sizes)
    policy = PlannerPolicy.for_model(point_model, planner, objective=nearest_to_origin)
    torch.manual_seed(0)
    found = planner_health(policy, states)
    stays = float(-states["position"].square().sum(-1).mean())
    assert found["prior"] == pytest.approx(stays)
    assert found["gain"]["mean"] == pytest.approx(found["plan"] - found["prior"], rel=1e-5)
    assert found["gain"]["low"] > 0.5 * -stays
    assert found["better"] > 0.9 and found["states"] == 40
    assert ("effective_samples" in found) == (kind is MPPI)


@pytest.mark.parametrize(("temperature", "expected"), [(1e-6, 32.0), (1e6, 1.0)])
def test_effective_samples(point_model, states: TensorDict, temperature: float, expected: float) -> None:
    """All elites where their scores hardly count, one where they decide all."""
    planner = MPPI(
        action_dim=2,
        horizon=2,
        num_policy_samples=0,
        num_samples=256,
        num_elites=32,
        temperature=temperature,
    )
    policy = PlannerPolicy.for_model(point_model, planner, objective=nearest_to_origin)
    torch.manual_seed(0)
    found = planner_health(policy, states)
    assert found["effective_samples"]["mean"] == pytest.approx(expected, rel=0.01)


def test_a_perfect_prior_leaves_nothing_to_gain(point_model, states: TensorDict) -> None:
    point_model.has_policy = True
    point_model.policy = lambda z, deterministic=False: (
        (-z).clamp(-1, 1) if deterministic else torch.ones_like(z)
    )
    planner = MPPI(action_dim=2, horizon=3, num_samples=64, num_elites=8, num_policy_samples=4)
    policy = PlannerPolicy.for_model(point_model, planner, objective=nearest_to_origin)
    torch.manual_seed(0)
    found = planner_health(policy, states)
    assert found["gain"]["mean"] <= 1e-6
    assert found["better"] < 0.1


def test_a_compiled_planner_s_prior_is_asked_for_its_mode(
    model: TDMPC2, batch: TensorDict, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = torch.compile
    monkeypatch.setattr(torch, "compile", lambda function, **_: compiled(function, backend="eager"))
    planner = MPPI(action_dim=2, horizon=2, num_samples=16, num_elites=4, iterations=1, num_policy_samples=4)
    found = []
    for wanted in (False, True):
        policy = PlannerPolicy.for_model(model.eval(), planner, compile=wanted)
        torch.manual_seed(0)
        found.append(planner_health(policy, batch[:6, 0]))
    assert found[1]["prior"] == pytest.approx(found[0]["prior"])
    assert found[1]["plan"] == pytest.approx(found[0]["plan"])


def test_pairs_are_narrower_than_their_parts() -> None:
    """Episodes differ much more than the two policies do on the same one."""
    base = torch.linspace(-50, 0, 60)
    noise = 0.1 * torch.randn(60, generator=torch.Generator().manual_seed(3))
    one, two = ({"return": values} for values in (base + 1 + noise, base))
    gain = paired_gain(*(TensorDict(part, batch_size=[60]) for part in (one, two)))
    assert set(gain) == {"return"}
    assert 0.9 < gain["return"]["low"] < 1 + float(noise.mean()) < gain["return"]["high"] < 1.1


def test_a_time_limit_in_a_window_says_nothing_of_values(model: TDMPC2, batch: TensorDict) -> None:
    """Families whose windows go on into the next episode: only a termination ends what a value counts."""
    model.value = lambda z: torch.zeros_like(z[..., :1])
    batch["next", "reward"].fill_(1.0)
    alone = training_diagnostics(model, batch)
    assert alone["value/td_bias"] == pytest.approx(-(1 + model.discount + model.discount**2))
    batch["is_init"][:32, 2] = True
    assert training_diagnostics(model, batch)["value/td_bias"] == pytest.approx(alone["value/td_bias"])
    batch["next", "terminated"][:32, 1] = True  # these end there, and are worth the two rewards before
    expected = (alone["value/td_bias"] - (1 + model.discount)) / 2
    assert training_diagnostics(model, batch)["value/td_bias"] == pytest.approx(expected)
    batch["next", "terminated"].fill_(False)
    batch["is_init"][:, 2] = True
    assert not {"value/td_bias", "value/mean"} & training_diagnostics(model, batch).keys()
