"""Kernels of a plan: each equals the layers that it stands for, and they are used where they may be.

Triton's interpreter runs kernels on a CPU, in a process that asks for it before Triton is imported: one of its own, in
which these tests run again, with those that are left out here.
"""

import os
import re
import subprocess
import sys
import threading

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from franka_wm.models import fused
from franka_wm.models.layers import Ensemble, Linear, SimNorm, TwoHotSymlog, mlp
from franka_wm.models.tdmpc2 import TDMPC2
from franka_wm.planning import MPPI, ActionPenalty, GoalDistance, RewardPlusValue, Smoothness, Sum
from franka_wm.policies import PlannerPolicy

pytest.importorskip("triton")  # comes with torch on Linux
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
runs_kernels = pytest.mark.skipif(not INTERPRETED, reason="runs in a process with Triton's interpreter")


@pytest.mark.skipif(INTERPRETED, reason="is what began this process")
def test_all_of_them_with_triton_s_interpreter():
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", __file__]
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTEST_ADDOPTS": ""}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and re.search(r"\d passed, \d+ skipped", done.stdout), (
        done.stdout[-4000:] + done.stderr[-2000:]
    )


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
        network = shaken(mlp(24, (20,), 5))
        assert network(trajectory).shape == (2, 4, 3, 5)


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
        known = fused._decision().prepared
        held = {key: id(made) for key, (_, made) in known.items()}
        network(x)
        assert {key: id(made) for key, (_, made) in known.items()} == held
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

    asked = []
    monkeypatch.setattr(fused, "ready", lambda kind: asked.append(kind) or True)

    def decided(on: bool | None) -> torch.Tensor:
        planner = MPPI(**sizes, kernels=on)
        policy = PlannerPolicy.for_model(whole, planner, explore=False)
        torch.manual_seed(1)
        return policy(observation.clone())["action"]

    plain = decided(False)
    assert not calls
    torch.testing.assert_close(decided(None), plain, rtol=1e-4, atol=1e-4)
    assert {*asked} == {"cpu"}
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
    assert capsys.readouterr().out.count("its CUDA kernels need a compiler (gcc)") == 1
    monkeypatch.undo()
    fused.ready.cache_clear()
    monkeypatch.setattr(fused, "missing_to_compile", lambda device: None)
    assert fused.ready("cuda")
    fused.ready.cache_clear()


@runs_kernels
def test_latents_stay_exact_where_distances_between_them_count():
    whole = model()
    by_return, far = RewardPlusValue.of(whole), GoalDistance(torch.zeros(24))
    assert by_return.coarse and Sum([(1.0, by_return), (1.0, Smoothness(1.0))]).coarse
    own = RewardPlusValue(lambda z, a: -z[..., :1], lambda z: -z[..., :1], 0.9)  # measures latents itself
    assert not own.coarse and not far.coarse and not Sum([(1.0, by_return), (1.0, far)]).coarse
    planner = MPPI(action_dim=3, horizon=2, num_samples=8, num_policy_samples=2, num_elites=4)
    z, action = torch.rand(2, 8, 24), torch.zeros(2, 8, 3)
    plain = PlannerPolicy.for_model(whole, planner, precision="bfloat16")
    for coarse in (False, True):
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            exact = plain._next(z, action)
            assert exact.dtype == torch.float32
            with fused.kernels(coarse=coarse):
                after = plain._next(z, action)
        assert after.dtype == (torch.bfloat16 if coarse else torch.float32)
        # Rounded afterwards, a softmax of eight would be one of a few values.
        assert coarse or (after != after.bfloat16().float()).any()
        torch.testing.assert_close(after.float(), exact, rtol=0.1, atol=0.05)
    with torch.no_grad(), fused.kernels():  # of families whose latents are no softmax
        plain.next = lambda z, action: z.bfloat16()
        assert plain._next(z, action).dtype == torch.float32


@pytest.mark.parametrize("coarse", [False, True])
def test_a_decision_leaves_latents_as_coarse_as_its_objective_allows(coarse, monkeypatch):
    monkeypatch.setattr(fused, "ready", lambda kind: True)
    seen = []
    policy = PlannerPolicy(
        MPPI(action_dim=3, horizon=1, num_samples=8, num_policy_samples=0, num_elites=4),
        encode=lambda observation: observation["state"],
        next=lambda z, action: seen.append(fused.coarse()) or z,
        objective=ActionPenalty(1.0) if coarse else GoalDistance(torch.zeros(5)),
        observation_keys=["state"],
        precision="bfloat16",
    )
    policy(TensorDict({"state": torch.randn(2, 5), "is_init": torch.ones(2, 1, dtype=torch.bool)}, [2]))
    assert {*seen} == {coarse}


@runs_kernels
@torch.no_grad()
def test_products_are_in_the_precision_of_autocast():
    network, x = shaken(mlp(13, (20,), 4)), torch.randn(5, 13)
    with fused.kernels():
        assert network(x).dtype == torch.float32
        with torch.autocast("cpu", torch.bfloat16):
            assert network(x).dtype == torch.bfloat16


@runs_kernels
@torch.no_grad()
@pytest.mark.parametrize(
    "action", [torch.randn(3, 6).T, torch.randn(3).expand(6, 3), torch.randn(6, 9)[:, ::3]]
)
def test_actions_may_lie_anyhow(action):
    whole, z = model(), torch.rand(6, 24)
    plain = whole.next(z, action), whole.q(z, action)
    with fused.kernels():
        for one, other in zip((whole.next(z, action), whole.q(z, action)), plain, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


@runs_kernels
@torch.no_grad()
def test_one_latent_is_enough():
    whole, z, action = model(), torch.rand(24), torch.rand(3)
    plain = whole.next(z, action), whole.reward(z, action), whole.value(z)
    with fused.kernels():
        for one, other in zip(
            (whole.next(z, action), whole.reward(z, action), whole.value(z)), plain, strict=True
        ):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


@runs_kernels
@torch.no_grad()
def test_an_ensemble_of_many_rows_is_the_same(monkeypatch):
    from franka_wm.models import fused_kernels

    monkeypatch.setattr(fused_kernels, "MANY_ROWS", 8)
    ensemble = shaken(Ensemble(members=3, in_features=13, hidden=(20,), out_features=11))
    for rows in (8, 7):  # seven are not shared out by fours without a member's in another's
        x = torch.randn(rows, 13)
        plain = ensemble(x), ensemble(x, weights="target")
        with fused.kernels():
            torch.testing.assert_close(ensemble(x), plain[0], rtol=1e-5, atol=1e-5)
            torch.testing.assert_close(ensemble(x, weights="target"), plain[1], rtol=1e-5, atol=1e-5)


@runs_kernels
@torch.no_grad()
def test_large_numbers_and_another_epsilon():
    network = shaken(mlp(13, (20,), 4))
    network[0].norm.eps = 0.5
    network[0].norm.weight.mul_(300.0)
    x = torch.randn(5, 13)
    plain = network(x)
    with fused.kernels():
        torch.testing.assert_close(network(x), plain, rtol=1e-4, atol=1e-4)


@torch.no_grad()
@pytest.mark.parametrize("width", [12, 14, 16])
def test_inputs_of_another_width_are_refused(width):
    both = fused.Joined(torch.randn(5, width - 3), torch.randn(5, 3))
    parts = [
        mlp(13, (20,), 4),
        mlp(13, (), 4),
        Ensemble(members=2, in_features=13, hidden=(20,), out_features=4),
    ]
    with fused.kernels():
        for part in parts:
            for x in (torch.randn(5, width), both):
                with pytest.raises(ValueError, match=f"{width} features, the layer reads 13"):
                    part(x)


@runs_kernels
@torch.no_grad()
def test_groups_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="20 features make no whole groups of 8"), fused.kernels():
        mlp(13, (), 20, output=SimNorm(8))(torch.randn(5, 13))


@torch.no_grad()
def test_layers_of_ones_own_are_called_as_they_are(calls):
    class Louder(SimNorm):
        def forward(self, x):
            return 2 * super().forward(x)

    class Plus(Linear):
        def forward(self, input):
            return super().forward(input) + 1

    heard = mlp(13, (), 16, output=SimNorm(8))
    heard[0].linear.register_forward_hook(lambda *of: calls.append("hook"))
    other = mlp(13, (), 16, output=SimNorm(8))
    other[0].linear = Plus(13, 16)
    double = mlp(13, (), 16, output=SimNorm(8)).double()
    for network in (mlp(13, (), 16, output=Louder(8)), heard, other, double):
        x = torch.randn(5, 13, dtype=network[0].linear.weight.dtype)
        plain = network(x)
        with fused.kernels():
            torch.testing.assert_close(network(x), plain)
    assert "normed_linear" not in calls and calls.count("hook") == 2
    whole = model()
    whole.dynamics = nn.Sequential(nn.Linear(27, 24))  # reads both side by side
    with fused.kernels():
        assert whole.next(torch.rand(6, 24), torch.rand(6, 3)).shape == (6, 24)


@torch.no_grad()
def test_dropout_in_training_is_the_layers_own(calls):
    network = mlp(13, (20,), 4, dropout=0.5).train()
    ensemble = Ensemble(members=2, in_features=13, hidden=(20,), out_features=4, dropout=0.5)
    x = torch.randn(5, 13)
    with fused.kernels():
        torch.manual_seed(1)
        network(x), ensemble(x, dropout=True)
    assert "normed_linear" not in calls and "ensemble" not in calls


@torch.no_grad()
def test_what_is_compiled_does_without(calls):
    network, x = mlp(13, (20,), 4), torch.randn(5, 13)
    plain = network(x)
    fast = torch.compile(network, backend="eager", fullgraph=True)
    with fused.kernels():
        torch.testing.assert_close(fast(x), plain)
    assert not calls


def test_kernels_are_of_one_thread_and_end_with_an_error():
    seen = []
    with pytest.raises(ZeroDivisionError), torch.no_grad(), fused.kernels():
        other = threading.Thread(target=lambda: seen.append(fused._present.decision))
        other.start()
        other.join()
        assert fused.applies()
        raise ZeroDivisionError
    assert seen == [None] and fused._present.decision is None


@runs_kernels
@torch.no_grad()
def test_drawn_members_are_not_kept():
    whole = model(num_q=4).train()
    with fused.kernels():
        whole.value(torch.rand(6, 24))
        held = len(fused._decision().prepared)
        for _ in range(4):
            whole.value(torch.rand(6, 24))
        assert len(fused._decision().prepared) == held
