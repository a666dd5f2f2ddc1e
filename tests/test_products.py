"""Products by oneDNN: the same as PyTorch's own, up to rounding, and only while they are asked for."""

from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from franka_wm import models, products
from franka_wm.device import prefer_speed
from franka_wm.errors import UserError
from franka_wm.products import LEAST, prefer_onednn

pytestmark = pytest.mark.skipif(not torch.backends.mkldnn.is_available(), reason="needs oneDNN")


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[int, ...]]]:
    """(rows, inner, columns) of each product of oneDNN."""
    found: list[tuple[int, ...]] = []
    product = products._product

    def counted(a: Tensor, b: Tensor, bias: Tensor | None = None) -> Tensor:
        assert b.is_contiguous() or b.t().is_contiguous()  # anything else takes seconds
        found.append((*a.shape, b.shape[1]))
        return product(a, b, bias)

    monkeypatch.setattr(products, "_product", counted)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield found
    torch.set_num_threads(threads)
    prefer_onednn(False)


def drawn(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(sum(shape)))


M, K, N = 128, 512, 192
LARGE = {
    "rows": lambda: torch.mm(drawn(M, K), drawn(K, N)),
    "columns": lambda: torch.mm(drawn(K, M).t(), drawn(N, K).t()),
    "part of a matrix": lambda: torch.mm(drawn(M, 2 * K)[:, :K], drawn(K, N)),
    "by a part of a matrix": lambda: torch.mm(drawn(M, K), drawn(K, 2 * N)[:, :N]),
    "by a part of columns": lambda: torch.addmm(drawn(N), drawn(M, K), drawn(N, 2 * K)[:, :K].t()),
    "members by parts": lambda: torch.bmm(drawn(3, M, K), drawn(3, K, 2 * N)[..., :N]),
    "a place for it": lambda: torch.mm(drawn(M, K), drawn(K, N), out=torch.empty(M, N)),
    "columns of a place": lambda: torch.mm(drawn(M, K), drawn(K, N), out=torch.empty(N, M).t()),
    "bias": lambda: torch.addmm(drawn(N), drawn(M, K), drawn(K, N)),
    "bias by strides": lambda: torch.addmm(drawn(N).expand(M, N), drawn(M, K), drawn(K, N)),
    "bias with gaps": lambda: torch.addmm(drawn(2 * N)[::2], drawn(M, K), drawn(K, N)),
    "matrix added": lambda: torch.addmm(drawn(M, N), drawn(M, K), drawn(K, N)),
    "members": lambda: torch.bmm(drawn(3, M, K), drawn(3, K, N)),
    "members, a place": lambda: torch.bmm(drawn(3, M, K), drawn(3, K, N), out=torch.empty(3, M, N)),
    "members, biases": lambda: torch.baddbmm(drawn(3, 1, N), drawn(3, M, K), drawn(3, K, N)),
    "layer": lambda: nn.functional.linear(drawn(2, M, K), drawn(N, K), drawn(N)),
}
PLAIN = {
    "small": lambda: torch.mm(drawn(8, 8), drawn(8, 8)),
    "one row": lambda: torch.mm(drawn(1, 2048), drawn(2048, 1024)),
    "one column": lambda: torch.mm(drawn(2048, 1024), drawn(1024, 1)),
    "double": lambda: torch.mm(drawn(M, K).double(), drawn(K, N).double()),
    "bfloat16": lambda: torch.mm(drawn(M, K).bfloat16(), drawn(K, N).bfloat16()),
    "repeated": lambda: torch.mm(drawn(1, K).expand(M, K), drawn(K, N)),
    "every second column": lambda: torch.mm(drawn(M, 2 * K)[:, ::2], drawn(K, N)),
    "scaled": lambda: torch.addmm(drawn(N), drawn(M, K), drawn(K, N), beta=0.5, alpha=2),
    "scaled members": lambda: torch.baddbmm(drawn(3, M, N), drawn(3, M, K), drawn(3, K, N), alpha=2),
    "empty": lambda: torch.mm(drawn(0, K), drawn(K, N)),
}


@pytest.mark.parametrize("name", LARGE)
def test_large_products_are_those_of_pytorch(name: str, calls: list) -> None:
    product, wanted = LARGE[name], LARGE[name]()
    prefer_onednn()
    torch.testing.assert_close(product(), wanted, rtol=1e-4, atol=1e-4)
    count = 3 if "members" in name else 1
    assert len(calls) == count
    prefer_onednn(False)
    assert torch.equal(product(), wanted) and len(calls) == count


@pytest.mark.parametrize("name", PLAIN)
def test_what_is_small_or_of_another_kind_stays_as_it_was(name: str, calls: list) -> None:
    wanted = PLAIN[name]()
    prefer_onednn()
    assert torch.equal(PLAIN[name](), wanted) and not calls


def test_gradients_are_those_of_pytorch(calls: list) -> None:
    layer = nn.Linear(K, N)
    with torch.no_grad():
        layer.weight.copy_(drawn(N, K))

    def gradients() -> tuple[Tensor, ...]:
        x = drawn(M, K).requires_grad_()
        return torch.autograd.grad(layer(x).square().sum(), (x, layer.weight, layer.bias))

    wanted = gradients()
    prefer_onednn()
    torch.testing.assert_close(gradients(), wanted, rtol=1e-3, atol=1e-2)
    assert len(calls) == 3  # forward, the input's gradient, the weight's


WRONG = {
    "sizes": lambda: torch.mm(drawn(M, K), drawn(N, K)),
    "members": lambda: torch.bmm(drawn(2, M, K), drawn(3, K, N)),
    "a vector": lambda: torch.mm(drawn(K), drawn(K, N)),
    "a batch": lambda: torch.mm(drawn(2, M, K), drawn(K, N)),
    "no batch": lambda: torch.bmm(drawn(M, K), drawn(K, N)),
    "a place of another type": lambda: torch.mm(drawn(M, K), drawn(K, N), out=torch.empty(M, N).double()),
    "a bias of other rows": lambda: torch.addmm(drawn(N).expand(7, N), drawn(M, K), drawn(K, N)),
    "a bias of no rows": lambda: torch.addmm(drawn(N).expand(0, N), drawn(M, K), drawn(K, N)),
    "a bias of other columns": lambda: torch.addmm(drawn(N + 1), drawn(M, K), drawn(K, N)),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_told_as_before(name: str, calls: list) -> None:
    with pytest.raises(RuntimeError) as before:
        WRONG[name]()
    prefer_onednn()
    with pytest.raises(RuntimeError) as now:
        WRONG[name]()
    assert str(now.value) == str(before.value)


@pytest.mark.parametrize(("threads", "asked"), [(1, 1), (2, 0)])
def test_what_is_large_depends_on_the_threads(threads: int, asked: int, calls: list) -> None:
    torch.set_num_threads(threads)
    prefer_onednn()
    side = round(LEAST ** (1 / 2) / 8)
    torch.mm(drawn(side, 64), drawn(64, side))  # as many as LEAST
    torch.mm(drawn(side - 1, 64), drawn(64, side))
    assert len(calls) == asked


@pytest.mark.parametrize("family", ["tdmpc2", "dreamer", "action_world_model"])
def test_a_family_learns_the_same(family: str, calls: list, monkeypatch) -> None:
    """Losses and all gradients, with every product by oneDNN."""
    monkeypatch.setattr(products, "LEAST", 1)
    generator = torch.Generator().manual_seed(0)
    images = {"pixels": (16, 16, 3)} if family == "action_world_model" else {}
    batch, steps = 6, 5
    seen: dict[str, Tensor] = {"state": torch.randn(batch, steps + 1, 4, generator=generator)}
    if images:
        seen["pixels"] = torch.randint(
            0, 255, (batch, steps + 1, 16, 16, 3), generator=generator, dtype=torch.uint8
        )
    marks = {key: torch.zeros(batch, steps, 1, dtype=torch.bool) for key in ("terminated", "is_init")}
    after = {key: value[:, 1:] for key, value in seen.items()} | {"terminated": marks["terminated"]}
    after["reward"] = -torch.rand(batch, steps, 1, generator=generator)
    window = TensorDict(
        {key: value[:, :-1] for key, value in seen.items()}
        | {"action": torch.rand(batch, steps, 2, generator=generator) * 2 - 1, "is_init": marks["is_init"]}
        | {"next": TensorDict(after, [batch, steps])},
        [batch, steps],
    )
    sizes = {"observation_sizes": {"state": 4}, **({"image_sizes": images} if images else {})}
    small = {"burn_in": 1, "deter_dim": 32, "hidden_dim": 32, "codes": 4, "classes": 4, "blocks": 2}
    options = {"dreamer": small, "tdmpc2": {"latent_dim": 32, "hidden_dim": 32}}.get(family, {})
    torch.manual_seed(0)
    model = models.make(family, action_dim=2, episode_length=20, **sizes, **options)
    before = {key: value.clone() for key, value in model.state_dict().items()}

    def learned() -> tuple[Tensor, dict[str, Tensor]]:
        model.load_state_dict(before)
        model.zero_grad()
        torch.manual_seed(1)
        loss = model.loss(window)["loss"]
        loss.backward()
        return loss.detach(), {
            name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None
        }

    wanted = learned()
    prefer_onednn()
    torch.testing.assert_close(learned(), wanted, rtol=1e-3, atol=1e-4)
    assert len(calls) > 20 and any(value.any() for value in wanted[1].values())


def test_asked_for_twice_it_ends_at_once(calls: list) -> None:
    for _ in range(2):
        prefer_onednn()
    for _ in range(2):
        prefer_onednn(False)
    LARGE["rows"]()
    assert not calls


def test_only_for_a_cpu_and_where_there_is_onednn(calls: list, monkeypatch) -> None:
    with pytest.raises(UserError, match=r"trainer\.onednn=true: needs device=cpu"):
        prefer_speed(torch.device("cuda:0"), onednn=True)
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    with pytest.raises(UserError, match="this PyTorch has no oneDNN"):
        prefer_speed(torch.device("cpu"), onednn=True)
    prefer_speed(torch.device("cpu"), onednn=False)


def test_the_next_run_of_a_process_is_without(calls: list) -> None:
    prefer_speed(torch.device("cpu"), onednn=True)
    LARGE["rows"]()
    prefer_speed(torch.device("cpu"))  # says nothing about it
    LARGE["rows"]()
    assert len(calls) == 2
    prefer_speed(torch.device("cpu"), onednn=False)
    LARGE["rows"]()
    assert len(calls) == 2


@pytest.mark.slow
def test_compiled_code_is_included(calls: list) -> None:
    layer = nn.Sequential(nn.Linear(K, N), nn.ReLU(), nn.Linear(N, K))
    compiled = torch.compile(layer)
    x = drawn(M, K)
    wanted = torch.autograd.grad(layer(x).square().sum(), [*layer.parameters()])
    prefer_onednn()
    found = torch.autograd.grad(compiled(x).square().sum(), [*layer.parameters()])
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-2)
    assert len(calls) == 5  # two forward; three gradients, as nothing asks for the input's
