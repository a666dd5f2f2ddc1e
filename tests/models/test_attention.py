import pytest
import torch
from torch.nn.functional import scaled_dot_product_attention

from franka_wm.models.attention import attention, short_attention
from franka_wm.models.transformer import block_causal_mask, hide_invalid


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


@pytest.mark.parametrize("lengths", [(1, 1), (3, 3), (8, 4)])
def test_short_attention_is_attention(lengths):
    length, real = lengths
    q, k, v = torch.randn(3, 5, 2, length, 16, dtype=torch.float64).unbind()
    valid = (torch.arange(length) >= length - real).double().expand(5, -1)
    mask = hide_invalid(block_causal_mask(length), valid)
    expected = scaled_dot_product_attention(q, k, v, attn_mask=mask)
    torch.testing.assert_close(short_attention(q, k, v, mask), expected)


@pytest.mark.parametrize("masked", [False, True])
def test_bfloat16_on_a_cpu_rounds_only_what_goes_in_and_out(masked):
    q, k, v = torch.randn(3, 4, 2, 12, 16).bfloat16().unbind()
    mask = block_causal_mask(4, 3) if masked else None
    exact = scaled_dot_product_attention(q.double(), k.double(), v.double(), attn_mask=mask)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = attention(q, k, v, mask)
    assert found.dtype == torch.bfloat16
    assert (found == exact.to(torch.bfloat16)).float().mean() > 0.99


def test_wider_numbers_stay_as_they_are():
    q, k, v = torch.randn(3, 4, 2, 12, 16, dtype=torch.float64).unbind()
    found = attention(q, k, v)
    assert found.dtype == torch.float64
    torch.testing.assert_close(found, scaled_dot_product_attention(q, k, v), rtol=0, atol=0)
