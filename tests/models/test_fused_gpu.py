"""Kernels of a plan on a GPU; without one, that they compile for it."""

import pytest
import torch
from tensordict import TensorDict

from franka_wm.models.tdmpc2 import TDMPC2
from franka_wm.planning import MPPI
from franka_wm.policies import PlannerPolicy

triton = pytest.importorskip("triton")  # comes with torch on Linux
from triton.backends.compiler import GPUTarget  # noqa: E402
from triton.compiler import ASTSource  # noqa: E402

from franka_wm.models import fused_kernels  # noqa: E402


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@torch.no_grad()
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("compile", [False, True])
def test_on_a_gpu_a_plan_is_that_of_the_layers(precision, compile):
    sizes = {"latent_dim": 24, "encoder_dim": 20, "hidden_dim": 40, "episode_length": 50}
    whole = TDMPC2(observation_sizes={"state": 5}, action_dim=3, **sizes).cuda().eval()
    for parameter in whole.parameters():  # some begin as zeros
        parameter.add_(0.3 * torch.randn_like(parameter))
    sizes = {"action_dim": 3, "num_samples": 64, "num_policy_samples": 8, "num_elites": 16}
    observation = TensorDict(
        {"state": torch.randn(40, 5), "is_init": torch.ones(40, 1, dtype=torch.bool)}, [40], device="cuda"
    )
    found = {}
    for kernels in (None, False):
        policy = PlannerPolicy.for_model(
            whole, MPPI(**sizes, kernels=kernels), explore=False, precision=precision, compile=compile
        )
        for _ in range(4):  # the last one from a graph
            torch.manual_seed(1)
            action = policy(observation.clone())["action"]
        found[kernels] = action
    near = 0.02 if precision == "float32" else 0.3
    assert (found[None] - found[False]).abs().median() < near


@pytest.mark.parametrize("precision", ["*bf16", "*fp32"])
@pytest.mark.parametrize("actions", [0, 7])
@pytest.mark.parametrize("group", [0, 8])
def test_kernels_compile_for_a_gpu(precision, actions, group):
    """Without one: what the interpreter accepts, the compiler may not."""

    def compiled(kernel, signature, constants):
        types = {**signature, **dict.fromkeys(constants, "constexpr")}
        source = ASTSource(fn=kernel, signature=types, constexprs=constants)
        return triton.compile(source, target=GPUTarget("cuda", 90, 32), options={"num_warps": 4}).asm["cubin"]

    numbers = dict.fromkeys(("rows", "per", "stride", "action_stride"), "i32")
    given = dict.fromkeys(("action", "own"), "*fp32" if actions else precision)
    weights = dict.fromkeys(("bias", "scale", "shift"), "*fp32")
    for rows in (1, 4):
        types = {"x": precision, "y": precision, **weights, **given, **numbers, "eps": "fp32"}
        constants = {"D": 40, "A": actions, "BLOCK": 64, "R": rows, "GROUP": group}
        assert compiled(fused_kernels._bias_norm_activation, types, constants)
    types = {"logits": precision, "support": "*fp32", "y": "*fp32", "rows": "i32", "stride": "i32"}
    assert compiled(fused_kernels._symexp_of_mean, types, {"BINS": 101, "BLOCK": 128, "R": 8})
