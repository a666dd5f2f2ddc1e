"""Where the kernels of a plan are used, and where layers are called as they are; see test_fused.py."""

import threading

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from franka_wm.models import fused
from franka_wm.models.layers import Ensemble, Linear, SimNorm, mlp
from franka_wm.planning import MPPI, ActionPenalty, GoalDistance, RewardPlusValue, Smoothness, Sum
from franka_wm.policies import PlannerPolicy
from plan_kernels import model, runs_kernels

pytest.importorskip("triton")  # comes with torch on Linux
pytestmark = pytest.mark.usefixtures("seeded")


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
    sizes = {
        "action_dim": 3,
        "horizon": 2,
        "iterations": 2,
        "num_samples": 24,
        "num_policy_samples": 4,
        "num_elites": 6,
    }
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
    assert not type("Own", (RewardPlusValue,), {}).of(whole).coarse
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
    tasks = model(observation_sizes={"state": 5, "task": 2}, action_masks=[[1, 1, 0], [1, 1, 1]])
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16), fused.kernels(coarse=True):
        assert (
            tasks.next(torch.rand(2, 8, 27), action).dtype == torch.bfloat16
        )  # with the mask that z carries
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
def test_dropout_in_training_is_the_ensembles_own(calls):
    ensemble = Ensemble(members=2, in_features=13, hidden=(20,), out_features=4, dropout=0.5)
    with fused.kernels():
        ensemble(torch.randn(5, 13), dropout=True)
    assert "ensemble" not in calls


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
