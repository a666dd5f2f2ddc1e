"""Kernels of a plan: each equals the layers that it stands for.

Most of these tests run in a process of their own with Triton's interpreter, which the first of them begins.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from franka_wm.models import fused
from franka_wm.models.layers import Ensemble, SimNorm, TwoHotSymlog, mlp
from franka_wm.models.tdmpc2 import TDMPC2
from plan_kernels import INTERPRETED, model, runs_kernels, shaken

pytest.importorskip("triton")  # comes with torch on Linux
pytestmark = pytest.mark.usefixtures("seeded")


@pytest.mark.slow
@pytest.mark.skipif(INTERPRETED, reason="is what began this process")
def test_all_of_them_with_triton_s_interpreter():
    files = [str(Path(__file__).with_name(name)) for name in ("test_fused.py", "test_fused_use.py")]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *files]
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTEST_ADDOPTS": ""}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and re.search(r"\d passed, \d+ skipped", done.stdout), (
        done.stdout[-4000:] + done.stderr[-2000:]
    )


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
@pytest.mark.parametrize("masks", [None, [[1, 1, 0], [1, 1, 1]]])
def test_products_read_whole_pieces_where_they_lie(masks, monkeypatch):
    """Else they would be copied, or made one for each few rows."""
    whole = model(observation_sizes={"state": 5, "task": 2}, action_masks=masks)
    z, action, plain = torch.rand(3, 2, 4, 24 + (3 if masks else 0)), torch.rand(2, 4, 3, 3), fused.F.linear
    z, seen = z.movedim(0, 2), []

    def linear(x, *weights):
        seen.append(x)
        return plain(x, *weights)

    expected = whole.reward(z, action)
    monkeypatch.setattr(fused.F, "linear", linear)
    with fused.kernels():
        torch.testing.assert_close(whole.reward(z, action), expected, rtol=1e-4, atol=1e-5)
    assert len(seen) == 3 and all(x.is_contiguous() and x.stride(-2) % 8 == 0 for x in seen)


@runs_kernels
@torch.no_grad()
def test_no_rows_and_what_the_kernels_do_not_know():
    whole = model()
    with fused.kernels():
        assert whole.value(torch.rand(2, 0, 24)).shape == (2, 0, 1)
        assert whole.q(torch.rand(6, 24), torch.rand(6, 3), dropout=True).shape == (6, 1)
        half = model().bfloat16()
        assert half.q(torch.rand(6, 24).bfloat16(), torch.rand(6, 3).bfloat16()).shape == (6, 1)
        heard = []
        whole.dynamics.register_forward_pre_hook(lambda network, given: heard.append(given[0].shape))
        whole.next(torch.rand(6, 24), torch.rand(6, 3))
        assert heard == [(6, 27)]


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
