"""Kernels of a plan: each equals the layers that it stands for, and they are used where they may be.

Triton's interpreter runs kernels on a CPU, in a process that asks for it before Triton is imported: one of its own, in
which these tests run again, with those that are left out here.
"""

import os
import subprocess
import sys

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from franka_wm.models import fused
from franka_wm.models.layers import Ensemble, SimNorm, TwoHotSymlog, mlp
from franka_wm.models.tdmpc2 import TDMPC2
from franka_wm.planning import MPPI, GoalDistance, RewardPlusValue, Smoothness, Sum
from franka_wm.policies import PlannerPolicy
from franka_wm.policies.planner import by_networks

pytest.importorskip("triton")  # comes with torch on Linux
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
runs_kernels = pytest.mark.skipif(not INTERPRETED, reason="runs in a process with Triton's interpreter")


@pytest.mark.skipif(INTERPRETED, reason="is what began this process")
def test_all_of_them_with_triton_s_interpreter():
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", __file__]
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTEST_ADDOPTS": ""}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "1 skipped" in done.stdout, done.stdout[-4000:] + done.stderr[-2000:]


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture
def calls(monkeypatch):
    """Names of the kernels' functions, as they are called."""
    seen = []
    for name in ("linear", "normed_linear", "expectation", "ensemble"):
        plain = getattr(fused, name)
        monkeypatch.setattr(fused, name, lambda *a, _f=plain, _n=name, **k: (seen.append(_n), _f(*a, **k))[1])
    return seen


def shaken(module: nn.Module) -> nn.Module:
    """Other weights than those it begins with, of which some are zero or one."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return module


def model(**options) -> TDMPC2:
    sizes = {
        "latent_dim": 24,
        "encoder_dim": 20,
        "hidden_dim": 40,
        "episode_length": 50,
        "num_q": 3,
    } | options
    made = TDMPC2(observation_sizes={"state": 5}, action_dim=3, **sizes)
    return shaken(made).eval()  # pyright: ignore[reportReturnType]


@runs_kernels
@torch.no_grad()
@pytest.mark.parametrize("rows", [(7,), (2, 3, 4), (70,)])
@pytest.mark.parametrize("output", [None, SimNorm(8)])
def test_a_network_is_the_same(rows, output, calls, monkeypatch):
    from franka_wm.models import fused_kernels

    monkeypatch.setattr(fused_kernels, "MANY_ROWS", 64)  # from there on a program takes several
    network = shaken(mlp(13, (20, 40), 24, output=output))
    x = 3 * torch.randn(*rows, 13)
    plain = network(x)
    with fused.kernels():
        torch.testing.assert_close(network(x), plain, rtol=1e-5, atol=1e-5)
    assert calls.count("normed_linear") == 2 + (output is not None) and calls.count("linear") == (
        output is None
    )


@runs_kernels
@torch.no_grad()
def test_steps_that_lie_one_behind_another_are_read_as_they_lie():
    whole = model()
    trajectory = torch.rand(3, 2, 4, 24).movedim(0, 2)  # as `rollout` leaves it on a GPU: (E, S, H, D)
    action = torch.rand(2, 4, 3, 3)
    plain = whole.reward(trajectory, action)
    with fused.kernels():
        torch.testing.assert_close(whole.reward(trajectory, action), plain, rtol=1e-4, atol=1e-5)
        stored = fused._as_stored(trajectory)[0]
        network = shaken(mlp(24, (20,), 5))
        assert network(trajectory).shape == (2, 4, 3, 5)
    assert stored.is_contiguous() and stored.data_ptr() == trajectory.data_ptr()


@runs_kernels
@torch.no_grad()
@pytest.mark.parametrize("members", [None, 2, torch.tensor([2, 0])])
def test_an_ensemble_is_the_same(members):
    ensemble = shaken(Ensemble(members=3, in_features=13, hidden=(20, 40), out_features=11))
    x = torch.randn(4, 5, 13)
    plain = ensemble(x, members=members)
    with fused.kernels():
        torch.testing.assert_close(ensemble(x, members=members), plain, rtol=1e-5, atol=1e-5)


@runs_kernels
@torch.no_grad()
def test_the_expected_value_is_the_same_also_where_it_is_small():
    two_hot = TwoHotSymlog(bins=101)
    logits = 0.02 * torch.randn(64, 2, 101)
    logits[0] = 0.0
    logits[1, 0, 100] = 50.0
    for shown in (logits, logits.repeat(1, 1, 2)[..., :101]):  # also where rows lie apart
        with fused.kernels():
            found = two_hot.decode(shown)
        torch.testing.assert_close(found, two_hot.decode(shown), rtol=1e-5, atol=1e-6)


@runs_kernels
@torch.no_grad()
def test_an_activation_without_a_kernel_is_called_as_it_is():
    network = shaken(mlp(8, (16,), 18, output=SimNorm(6)))  # no power of two
    x = torch.randn(5, 8)
    plain = network(x)
    with fused.kernels():
        torch.testing.assert_close(network(x), plain, rtol=1e-5, atol=1e-5)


@runs_kernels
@torch.no_grad()
@pytest.mark.parametrize("low", [False, True])
@pytest.mark.parametrize("options", [{}, {"action_masks": [[1, 1, 0], [1, 1, 1]]}])
def test_what_a_planner_asks_is_the_same(low, options):
    if options:
        with_tasks = {"observation_sizes": {"state": 5, "task": 2}}
        whole = TDMPC2(
            action_dim=3,
            latent_dim=24,
            encoder_dim=20,
            hidden_dim=40,
            episode_length=50,
            **with_tasks,
            **options,
        )
        whole = shaken(whole).eval()
        observation = TensorDict({"state": torch.randn(6, 5), "task": torch.eye(2).repeat(3, 1)}, [6])
    else:
        whole, observation = model(), TensorDict({"state": torch.randn(6, 5)}, [6])
    action = torch.rand(6, 3) * 2 - 1

    def asked():
        with torch.autocast("cpu", torch.bfloat16, low, False):
            z = whole.encode(observation)
            after = whole.next(z, action)
            mode = whole.policy(z, deterministic=True)
            return z, after, mode, whole.reward(z, action), whole.value(after)

    plain = asked()
    with fused.kernels():
        fast = asked()
    for one, other in zip(fast, plain, strict=True):
        near = {"rtol": 0.1, "atol": 0.05} if low else {"rtol": 1e-4, "atol": 1e-5}
        torch.testing.assert_close(one.float(), other.float(), **near)


@runs_kernels
@torch.no_grad()
def test_weights_are_prepared_once_in_a_decision_and_anew_in_the_next():
    network = shaken(mlp(13, (20,), 4))
    x = torch.randn(3, 13)
    with fused.kernels():
        network(x)
        held = {key: id(made) for key, (_, made) in fused._decision.made.items()}
        network(x)
        assert {key: id(made) for key, (_, made) in fused._decision.made.items()} == held
        assert len(held) == 3  # two weights, one bias
    network[0].linear.weight.mul_(2)
    plain = network(x)
    with fused.kernels():
        torch.testing.assert_close(network(x), plain, rtol=1e-5, atol=1e-5)


def test_gradients_flow_as_without(calls):
    network = mlp(13, (20,), 4)
    with fused.kernels():
        network(torch.randn(3, 13)).sum().backward()
    assert not calls and network[0].linear.weight.grad is not None
    with torch.no_grad(), fused.kernels(False):
        network(torch.randn(3, 13))
    assert not calls


@runs_kernels
def test_a_plan_is_the_same(monkeypatch, calls):
    """CUDA plans by the kernels; here the device is said to be one."""
    sizes = {"action_dim": 3, "horizon": 2, "num_samples": 24, "num_policy_samples": 4, "num_elites": 6}
    whole = model()
    observation = TensorDict({"state": torch.randn(2, 5), "is_init": torch.ones(2, 1, dtype=torch.bool)}, [2])

    monkeypatch.setattr(fused, "ready", lambda kind: True)

    def decided(on: bool | None) -> torch.Tensor:
        planner = MPPI(**sizes, kernels=on)
        policy = PlannerPolicy.for_model(whole, planner, explore=False)
        torch.manual_seed(1)
        return policy(observation.clone())["action"]

    plain = decided(False)
    assert not calls
    torch.testing.assert_close(decided(None), plain, rtol=1e-4, atol=1e-4)
    assert {*calls} == {"linear", "normed_linear", "expectation", "ensemble"}


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_no_kernels_where_the_device_is_no_gpu(precision, calls):
    policy = PlannerPolicy.for_model(
        model(), MPPI(action_dim=3, num_samples=8, num_policy_samples=2, num_elites=4), precision=precision
    )
    policy(TensorDict({"state": torch.randn(2, 5), "is_init": torch.ones(2, 1, dtype=torch.bool)}, [2]))
    assert not calls


def test_what_lacks_for_the_kernels_is_said_once(monkeypatch, capsys):
    fused.ready.cache_clear()
    monkeypatch.setattr(fused, "missing_to_compile", lambda device: "a compiler (gcc)")
    assert not fused.ready("cuda") and not fused.ready("cuda") and not fused.ready("cpu")
    assert capsys.readouterr().out.count("a compiler (gcc), which is not here") == 1
    monkeypatch.undo()
    fused.ready.cache_clear()
    monkeypatch.setattr(fused, "missing_to_compile", lambda device: None)
    assert fused.ready("cuda")
    fused.ready.cache_clear()


@runs_kernels
def test_latents_stay_exact_where_distances_between_them_count():
    whole = model()
    by_return, far = RewardPlusValue.of(whole), GoalDistance(torch.zeros(24))
    assert by_networks(by_return) and by_networks(Sum([(1.0, by_return), (1.0, Smoothness(1.0))]))
    assert not by_networks(far) and not by_networks(Sum([(1.0, by_return), (1.0, far)]))
    planner = MPPI(action_dim=3, horizon=2, num_samples=8, num_policy_samples=2, num_elites=4)
    z, action = torch.rand(2, 8, 24), torch.zeros(2, 8, 3)
    for objective, kind in ((by_return, torch.bfloat16), (far, torch.float32)):
        policy = PlannerPolicy.for_model(whole, planner, objective=objective, precision="bfloat16")
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16), fused.kernels():
            assert policy._next_in_float32(z, action).dtype == kind
